"""A model of a camera that sees a marker on the payload, against motion capture of both bodies.

Its effects stand in ``effects.toml``.

Convention: a gimbal under the vehicle turns about its x axis, then about its own y axis; the camera
stands off along the gimbal's x axis; its optical axis is that x axis, its image's x to the right, y
down."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visthrow.common.errors import LogError
from visthrow.common.rotations import cross, matrix_of_quat
from visthrow.config.bounds import Bounded, Positive
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch, interpolate, take_samples
from visthrow.logs.flightlog import FlightLog

CHANNEL = "marker_pos_c"
NEEDED = (CHANNEL, "pos_w", "quat_wb", "payload_pos_w")
MOST_APART = 0.25  # share of the detections that may be of something else than the payload
# poses are kept this long before and after a window [s], so that a delay can look them up
MARGIN = 1.0


@dataclass(frozen=True)
class GimbalParams(Bounded):
    """The assumed pose of the camera."""

    base_b: tuple[float, float, float]  # the gimbal's centre in the body frame [m]
    camera_offset: float  # of the camera along the gimbal's x axis [m]
    # gimbal to camera: turns about fixed x, y, z in this order [deg]
    camera_axes_deg: tuple[float, float, float]
    marker_z: float  # the marker over the payload's tracked centre, along the vertical [m]
    sigma_across: Positive  # of the marker's direction times distance [m]
    sigma_along: Positive  # of its distance [m]
    # whether the gimbal's angles are against the horizon (then only the vehicle's yaw turns it)
    stabilised: bool
    window: Positive  # [s]
    every: int  # the samples taken: every n-th
    largest: Positive  # detections further than this from the prediction are of something else [m]


SLUNG_LOAD = GimbalParams(
    base_b=(0.0, 0.0, -0.107),  # the authors' geometry (the data's SOURCE.md)
    camera_offset=0.025,  # as above
    camera_axes_deg=(-90.0, 0.0, -90.0),  # as above: about x, then about z
    marker_z=0.0,  # the plain model: the marker is at the tracked centre of the load
    sigma_across=0.02,  # scatter of detections from frame to frame
    sigma_along=0.05,  # the size of a marker tells its distance less well
    stabilised=False,  # with angles against the horizon the residual is four times as large
    window=10.0,  # three swings
    every=3,  # neighbouring detections err alike
    largest=1.0,  # a marker at twice the distance is another one
)
"""A 1.8 kg multirotor with 0.46 kg on a cable of about 3 m."""


class GimbalModel(NumericModel):
    """Windows of the marker's positions in the camera's frame."""

    lawless = "it is geometry, in which no force moves anything"

    table = str(Path(__file__).with_name("effects.toml"))
    pushes = ((2, 0), (2, 1), (2, 2))
    knot_count = 11
    channels = (CHANNEL,)
    needed = inputs = NEEDED

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class.

        Raises LogError: the marker is not seen at the payload.
        """
        params = self.params
        marker = log[CHANNEL]
        tables = _tables(log, params)
        stretches = []
        rejected = 0
        frames = 0
        last = marker.time[-1] - MARGIN - params.window
        for start in np.arange(marker.time[0] + MARGIN, last, params.window):
            end = start + params.window
            stamps, point = take_samples(marker, params, start)
            near = (tables["time"] > start - MARGIN) & (tables["time"] < end + MARGIN)
            if len(stamps) < 10 or np.sum(near) < 20:
                continue
            data = {name: values[near] for name, values in tables.items()}
            distance = np.median(np.linalg.norm(data["gap_b"], axis=1))
            fits = np.abs(np.linalg.norm(point, axis=1) - distance) < params.largest
            rejected += int(np.sum(~fits))
            frames += len(fits)
            if np.sum(fits) < 10:
                continue
            sigma = np.array([params.sigma_across, params.sigma_across, params.sigma_along])
            measured = stamps[fits], point[fits], sigma
            stretches.append(self.lay_out(number, "view", [measured], (start, end), data))
        if rejected > MOST_APART * frames:
            raise LogError(
                f"the marker's distance is more than {params.largest:g} m from the payload's in"
                f" {rejected} of {frames} detections: other axes, another unit, or another marker"
            )
        return stretches

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class."""
        tilt, lever, turn = (
            self.stack(lanes, *(f"{what}_{axis}" for axis in "xyz"))
            for what in ("camera_tilt", "camera_lever", "marker_rot")
        )
        time = stretch.time[::3]
        late = time - self.size_of(lanes, "camera_delay")[:, None]
        gap, level = (
            interpolate(stretch.data["time"], stretch.data[name], late)
            for name in ("gap_b", "level")
        )
        gap = gap + cross(turn[:, None], gap) - np.array(self.params.base_b)
        points = np.einsum("bnji,bnj->bni", level.reshape(*late.shape, 3, 3), gap)
        points = points - np.array([self.params.camera_offset, 0.0, 0.0])
        axes = Rotation.from_euler("xyz", self.params.camera_axes_deg, degrees=True)
        point = points @ axes.as_matrix()
        point = point + cross(tilt[:, None], point) - lever[:, None]
        # what gimbal and detection err by, slowly
        shares = (time - stretch.latent_time[0]) / self.params.window
        point = point + self.pushes_at(lanes, shares).swapaxes(0, 1)
        scale = 1.0 + self.stack(lanes, "focal_scale", "focal_scale", "range_scale")
        return (point * scale[:, None]).reshape(len(late), -1)


def _tables(log: FlightLog, params: GimbalParams) -> dict[str, np.ndarray]:
    """Return stamps of the vehicle's poses, and at them the payload's marker from the vehicle, body
    frame, and the rotation from gimbal to body as rows of 9.
    """
    vehicle = log["pos_w"]
    attitude = log["quat_wb"]
    payload = log["payload_pos_w"]
    good = vehicle.valid
    if len(vehicle.time) == len(payload.time):
        good = vehicle.valid & attitude.valid & payload.valid
    time = vehicle.time[good]
    marker = payload.samples().at(time) + [0.0, 0.0, params.marker_z]
    rot = matrix_of_quat(attitude.values[good])
    angles = log["gimbal"].values[good] if "gimbal" in log else np.zeros((len(time), 2))
    gimbal = Rotation.from_euler("XY", angles).as_matrix()
    if params.stabilised:
        yaw = np.arctan2(rot[:, 1, 0], rot[:, 0, 0])
        level = Rotation.from_euler("z", yaw[:, None]).as_matrix()
        gimbal = np.swapaxes(rot, 1, 2) @ level @ gimbal
    gap_b = np.einsum("nji,nj->ni", rot, marker - vehicle.values[good])
    return {"time": time, "gap_b": gap_b, "level": gimbal.reshape(-1, 9)}
