"""Back-ends: where commands go. ``dry-run`` (the default) sends nothing, ``ardupilot`` and ``px4`` speak MAVLink on the link
that the poses may share, ``betaflight`` speaks MSP and ``crazyflie`` CRTP on a port of its own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.backends.ardupilot import ArduPilot, ArduPilotParams
from hil.backends.autopilot import MavlinkAutopilot
from hil.backends.base import Backend, DryRun, Status
from hil.backends.betaflight import Betaflight, BetaflightParams
from hil.backends.crazyflie import Crazyflie, CrazyflieParams
from hil.backends.held import Held
from hil.backends.px4 import Px4, Px4Params
from hil.errors import RunError
from hil.links.crtp import open_crtp
from hil.links.device import check_device, open_port
from hil.links.msp_log import LoggedPort

AUTOPILOTS: dict[str, type[MavlinkAutopilot]] = {"ardupilot": ArduPilot, "px4": Px4}
"""Back-ends that speak MAVLink."""

MSP_LOG = "link.msp"
"""In a run's folder."""

THRUST_SHORT = 0.98
"""Shares of the thrust, and of the rates, that the policy was trained with: what a vehicle must reach at least."""


def mechanism_lag(params: Any) -> float:
    """Time from the release command to separation [s] of the mechanism of a run's back-end; 0 for a dry run."""
    return 0.0 if params.backend == "dry-run" else getattr(params, params.backend).mechanism_lag


def make_backend(
    params: Any, link: Any = None, write: bool = False, tell: Callable[[str], None] | None = None,
    folder: Path | None = None,
) -> Backend:  # fmt: skip
    """The back-end of a run.

    Args:
        params: `hil.params.HilParams`.
        link: MAVLink link of the run; None where poses are recorded ones.
        write: whether wrong parameters of the autopilot are written.
        tell: is handed the audit's table.
        folder: of the run, where MSP is written down as the link's messages are in its .tlog.

    Raises:
        LinkError: the port of the flight controller cannot be opened.
        RunError: a MAVLink back-end without a link.
    """
    if params.backend == "dry-run":
        return DryRun()
    backend = _made(params, link, write, tell, folder)
    return Held(backend, params.delay.hold) if params.delay.hold else backend


def _made(params: Any, link: Any, write: bool, tell: Callable[[str], None] | None, folder: Path | None) -> Backend:
    if params.backend == "betaflight":
        device = check_device(params.betaflight.device, remote=params.betaflight.remote)
        if device.kind not in ("tcp", "serial"):
            raise RunError(f"betaflight.device {params.betaflight.device}: MSP is a stream; expected tcp:... or serial:...")
        port = open_port(device)
        port = port if folder is None else LoggedPort(port, folder / MSP_LOG)
        return Betaflight(port, params.betaflight, write, tell)
    if params.backend == "crazyflie":
        return Crazyflie(open_crtp(params.crazyflie.device, params.crazyflie.remote), params.crazyflie)
    if link is None:
        raise RunError(f"backend {params.backend} without a MAVLink link; expected source.kind mavlink")
    return AUTOPILOTS[params.backend](link, getattr(params, params.backend), write, tell)


def require_reach(params: Any, contract: dict[str, Any]) -> None:
    """Refuse a vehicle that cannot do what the policy was trained to command.

    Args:
        params: `hil.params.HilParams`.
        contract: of the policy.

    Raises:
        RunError: thrust or rates fall short, by the calibration and the rate profile of the config.
    """
    if params.backend == "dry-run":
        return
    vehicle, action = getattr(params, params.backend), contract["action"]
    most, wanted = vehicle.thrust.most, float(action["max_thrust"])
    if most < THRUST_SHORT * wanted:
        raise RunError(
            f"{params.backend}.thrust gives {most:.2f} N at most, the policy was trained with {wanted:g} N; check weight, hover "
            "and slope, or train a policy for this vehicle"
        )
    if params.backend == "betaflight":
        from hil.backends.rates import Sticks

        ends = Sticks(vehicle.rates).most
        short = [i for i, r in enumerate(action["max_rate"]) if ends[i] < THRUST_SHORT * r]
        if short:
            raise RunError(
                f"betaflight.rates reach {', '.join(f'{r:.1f}' for r in ends)} rad/s on roll, pitch, yaw, the policy was trained "
                f"with {', '.join(f'{r:g}' for r in action['max_rate'])}; raise rates"
            )


__all__ = [
    "AUTOPILOTS", "ArduPilot", "ArduPilotParams", "Backend", "Betaflight", "BetaflightParams", "Crazyflie",
    "CrazyflieParams", "DryRun", "Px4", "Px4Params", "Status",
    "make_backend", "mechanism_lag", "require_reach",
]  # fmt: skip
