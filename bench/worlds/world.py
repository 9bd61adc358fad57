"""Draw a world, hide effects in it, fly it, and record it as a motion-capture hall would.

A world is a plant, hidden effects with their sizes in floors, gusts, sensor noise and flights: free
flights that together last a minute, and throws. Everything follows from one seed."""

import hashlib
import json
from dataclasses import asdict, dataclass, field

import numpy as np
from scipy.signal import butter, lfilter

from bench.worlds.camera import record_camera
from bench.worlds.fly import Flights, fly
from bench.worlds.numbers import CHANGES, LANDING_HEIGHT, hide
from bench.worlds.pilot import PERIOD, FreeFlight, Throw, Tracker
from bench.worlds.turns import matrix, quaternion, resample, small_turn

FLOORS = {
    "rope_length": 5e-4,
    "cmd_delay": 1e-3,
    "motor_tau": 1e-3,
    "release_lag": 2e-3,
    "payload_drag": 1e-4,
    "wind_x": 0.03,
    "wind_y": 0.03,
    "rotor_drag": 2e-3,
    "com_x": 1e-4,
    "com_y": 1e-4,
    "mount_x": 5e-4,
    "frame_tilt_x": 4e-4,
    "frame_tilt_y": 4e-4,
    "marker_rot_x": 6e-4,
    "marker_rot_y": 6e-4,
    "thrust_gain": 2e-3,
    "mass_quad": 3e-4,
    "mass_payload": 3e-4,
    "rate_gain": 1e-2,
    "inertia_x": 6e-3,
    "inertia_y": 6e-3,
    "motor_1": 2e-3,
    "motor_2": 2e-3,
    "motor_3": 2e-3,
    "motor_4": 2e-3,
    "mocap_delay_quad": 5e-4,
    "mocap_delay_payload": 5e-4,
    "translational_lift": 3e-4,
    "lag_tension": 2e-3,
    "rope_mass": 3e-4,
}
"""Size below which an effect does not matter, in SI units, relative for gains and inertias: 5 mm of
landing, or a tenth of the noise.
"""
CAMERA_FLOORS = {
    "camera_tilt_x": 6e-4,
    "camera_tilt_y": 6e-4,
    "camera_tilt_z": 6e-4,
    "camera_latency": 2e-4,
    "camera_line_time": 3e-6,
    "camera_focal": 2e-3,
    "camera_center_x": 0.5,
    "camera_center_y": 0.5,
    "camera_k1": 1e-3,
    "camera_lever_x": 2e-3,
    "camera_lever_y": 2e-3,
    "camera_lever_z": 2e-3,
    "keypoint_radius": 1e-2,
}
"""The same of the camera's effects, which show in worlds with a camera alone."""
ALL_FLOORS = FLOORS | CAMERA_FLOORS
ONE_SIDED = (
    "mocap_delay_quad",
    "mocap_delay_payload",
    "payload_drag",
    "rope_mass",
    "camera_latency",
)
"""Effects of one sign: measurements cannot come early, the model's payload has no drag to remove,
and its rope hardly any mass.
"""
PLANTS = ("chain", "string", "rod")
GUSTS = (0.015, 1.5e-4, 6e-4)
NOISE = {"pos": 5e-4, "att": np.radians(0.2), "ball": 8e-4, "volt": 2e-2}
RATE = 200.0
TIME = 0.03
CUTOFF = 15.0
TAILS = 3.0
HELD = 0.1
"""Of a sensor's noise: correlation time [s] where it is coloured, cut-off [Hz] of a second-order
filter, degrees of freedom of Student's distribution; share of frames that a tracker repeats.
"""
COLOURS = ("coloured", "filtered", "tails", "held")


@dataclass(frozen=True)
class Recipe:
    """What a world is made of; ``effects`` is the truth."""

    seed: int
    plant: str
    effects: dict[str, float] = field(default_factory=dict)
    floors: float = 0.0
    noise: float = 1.0
    gusts: float = 1.0
    dropouts: float = 0.0
    free: int = 6
    free_seconds: float = 10.0
    throws: int = 10
    held: int = 0  # held-out throws
    low: bool = False  # free flights near the ground
    camera: bool = False  # a camera looks down and a detector marks the goal and the ball
    colour: str = ""  # of the sensors' noise, one of COLOURS; white where empty
    # deviation of effects whose size is drawn anew for each flight
    varies: dict[str, float] = field(default_factory=dict)
    days: int = 0  # on which flights are flown by turns; then for each day, not for each flight
    lost: float = 0.0  # share of commands that never arrive
    # deviation of every other effect, in its floor: negligible effects that are present in every
    # hall
    dust: float = 0.0

    def digest(self) -> str:
        """SHA-256 of the truth, to be published before a verdict is read."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def draw(
    seed: int, count: int, floors: float, names=tuple(FLOORS), plants=PLANTS, **options
) -> Recipe:
    """A world with ``count`` effects of ``floors`` times their floor, of random sign where both are
    possible.
    """
    rng = np.random.default_rng(seed)
    plant = str(rng.choice(plants))
    chosen = rng.choice(names, size=count, replace=False) if count else []
    signs = np.where(np.isin(chosen, ONE_SIDED), 1.0, rng.choice([-1.0, 1.0], len(chosen)))
    sizes = rng.uniform(0.9, 1.1, len(chosen)) * floors * signs
    return Recipe(
        seed,
        plant,
        {str(n): float(s * ALL_FLOORS[n]) for n, s in zip(chosen, sizes)},
        floors if count else 0.0,
        **options,
    )


def dust_of(recipe: Recipe) -> dict[str, float]:
    """Sizes of the negligible effects, which must not be named."""
    if not recipe.dust:
        return {}
    sizes = recipe.dust * np.random.default_rng([recipe.seed, 6]).standard_normal(len(FLOORS))
    return {
        name: float(FLOORS[name] * (abs(size) if name in ONE_SIDED else size))
        for name, size in zip(FLOORS, sizes)
        if name not in recipe.effects
    }


def build_world(recipe: Recipe):
    """Numbers of the recipe's world. The string's ball is a point."""
    world = hide(recipe.effects | dust_of(recipe))
    if recipe.plant == "string":
        world.ball_inertia = 0.0
    return world


def worlds_of(recipe: Recipe, first: int, count: int) -> list:
    """The worlds of some flights, each with its drawn effects."""
    out = []
    for flight in range(first, first + count):
        rng = np.random.default_rng(
            [recipe.seed, 8, flight % recipe.days if recipe.days else flight]
        )
        sizes = {
            name: float(deviation * rng.standard_normal())
            for name, deviation in recipe.varies.items()
        }
        world = build_world(recipe)
        for name, size in sizes.items():
            CHANGES[name](world, size)
        out.append(world)
    return out


def sensor_noise(rng: np.random.Generator, colour: str, shape: tuple[int, int]) -> np.ndarray:
    """Noise of deviation 1 of evenly sampled components, shape (T, C)."""
    if colour == "tails":
        return rng.standard_t(TAILS, shape) / np.sqrt(TAILS / (TAILS - 2.0))
    if colour not in ("coloured", "filtered"):
        return rng.normal(size=shape)
    before = 200  # samples until it is stationary
    white = rng.normal(size=(shape[0] + before, shape[1]))
    a = np.exp(-1.0 / (RATE * TIME))
    low, high = (
        butter(2, CUTOFF / (RATE / 2.0))
        if colour == "filtered"
        else ([np.sqrt(1.0 - a * a)], [1.0, -a])
    )
    out = lfilter(low, high, white, axis=0)[before:]
    answer = lfilter(low, high, np.eye(1, 4000)[0])
    return out / np.sqrt(np.sum(answer**2))


def lanes_of(recipe: Recipe, rng: np.random.Generator):
    """References of all flights: free ones, then throws at rising speeds, then held-out ones."""
    free = [
        FreeFlight(rng, height=0.75 if recipe.low else 1.9, speed=0.5 if recipe.low else 1.0)
        for _ in range(recipe.free)
    ]
    speeds = np.linspace(5.0, 11.0, max(recipe.throws, 1))
    speeds = [*speeds[: recipe.throws], *rng.uniform(5.5, 10.5, recipe.held)]
    return free, [Throw(rng, s, rng.uniform(-np.pi, np.pi)) for s in speeds]


def fly_recipe(recipe: Recipe) -> list[Flights]:
    """Fly the world: one :class:`Flights` of the free flights, one of the throws."""
    rng = np.random.default_rng(recipe.seed + 1)
    known = hide({})
    out = []
    first = 0
    for lanes, seconds in zip(lanes_of(recipe, rng), (recipe.free_seconds, 2.6)):
        if lanes:
            pilot = Tracker(lanes, known.mass, known.ball_mass + known.rope_mass, rng)
            gusts = [recipe.gusts * g for g in GUSTS]
            used = rng.uniform(0.0, 0.4, len(lanes))
            worlds = worlds_of(recipe, first, len(lanes))
            out.append(
                fly(
                    recipe.plant,
                    worlds,
                    pilot.command,
                    lanes,
                    seconds,
                    gusts,
                    recipe.seed + 2,
                    used,
                    recipe.lost,
                )
            )
            first += len(lanes)
    return out


def record_flights(recipe: Recipe, flights: list[Flights]) -> list[dict]:
    """Recordings of each flight: plain arrays, SI units, quaternions wxyz; NaN where a frame was
    lost.

    Keys: ``time``, ``pos``, ``quat``, ``ball`` (200 Hz); ``sent_time``, ``sent`` (N, rad/s),
    ``volt`` [V]; ``release`` (its time or None); ``truth_landing``, which no log holds. With a
    camera, also the recordings of :func:`bench.worlds.camera.record_camera`."""
    rng, eye, meter = (
        np.random.default_rng(seed)
        for seed in (recipe.seed + 3, [recipe.seed, 4], [recipe.seed, 5])
    )
    w = build_world(recipe)
    tilt = small_turn(w.frame_tilt)
    turn = small_turn(w.marker_turn)
    out = []
    for f in flights:
        for e in range(len(f.pos)):
            t = np.arange(0.02, f.time[-1] - 1e-9, 1 / RATE)
            q = resample(f.time, f.quat[e], t - w.quad_stamp)
            rot = matrix(q / np.linalg.norm(q, axis=1, keepdims=True))
            pos = (
                (1 + w.frame_scale)
                * (resample(f.time, f.pos[e], t - w.quad_stamp) + rot @ w.marker_off)
                @ tilt.T
            )
            ball = (1 + w.frame_scale) * resample(f.time, f.ball[e], t - w.ball_stamp) @ tilt.T
            noise = small_turn(
                recipe.noise * NOISE["att"] * sensor_noise(rng, recipe.colour, (len(t), 3))
            )
            quat = quaternion(tilt @ rot @ turn @ noise)
            pos = pos + recipe.noise * NOISE["pos"] * sensor_noise(rng, recipe.colour, pos.shape)
            ball = ball + recipe.noise * NOISE["ball"] * sensor_noise(
                rng, recipe.colour, ball.shape
            )
            down = np.flatnonzero(f.ball[e][:, 2] <= LANDING_HEIGHT)
            landed = f.time[down[0]] if len(down) else np.inf
            ball[t > landed] = np.nan
            if recipe.colour == "held":
                fresh = np.maximum.accumulate(
                    np.where(rng.random(len(t)) < HELD, 0, np.arange(len(t)))
                )
                pos = pos[fresh]
                quat = quat[fresh]
                ball = ball[fresh]
            lost = rng.random(len(t)) < recipe.dropouts
            pos[lost] = np.nan
            quat[lost] = np.nan
            ball[lost] = np.nan
            release = f.release_at[e] if np.isfinite(f.release_at[e]) else None
            out.append(
                {
                    "time": t,
                    "pos": pos,
                    "quat": quat,
                    "ball": ball,
                    "sent_time": np.arange(f.commands.shape[1]) * PERIOD,
                    "sent": f.commands[e],
                    "release": release,
                    "volt": f.volt[e] + NOISE["volt"] * meter.normal(size=f.volt[e].shape),
                    "truth_landing": f.ball[e][down[0]] if len(down) else None,
                }
            )
            if recipe.camera:
                aim = (f.ball[e][down[0]] if len(down) else np.zeros(3)) + eye.uniform(-0.5, 0.5, 3)
                out[-1] |= record_camera(
                    f, e, aim * [1.0, 1.0, 0.0], landed, w, recipe.noise, recipe.dropouts, eye
                )
    return out
