"""What goes into a tick besides poses, and what comes out of it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class OperatorInput:
    """What the operator said since the last tick."""

    arm: bool = False
    land: bool = False
    abort: bool = False
    why: str = ""  # of the abort, where it was no word: a signal, the end of the run's time


@dataclass
class Decision:
    """All that one tick saw and decided; plain values, as they are recorded."""

    time: float
    state: str
    reason: str
    command: tuple[float, ...] | None = None  # as sent [N, rad/s]
    action: list[float] | None = None  # of the policy, normalised
    observation: list[float] | None = None
    keypoints: list | None = None
    valid: list | None = None
    release: bool = False  # the policy asked for it and it was done
    note: str = ""
    waits: str = ""  # why it does not go on
    seen: list | None = None  # of a camera's newest frame since the last tick; see `hil.poses.detection.Detection`
    calibration: dict | str | None = None  # that came with this tick, or why there is none; see `visthrow.onboard.calibration`
