"""The autopilot's part of ``hil check`` and of a run's summary: parameters, and the share of thrust in hover.

The share is the one that the autopilot itself reports while the vehicle hovers in its hands or a pilot's (ATTITUDE_TARGET or
VFR_HUD, the throttle channel of Betaflight). After a run the runner's own hover says it as well: see :func:`hover_of_run`.
"""

from pathlib import Path
from typing import Any

from hil.backends.base import FOLLOW, Status
from hil.backends.thrust import LEAST_SHARES, HoverMeter
from hil.control.states import State
from hil.errors import RunError
from hil.poses.pose import VEHICLE
from hil.recording.record import CONFIG, TICKS, lines, require_run
from visthrow.onboard.hover import GRAVITY

CALM = 0.15  # speed below which a hover counts as steady [m/s]
LIFTED = 0.3  # height above which a vehicle counts as flying [m]
SETTLING = 50  # ticks at the beginning of a hover that are left out: a second


class AutopilotCheck:
    """Listens to an autopilot without commanding it."""

    def __init__(self, params: Any, backend: Any) -> None:
        """Begin with nothing heard of the back-end; a dry run has no autopilot."""
        self.backend = backend
        self.meter = None if params.backend == "dry-run" else HoverMeter(getattr(params, params.backend).thrust)

    def tick(self, now: float, runner: Any) -> None:
        """Listen; the runner knows whether the vehicle hovers."""
        self.backend.service(now)
        track = runner.tracks[VEHICLE]
        state = track.state(now)
        if self.meter is not None and state is not None and state.pos[2] > LIFTED and track.calm_speed() < CALM:
            self.meter.add(self.backend.share)
        self.backend.share = None  # each report counts once

    def results(self, now: float, mass: float) -> list[tuple[bool, str]]:
        """Return what was found with a mass [kg] that hovers: whether it is good, and in words."""
        if self.meter is None:
            return []
        audit, status = self.backend.audit, self.backend.status(now)
        if audit.rules:
            print(audit.table())
        out = [] if audit.fault() is None else [(False, audit.fault())]
        if not audit.done:
            out.append((False, f"parameters were not read: {status.note or 'the time was too short'}"))
        return [*out, self.meter.summary_text(mass)]


def autopilot_record(backend: Any, link: Any) -> dict[str, Any]:
    """Return what a run's summary keeps of its autopilot: parameters, the last release, texts, clocks of the link's peers."""
    out: dict[str, Any] = {"backend": backend.name}
    if hasattr(backend, "audit"):
        audit, release = backend.audit, backend.release_record
        out["parameters"] = {"found": audit.found, "written": audit.written, "problems": audit.problems}
        out["release"] = {"state": release.state, "note": release.note, "sends": release.sends}
        out["texts"] = getattr(backend, "texts", [])[-50:]
    if link is not None and link.sync is not None:
        out["clocks"] = link.sync.summary()
    return out


def hover_of_run(folder: str | Path) -> tuple[bool, str]:
    """Return whether the hover of a recorded run took the weight, by what the runner commanded before its throws; and that in words.

    Raises:
        RunError: no folder of a run, or no steady hover in it.
    """
    from hil.params import HilParams
    from visthrow import config
    from visthrow.onboard.policy import Policy

    folder = Path(folder)
    require_run(folder)
    params = config.load(HilParams, folder / CONFIG)
    if params.backend == "dry-run":
        raise RunError(f"{folder} is a dry run: nothing followed its commands; expected a run with an autopilot")
    mass = Policy.load(folder / "policy.npz").total_mass
    thrusts, hovering = [], 0
    for line in lines(folder / TICKS):
        mode = Status(*line["status"]).mode
        follows = line["state"] in (State.READY, State.ARMED) and line["command"] and mode == FOLLOW
        hovering = hovering + 1 if follows else 0
        if hovering > SETTLING:
            thrusts.append(line["command"][0])
    if len(thrusts) < LEAST_SHARES:
        raise RunError(
            f"{folder}: {len(thrusts)} ticks of steady hover before throws; expected {LEAST_SHARES} or more, after {SETTLING}: hover "
            "longer before a throw, as with --set states.armed_least=3.0"
        )
    thrust = getattr(params, params.backend).thrust
    asked, weight = sum(thrusts) / len(thrusts), mass * GRAVITY
    ratio = asked / weight
    text = (
        f"hover took {ratio:.3f} times the weight by the config's calibration: the hover share is {thrust.share(asked):.4f}, "
        f"not {thrust.share(weight):.4f} ({len(thrusts)} ticks, {100 * thrust.tolerance:g} % allowed)"
    )
    return abs(ratio - 1.0) <= thrust.tolerance, text
