"""Back-ends, which send commands to the vehicle.

``dry-run`` (the default) sends nothing; ``ardupilot`` and ``px4`` use MAVLink on a link that may
also carry the poses; ``betaflight`` uses MSP and ``crazyflie`` CRTP on a separate port.
"""

from pathlib import Path
from typing import Any

from hil.errors import RunError
from hil.links.backends.ardupilot import ArduPilot
from hil.links.backends.base import Backend, DryRun, Held
from hil.links.backends.betaflight import Betaflight
from hil.links.backends.crazyflie import Crazyflie
from hil.links.backends.mavlink_autopilot import MavlinkAutopilot
from hil.links.backends.px4 import Px4
from hil.links.backends.rates import Sticks
from hil.links.crtp import open_crtp
from hil.links.device import check_device, open_port
from hil.links.roster import Announce
from hil.links.writer import MSP_LOG, LoggedPort
from visthrow.onboard.hover import GRAVITY

# back-ends that speak MAVLink
AUTOPILOTS: dict[str, type[MavlinkAutopilot]] = {"ardupilot": ArduPilot, "px4": Px4}
# share of the trained maximum thrust, and of the trained maximum rates, that a vehicle must reach
THRUST_SHORT = 0.98


def mechanism_lag(params: Any) -> float:
    """Return the mechanism's time from release command to separation [s]; 0 for a dry run."""
    return 0.0 if params.vehicle is None else params.vehicle.mechanism_lag


def make_backend(
    params: Any,
    link: Any = None,
    write: bool = False,
    tell: Announce = None,
    folder: Path | None = None,
) -> Backend | Held:
    """Return the back-end of a run. Raises `LinkError` or `RunError`: there is no link or port for
    it.

    Args:
        params: `hil.params.HilParams`. link: MAVLink link of the run; None for recorded poses.
        write: whether to correct wrong parameters of the autopilot. tell: called with the audit's
            table.
        folder: of the run, in which the MSP traffic is recorded.
    """
    name = params.backend
    vehicle = params.vehicle
    backend: Backend
    if vehicle is None:
        return DryRun()
    if name == "betaflight":
        device = check_device(vehicle.device, remote=vehicle.remote)
        if device.kind not in ("tcp", "serial"):
            raise RunError(
                f"betaflight.device {vehicle.device}: MSP is a stream; expected tcp:... or"
                " serial:..."
            )
        port = open_port(device, "--set betaflight.device=...")
        backend = Betaflight(
            port if folder is None else LoggedPort(port, folder / MSP_LOG), vehicle, write, tell
        )
    elif name == "crazyflie":
        backend = Crazyflie(open_crtp(vehicle.device, vehicle.remote), vehicle, tell)
    elif link is None:
        raise RunError(f"backend {name} without a MAVLink link; expected source.kind mavlink")
    else:
        backend = AUTOPILOTS[name](link, vehicle, write, tell)
    return Held(backend, params.delay.hold) if params.delay.hold else backend


def require_reach(params: Any, contract: dict[str, Any]) -> None:
    """Raise `RunError` for a vehicle whose configuration does not match the policy: another
    weight, or a thrust calibration or rate profile that does not reach the policy's largest
    commands.
    """
    vehicle = params.vehicle
    if vehicle is None:
        return
    action = contract["action"]
    rope = contract["rope"]
    mass = contract["vehicle"]["body"]["mass"] + rope["rope_mass"] + rope["payload_mass"]
    ratio = vehicle.thrust.weight / (mass * GRAVITY)
    if abs(ratio - 1.0) > vehicle.thrust.tolerance:
        raise RunError(
            f"{params.backend}.thrust.weight {vehicle.thrust.weight:g} N is {ratio:.2f} times the"
            f" weight that the policy was trained with, {mass * GRAVITY:.3f} N; expected it within"
            f" {vehicle.thrust.tolerance:g}: train a policy for this vehicle"
        )
    available = vehicle.thrust.full_thrust
    trained = float(action["max_thrust"])
    if available < THRUST_SHORT * trained:
        raise RunError(
            f"{params.backend}.thrust gives {available:.2f} N at most, the policy was trained with"
            f" {trained:g} N; check weight, hover and slope, or train a policy for this vehicle"
        )
    ends = Sticks(vehicle.rates).limits if params.backend == "betaflight" else action["max_rate"]
    if any(end < THRUST_SHORT * rate for end, rate in zip(ends, action["max_rate"])):
        raise RunError(
            f"betaflight.rates reach {', '.join(f'{r:.1f}' for r in ends)} rad/s on roll, pitch,"
            f" yaw, the policy was trained with {', '.join(f'{r:g}' for r in action['max_rate'])};"
            " raise rates"
        )
