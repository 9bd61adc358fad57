"""Fake autopilots that behave over the wire as the real ones were measured to; what flies behind them is injected."""

from hil.fakes.ardupilot import FakeArduPilot
from hil.fakes.base import PAYLOAD_ID, VEHICLE_ID, Fake, Options, WirePlant
from hil.fakes.betaflight import FakeBetaflight
from hil.fakes.crazyflie import FakeCrazyflie
from hil.fakes.px4 import FakePx4

KINDS = {"ardupilot": FakeArduPilot, "px4": FakePx4, "betaflight": FakeBetaflight, "crazyflie": FakeCrazyflie}

__all__ = [
    "KINDS", "PAYLOAD_ID", "VEHICLE_ID", "Fake", "FakeArduPilot", "FakeBetaflight", "FakeCrazyflie", "FakePx4", "Options",
    "WirePlant",
]  # fmt: skip
