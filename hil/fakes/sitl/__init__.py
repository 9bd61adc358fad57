"""Real firmware in software with the simulator's vehicle behind it: its process, its set-up, the bridge between the two."""

from hil.fakes.sitl.ardupilot import ArduPilotSitl
from hil.fakes.sitl.betaflight import SLOW, BetaflightSitl, MotorPlant
from hil.fakes.sitl.firmware import Firmware, needed
from hil.fakes.sitl.sih import HangingBall, Px4Sih
from hil.fakes.sitl.throw import opened, throw

__all__ = ["SLOW", "ArduPilotSitl", "BetaflightSitl", "Firmware", "HangingBall", "MotorPlant", "Px4Sih", "needed", "opened", "throw"]
