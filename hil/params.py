"""Configuration of a run, a file of ``configs/hil``. Most tables are defined beside the code that
reads them.

All values are in SI units; no convention of frames has a default.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from camera.params import CameraParams
from hil.control.aim import AimParams
from hil.control.calibrating import CalibrationParams
from hil.control.realtime import RealtimeParams
from hil.control.safety import CheckParams, FenceParams, GuardParams, box_violation
from hil.control.state_machine import StateParams
from hil.links.backends.ardupilot import ArduPilotParams
from hil.links.backends.betaflight import BetaflightParams
from hil.links.backends.crazyflie import CrazyflieParams
from hil.links.backends.px4 import Px4Params
from hil.links.roster import MavlinkId, check_allowed
from hil.links.team_link import TeamLinkParams
from hil.poses.body_track import MOST_PREDICTION
from hil.poses.estimate import EstimateParams
from hil.poses.frames import FrameParams
from hil.poses.gate import GateParams
from hil.poses.pose import BODIES, GOAL, PAYLOAD, VEHICLE, Vector
from hil.poses.sources.images import ImageParams
from hil.poses.sources.mavlink import BodyIds
from hil.poses.sources.motion_capture import MocapParams, RigidBody
from hil.poses.sources.player import CHANNELS, LogBody
from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bound, Bounded
from visthrow.logs.mapping import ChannelMap, TableMap, TimeColumn

# longest delay added to a command [s]: a longer one means that the policy was trained for another
# link
MOST_HOLD = 0.05
LIVE = ("mavlink", "mocap")  # kinds of source that are not recordings
# order of quaternions for sources with a fixed order
ORDERS = {"bin": "wxyz", "ulg": "wxyz", "mocap": "xyzw"}


@dataclass(frozen=True)
class LinkParams(Bounded):
    """The MAVLink link of source and autopilot."""

    device: str  # see hil.links.device
    remote: bool  # whether the device may be on another machine
    system: MavlinkId  # our own
    component: MavlinkId  # likewise
    # accepted senders of datagrams, ADDRESS or ADDRESS:PORT; none: any
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_allowed(self.allow)


@dataclass(frozen=True)
class SourceParams:
    """The source of poses."""

    kind: Literal["mavlink", "tlog", "csv", "bin", "ulg", "mocap"]
    file: str | None  # of a recording: tlog, csv, bin or ulg
    senders: tuple[BodyIds, ...]  # of mavlink and tlog
    # of csv: of hil.poses.sources.player.CHANNELS; none where the file names its channels
    columns: tuple[ChannelMap, ...] = ()
    time: TimeColumn | None = None  # of csv: its clock
    logs: tuple[LogBody, ...] = ()  # of bin and ulg
    bodies: tuple[RigidBody, ...] = ()  # of mocap
    mocap: MocapParams | None = None
    # of mavlink poses on a separate port, see hil.links.device; none: link.device
    device: str | None = None
    check_units: bool = True  # refuse recordings with impossible values: a wrong unit

    def __post_init__(self) -> None:
        if bool(self.columns) != (self.time is not None):
            raise ConfigError("source: a table needs both a time and columns")

    @property
    def mapping(self) -> TableMap | None:
        """Mapping of a table; None if it needs none."""
        return TableMap(self.time, self.columns) if self.time is not None else None


@dataclass(frozen=True)
class DelayParams(Bounded):
    """Ages of poses, and their compensation."""

    # of a pose when it arrives [s], if its sender's clock is unknown
    source: Annotated[float, Bound(0.0, 0.5)]
    # whether to measure the clocks of pose senders by TIMESYNC, and to use them for ages
    synchronise: bool
    compensate: bool  # whether poses are predicted to the age that the policy was trained with
    # additional delay of commands and releases compared with training; poses are predicted further
    # by it [s]
    command: Annotated[float, Bound(0.0, MOST_PREDICTION)] = 0.0
    # delay added to each command, because the vehicle acts sooner than in training [s]
    hold: Annotated[float, Bound(0.0, MOST_HOLD)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold and self.command:
            raise ConfigError(
                f"hold {self.hold} s, command {self.command} s; expected one of them 0: a vehicle"
                " acts sooner than the policy was trained for, or later"
            )


@dataclass(frozen=True)
class HilParams(Bounded):
    """The configuration of a run. Raises `ConfigError`: a body lacks frames, or parts contradict
    each other.
    """

    policy: str  # name of a shipped policy, or a file
    camera: CameraParams
    backend: Literal["dry-run", "ardupilot", "px4", "betaflight", "crazyflie"]
    # Run the policy in every tick, not only in a throw; its output is then recorded, never sent.
    # Such a run waits for poses and checks without a time-out.
    observe: bool
    throws: Annotated[int, Bound(1)]  # after which the run lands
    goal_w: Vector  # target if no body is the goal [m]
    home_w: Vector  # hover point [m]
    landing_height: float  # of the payload's centre at landing [m]
    link: LinkParams
    source: SourceParams
    frames: dict[str, FrameParams]  # by body: vehicle, payload and, if it moves, goal
    gate: GateParams
    estimate: EstimateParams
    delay: DelayParams
    fence: FenceParams
    guard: GuardParams
    check: CheckParams
    states: StateParams
    ardupilot: ArduPilotParams
    px4: Px4Params
    betaflight: BetaflightParams
    crazyflie: CrazyflieParams | None = None  # required if it is the back-end
    # projected from the poses, or detected in a camera's pictures
    keypoints: Literal["projection", "detector"] = "projection"
    images: ImageParams | None = None  # of the detector
    realtime: RealtimeParams = field(default_factory=RealtimeParams)
    aim: AimParams | None = None  # which releases are refused; None: none
    # of the camera, in the hover before the first throw; None: no calibration
    calibration: CalibrationParams | None = None
    team: TeamLinkParams | None = None  # of vehicles that throw together; None: one vehicle

    def __post_init__(self) -> None:
        super().__post_init__()
        if not {VEHICLE, PAYLOAD} <= set(self.frames) <= set(BODIES):
            raise ConfigError(
                f"frames of {', '.join(self.frames)}; expected vehicle and payload, goal if it"
                " moves"
            )
        for wrong, text in (*self._missing_parts(), *self._place_rules()):
            if wrong:
                raise ConfigError(text)
        angles = {channel.name for channel in self.source.columns if channel.kind == "euler"}
        for name, frames in self.frames.items():
            written = "xyzw" if CHANNELS[name][1] in angles else ORDERS.get(self.source.kind)
            if written is not None and frames.quaternion != written:
                raise ConfigError(
                    f"frames.{name}.quaternion is '{frames.quaternion}'; a source of kind"
                    f" {self.source.kind} writes '{written}'"
                )

    @property
    def vehicle(self) -> Any:
        """Table of the back-end; None for a dry run."""
        return getattr(self, self.backend, None)

    def _missing_parts(self) -> tuple[tuple[bool, str], ...]:
        """Return rules on tables and their combinations: whether each is violated, and its
        error.
        """
        kind = self.source.kind
        detects = self.keypoints == "detector"
        return (
            (
                detects and self.images is None,
                "keypoints of a detector, but no table [images]; expected its kind and path or"
                " device",
            ),
            (
                self.calibration is not None and not detects,
                'calibration of a camera, but keypoints of poses; expected keypoints = "detector"',
            ),
            (
                self.backend == "crazyflie" and self.crazyflie is None,
                "backend crazyflie without a table [crazyflie]; expected its device and thrust, as"
                " in crazyflie.toml",
            ),
            (
                kind not in LIVE and self.source.file is None,
                f"source.file is none; expected the file of the {kind} source",
            ),
            (
                self.backend != "dry-run" and kind not in LIVE,
                f"backend {self.backend} with recorded poses ({kind}); a recording flies dry",
            ),
            (
                kind == "mocap" and self.source.mocap is None,
                "source.mocap is missing; expected its system and host",
            ),
        )

    def _place_rules(self) -> tuple[tuple[bool, str], ...]:
        """Return rules on positions and fences: whether each is violated, and its error."""
        fence = self.fence
        low = self.fence.payload_low
        high = self.fence.payload_high
        goal_moves = GOAL in self.frames
        return (
            (
                box_violation(self.home_w, fence.vehicle_low, fence.vehicle_high) is not None,
                f"home_w {self.home_w} m; expected within the vehicle's fence,"
                f" {fence.vehicle_low} to {fence.vehicle_high} m",
            ),
            (
                not low[2] <= self.landing_height <= high[2],
                f"landing_height {self.landing_height} m; expected within the payload's fence,"
                f" {low[2]} to {high[2]} m of height",
            ),
            (
                not goal_moves and box_violation(self.goal_w, low, high) is not None,
                f"goal_w {self.goal_w} m; expected within the payload's fence, {low} to {high} m",
            ),
        )
