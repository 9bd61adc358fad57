"""Projected against seen: motion capture of vehicle and load, and what a real gimbal camera detected of the load.

The load's place in the camera follows from the poses, the gimbal's angles and the mounting; the difference from what the camera
reported is the residual. Two causes are fitted: a constant turn of the camera on its gimbal, and an offset in rows between the
poses and the camera. Each is judged on recordings that were not fitted. A log of this kind has no time stamps and lost frames, so
the offset is also found piece by piece, and its uncertainty comes from drawing the pieces anew.

Convention: gimbal angles turn about x, then about the turned y; a residual is seen minus projected, camera frame (x right, y down,
z along the optical axis).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.errors import SourceError
from hil.poses.frames import FrameParams, Frames, rotation_of
from hil.poses.pose import PAYLOAD, VEHICLE
from hil.sources.csv_file import Column, CsvParams, read_columns, read_csv
from visthrow.common.errors import ConfigError

SCALE = 0.05
"""Residuals beyond this weigh less in a fit [m]: detections have outliers of metres."""
OFFSETS = np.arange(-6.0, 6.01, 0.25)
"""Offsets that are tried [rows]."""
PIECE = 300
"""Rows of a piece: 10 s, three swings of a 3 m cable."""
DRAWS = 200
REWEIGHTINGS = 12


@dataclass(frozen=True)
class CameraLogParams:
    """What a camera's log holds, and how the camera is said to be mounted.

    Raises:
        ConfigError: wrong numbers of columns or units.
        FrameError: axes that are no turn.
    """

    seen: Column  # load in the camera frame: x right, y down, z along the optical axis
    gimbal: Column  # angles about x, then y
    base_b: tuple[float, float, float]  # gimbal on the vehicle [m], body frame
    lens_g: tuple[float, float, float]  # lens on the gimbal [m], gimbal frame
    axes: str  # gimbal axes in the camera's, as in hil.poses.frames
    row_period: float  # mean time between rows [s]; only to say what an offset is in seconds

    def __post_init__(self) -> None:
        rotation_of(self.axes)
        for name, width, units in (("seen", 3, ("m", "cm", "mm")), ("gimbal", 2, ("deg", "rad"))):
            column = getattr(self, name)
            if len(column.names) != width or column.unit not in units:
                raise ConfigError(
                    f"against.{name}: {len(column.names)} columns in '{column.unit}'; expected {width} in one of {', '.join(units)}"
                )
        if not self.row_period > 0.0:
            raise ConfigError(f"against.row_period {self.row_period} s; expected above 0")


@dataclass(frozen=True)
class CameraLog:
    """One recording, a row a camera message, in our frames."""

    name: str
    pos: np.ndarray  # vehicle [m], shape (N, 3), world frame
    quat: np.ndarray  # xyzw, shape (N, 4)
    load: np.ndarray  # [m], shape (N, 3), world frame
    gimbal: np.ndarray  # angles [rad], shape (N, 2)
    seen: np.ndarray  # load in the camera frame [m], shape (N, 3)

    def half(self, second: bool) -> "CameraLog":
        """The first or the second half of the rows."""
        n = len(self.pos) // 2
        part = slice(n, None) if second else slice(0, n)
        arrays = (a[part] for a in (self.pos, self.quat, self.load, self.gimbal, self.seen))
        return CameraLog(f"{self.name}, {'second' if second else 'first'} half", *arrays)


@dataclass(frozen=True)
class Mounting:
    """What is wrong, by a fit."""

    turn_g: np.ndarray  # rotation vector of the camera against its stated mounting [rad], shape (3,), gimbal frame
    shift_g: np.ndarray  # of the lens [m], shape (3,), gimbal frame
    rows: float  # poses of row i + rows belong to the image of row i


NOMINAL = Mounting(np.zeros(3), np.zeros(3), 0.0)


def read_log(
    path: str | Path, params: CameraLogParams, columns: tuple[CsvParams, ...], frames: dict[str, FrameParams]
) -> CameraLog:
    """Read a recording.

    Args:
        path: CSV, plain or .gz.
        params: columns of the camera. columns: of vehicle and payload. frames: of both.

    Raises:
        SourceError: no such file or column, a body is missing, or too few rows.
    """
    by_body = {body: [p for p in read_csv(path, columns, frames[VEHICLE].quaternion) if p.body == body] for body in frames}
    if not by_body.get(VEHICLE) or not by_body.get(PAYLOAD) or by_body[VEHICLE][0].quat is None:
        raise SourceError(f"{path}: vehicle with attitude and payload are needed; source.columns names no such columns")
    vehicle, payload = (
        [Frames(frames[body]).pose_from_source(pose) for pose in by_body[body]] for body in (VEHICLE, PAYLOAD)
    )
    seen, gimbal = read_columns(path, params.seen), read_columns(path, params.gimbal)
    arrays = [np.array([p.pos for p in vehicle]), np.array([p.quat for p in vehicle]), np.array([p.pos for p in payload]),
              gimbal, seen]  # fmt: skip
    good = np.all([np.isfinite(a).all(axis=1) for a in arrays], axis=0)
    if good.sum() < PIECE:
        raise SourceError(f"{path}: {good.sum()} whole rows; expected {PIECE} or more, a column's unit or name may be wrong")
    return CameraLog(Path(path).name.split(".")[0], *(a[good] for a in arrays))


def turns(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices, shape (N, 3, 3), of quaternions xyzw, shape (N, 4)."""
    x, y, z, w = (quat / np.linalg.norm(quat, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, -1).reshape(-1, 3, 3)


def turn_of(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix, shape (3, 3), of a rotation vector [rad]."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def vector_of(turn: np.ndarray) -> np.ndarray:
    """Rotation vector [rad] of a rotation matrix below half a turn."""
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))
    return axis * (math.atan2(sine, 0.5 * (np.trace(turn) - 1.0)) / sine if sine > 1e-12 else 1.0)


def load_on_gimbal(log: CameraLog, params: CameraLogParams, rows: float) -> tuple[np.ndarray, np.ndarray]:
    """Load from the lens by the poses of other rows [m], gimbal frame, shape (M, 3), and which rows of the log they are."""
    at = np.arange(len(log.pos)) + rows
    inside = (at >= 0.0) & (at <= len(log.pos) - 1)
    low = np.minimum(np.floor(at[inside]).astype(int), len(log.pos) - 2)
    part = (at[inside] - low)[:, None]
    pos, load = (a[low] * (1 - part) + a[low + 1] * part for a in (log.pos, log.load))
    first, second = log.quat[low], log.quat[low + 1]
    second = np.where(np.sum(first * second, axis=1, keepdims=True) < 0.0, -second, second)
    rot_wb = turns(first * (1 - part) + second * part)
    b = np.einsum("nji,nj->ni", rot_wb, load - pos) - params.base_b
    (cx, cy), (sx, sy) = np.cos(log.gimbal[inside]).T, np.sin(log.gimbal[inside]).T
    # The transpose of Rx(a) Ry(b), row by row.
    g = np.column_stack(
        [cy * b[:, 0] + sy * (sx * b[:, 1] - cx * b[:, 2]), cx * b[:, 1] + sx * b[:, 2],
         sy * b[:, 0] - cy * (sx * b[:, 1] - cx * b[:, 2])]
    )  # fmt: skip
    return g - params.lens_g, inside


def projected(log: CameraLog, params: CameraLogParams, mounting: Mounting) -> tuple[np.ndarray, np.ndarray]:
    """Load in the camera frame by poses and mounting [m], shape (M, 3), and what was seen then, shape (M, 3)."""
    g, inside = load_on_gimbal(log, params, mounting.rows)
    rot_gc = turn_of(mounting.turn_g) @ rotation_of(params.axes)
    return (g - mounting.shift_g) @ rot_gc, log.seen[inside]


def fit_turn(from_g: np.ndarray, seen_g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn that brings what was seen, by the stated mounting, to where it is, robustly.

    Returns:
        Rotation matrix, shape (3, 3), and the weights, shape (M,).
    """
    weights, turn = np.ones(len(from_g)), np.eye(3)
    for _ in range(REWEIGHTINGS):
        u, _, vt = np.linalg.svd((from_g * weights[:, None]).T @ seen_g)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        weights = _weights(from_g - seen_g @ turn.T)
    return turn, weights


def fit_shift(from_g: np.ndarray, seen_g: np.ndarray) -> np.ndarray:
    """Shift of the lens that explains the difference best, robustly [m], shape (3,)."""
    shift = np.zeros(3)
    for _ in range(REWEIGHTINGS):
        weights = _weights(from_g - seen_g - shift)[:, None]
        shift = np.sum(weights * (from_g - seen_g), axis=0) / np.sum(weights)
    return shift


def _weights(residual: np.ndarray) -> np.ndarray:
    return 1.0 / np.sqrt(1.0 + np.sum(residual**2, axis=1) / SCALE**2)


def _cost(residual: np.ndarray) -> np.ndarray:
    """What `_weights` minimises, a row: quadratic near zero, linear far off [m^2]."""
    return 2.0 * SCALE**2 * (np.sqrt(1.0 + np.sum(residual**2, axis=1) / SCALE**2) - 1.0)


@dataclass(frozen=True)
class OffsetProfile:
    """Cost over offsets, whole and piece by piece."""

    best: float  # [rows]
    interval: tuple[float, float]  # 5 to 95 % of the best one over pieces drawn anew [rows]
    pieces: np.ndarray  # best of each piece [rows]
    cost: np.ndarray  # mean of a row at each of OFFSETS, the turn fitted anew [m^2]
    turns_g: np.ndarray  # fitted turn at each of OFFSETS [rad], shape (len(OFFSETS), 3)


def profile(log: CameraLog, params: CameraLogParams, turned: bool = True, seed: int = 0) -> OffsetProfile:
    """Find the offset between poses and camera.

    Args:
        log: to fit. params: its mounting.
        turned: fit the turn at each offset; else the stated mounting holds.
        seed: of the drawing of pieces.
    """
    margin = math.ceil(OFFSETS.max())
    pieces = max(1, (len(log.pos) - 2 * margin) // PIECE)
    costs, vectors = np.empty((len(OFFSETS), pieces)), np.zeros((len(OFFSETS), 3))
    seen_g = log.seen @ rotation_of(params.axes).T
    for i, rows in enumerate(OFFSETS):
        from_g, inside = load_on_gimbal(log, params, float(rows))
        there = seen_g[inside]
        turn = fit_turn(from_g, there)[0] if turned else np.eye(3)
        vectors[i] = vector_of(turn)
        whole = np.full(len(log.pos), np.nan)
        whole[inside] = _cost(from_g - there @ turn.T)
        costs[i] = whole[margin : margin + pieces * PIECE].reshape(pieces, -1).mean(axis=1)
    rng = np.random.default_rng(seed)
    drawn = [_lowest(costs[:, rng.integers(0, pieces, pieces)].mean(axis=1)) for _ in range(DRAWS)]
    low, high = np.percentile(drawn, (5, 95))
    mean = costs.mean(axis=1)
    return OffsetProfile(_lowest(mean), (float(low), float(high)), np.array([_lowest(c) for c in costs.T]), mean, vectors)


def _lowest(cost: np.ndarray) -> float:
    """Offset of the lowest cost, by a parabola through the lowest point and its neighbours."""
    i = int(np.clip(np.argmin(cost), 1, len(cost) - 2))
    a, b, c = cost[i - 1 : i + 2]
    bend = a - 2 * b + c
    step = OFFSETS[1] - OFFSETS[0]
    return float(OFFSETS[i] + step * np.clip(0.5 * (a - c) / bend if bend > 0.0 else 0.0, -1.0, 1.0))


def turn_spread(log: CameraLog, params: CameraLogParams, rows: float, seed: int = 0) -> np.ndarray:
    """Standard deviation of the fitted turn over pieces drawn anew [rad], shape (3,)."""
    from_g, inside = load_on_gimbal(log, params, rows)
    seen_g = log.seen[inside] @ rotation_of(params.axes).T
    weights = fit_turn(from_g, seen_g)[1]
    pieces = max(1, len(from_g) // PIECE)
    moments = np.array([
        (from_g[part] * weights[part, None]).T @ seen_g[part]
        for part in (slice(i * PIECE, (i + 1) * PIECE) for i in range(pieces))
    ])  # fmt: skip
    rng, found = np.random.default_rng(seed), []
    for _ in range(DRAWS):
        u, _, vt = np.linalg.svd(moments[rng.integers(0, pieces, pieces)].sum(axis=0))
        found.append(vector_of(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt))
    return np.std(found, axis=0)


def fit(log: CameraLog, params: CameraLogParams) -> tuple[dict[str, Mounting], OffsetProfile]:
    """Fit each cause alone and both together; what each explains is for recordings that were not fitted.

    Returns:
        Mountings by cause, and the profile of the offset.
    """
    from_g, inside = load_on_gimbal(log, params, 0.0)
    seen_g = log.seen[inside] @ rotation_of(params.axes).T
    none, both = np.zeros(3), profile(log, params)
    later, within = load_on_gimbal(log, params, both.best)
    turn = fit_turn(later, log.seen[within] @ rotation_of(params.axes).T)[0]
    return {
        "as stated": NOMINAL,
        "rows offset": Mounting(none, none, profile(log, params, turned=False).best),
        "camera turned": Mounting(vector_of(fit_turn(from_g, seen_g)[0]), none, 0.0),
        "camera turned, rows offset": Mounting(vector_of(turn), none, both.best),
        "lens shifted instead": Mounting(none, fit_shift(from_g, seen_g), 0.0),
    }, both


@dataclass(frozen=True)
class Residual:
    """How far apart projected and seen are."""

    rms: float  # [m]
    median: float  # [m]
    p95: float  # [m]
    angle_rms: float  # between the directions [rad]
    angle_median: float  # [rad]
    rows: int


def residual(log: CameraLog, params: CameraLogParams, mounting: Mounting) -> Residual:
    """Residual of a recording under a mounting."""
    where, seen = projected(log, params, mounting)
    off = np.linalg.norm(seen - where, axis=1)
    cross = np.linalg.norm(np.cross(seen, where), axis=1)
    angle = np.arctan2(cross, np.sum(seen * where, axis=1))
    median, p95 = np.percentile(off, (50, 95))
    return Residual(
        float(np.sqrt(np.mean(off**2))), float(median), float(p95), float(np.sqrt(np.mean(angle**2))),
        float(np.median(angle)), len(off),
    )  # fmt: skip


def split(logs: Sequence[CameraLog]) -> tuple[CameraLog, list[CameraLog]]:
    """The recording to fit, and those to judge on: the others, or where there is one alone its second half."""
    return (logs[0], list(logs[1:])) if len(logs) > 1 else (logs[0].half(False), [logs[0].half(True)])
