"""Worlds of another author's generator: a quadrotor with a ball on a cable, flown by another
controller, for named vehicles.

    python -m bench.diagnose.foreign --seeds bench/diagnose/banks/foreign.txt --jobs 6 --ledger
    foreign.jsonl

Written from the equations alone: bodies in maximal coordinates with the cable as a constraint
(Udwadia and Kalaba 1992), the controller of Lee, Leok and McClamroch 2010, rotors with a lag,
Runge-Kutta steps. Noise, sampling and names are its own. A world hides one effect, none, or a force
outside the catalogue; the tool gets the vehicle's numbers as its owner would know them.

Each line of the seed list is a seed; vehicle, kind and size follow from it. A list is used once:
faults that it shows are mended on other seeds. The worlds of ``banks/foreign.txt`` were flown
without drag, so that no wind could show, and knew one foreign force."""

import argparse
import json
import multiprocessing as mp
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visthrow.common.errors import VisthrowError
from visthrow.diagnose.models.catalogue import effects_of
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import CableParams, FlyerParams
from visthrow.diagnose.select import diagnose_flights
from visthrow.logs.flightlog import Channel, FlightLog

G = 9.80665  # [m/s^2]
TICK = 0.01  # between commands [s]
STEP = 5e-3  # of the integration [s]
SHOT = 1.0 / 120.0  # between pictures [s]
# configs/vehicle and configs/rope; body [kg, kg m^2], full thrust [N], lag [s], rotor drag [kg/s],
# cable [m], ball [kg]
CRAFT = {
    "crazyflie": dict(
        body=0.0393,
        J=(2.4e-5, 2.4e-5, 3.2e-5),
        top=0.8,
        lag=0.025,
        drag=0.01,
        cable=0.5,
        ball=0.0054,
    ),
    "five_inch": dict(
        body=0.6, J=(3e-3, 3e-3, 5e-3), top=38.0, lag=0.03, drag=0.15, cable=0.7, ball=0.08
    ),
}
HIDDEN = {
    "thrust_gain": "gain",
    "mass_quad": "body",
    "motor_tau": "lag",
    "cmd_delay": "late",
    "rotor_drag_xy": "drag",
    "parasitic": "square",
    "wind_x": "wind",
    "pose_delay": "stamp",
    "frame_tilt_y": "tilt",
    "marker_x": "arm",
    "rope_length": "cable",
    "mass_payload": "ball",
    "payload_drag": "ball_square",
    "payload_delay": "ball_stamp",
}
"""Effect of the catalogue -> number of a world that it changes."""
ALIKE = (
    {"thrust_gain", "mass_quad"},
    {"frame_tilt_y", "marker_rot_y", "wind_x"},
    {"motor_tau", "cmd_delay", "pose_delay"},
)
"""Effects that such flights hardly distinguish: a class is right if it holds the truth and lies
within one of these.
"""
FOREIGN = ("swirl", "beat", "wake", "side")
"""Forces on the vehicle outside the catalogue: across its velocity; periodic in time; by its past
velocity; sideways by its direction.
"""
STRENGTH = {"swirl": 0.25, "beat": 0.2, "wake": 0.25, "side": 0.15}
"""In the whole mass: [1/s], [m/s^2], [1/s], [m/s^2]."""
REMEMBERS = 0.5  # [s]
BEATS = 4.5  # [rad/s]
ONE_SIDED = ("cmd_delay", "parasitic", "payload_drag")
FLIGHTS = 4
FLOORS = 10.0


def draw_world(seed: int) -> tuple[str, str, dict[str, float]]:
    """Vehicle, what is hidden ("" for nothing), and the world's numbers."""
    rng = np.random.default_rng([20261124, seed])
    name = ("crazyflie", "five_inch")[seed // 6 % 2]
    kind = ("", FOREIGN[seed // 12 % len(FOREIGN)], *[None] * 4)[seed % 6]
    base = CRAFT[name]
    usual = dict.fromkeys(
        ("late", "square", "wind", "stamp", "tilt", "arm", "ball_square", "ball_stamp", *FOREIGN),
        0.0,
    )
    world = (
        usual
        | {key: base[key] for key in ("body", "lag", "drag", "cable", "ball", "top")}
        | {"gain": 1.0, "J": np.array(base["J"])}
    )
    if kind in FOREIGN:
        world[kind] = STRENGTH[kind] * (base["body"] + base["ball"]) * rng.choice([-1.0, 1.0])
    elif kind is None:
        kind = str(rng.choice(list(HIDDEN)))
        floor = next(e.floor for e in effects_of("flyer", describe_vehicle(name)) if e.name == kind)
        world[HIDDEN[kind]] += (
            FLOORS * floor * (1.0 if kind in ONE_SIDED else rng.choice([-1.0, 1.0]))
        )
    return name, kind, world


def describe_vehicle(name: str) -> FlyerParams:
    """The vehicle's numbers as its owner knows them."""
    c = CRAFT[name]
    return FlyerParams(
        input="thrust_command",
        position="pos_w",
        attitude="quat_wb",
        mass=c["body"],
        gravity=G,
        thrust_map=(0.0, c["top"], 0.0),
        motor_time_constant=c["lag"],
        command_delay=0.0,
        reference_voltage=4.0,
        voltage_coefficient=0.0,
        drag_xy=c["drag"],
        drag_z=0.0,
        lowest=0.3,
        window=1.0,
        step=0.02,
        every=3,
        most_windows=32,
        cable=CableParams(c["cable"], c["ball"]),
    )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors: numpy's takes ten times as long."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def fly_lissajous(world: dict, rng: np.random.Generator, seconds: float = 12.0) -> FlightLog:
    """One flight along a Lissajous figure, as its owner records it."""
    M = world["body"]
    m = world["ball"]
    L = world["cable"]
    J = world["J"]
    swing = rng.uniform(0.4, 0.9, 3) * [1.0, 1.0, 0.35]
    beat = rng.uniform(0.9, 2.2, 3)
    turned = rng.uniform(0.0, 2.0 * np.pi, 4)

    def reference(t: float) -> np.ndarray:
        """Place, speed and acceleration, shape (3, 3)."""
        a = beat * t + turned[:3]
        fade = 1.0 - np.exp(-t * t)
        return fade * swing * np.array([np.sin(a), beat * np.cos(a), -beat * beat * np.sin(a)]) + [
            [0.0, 0.0, 2.0],
            [0.0] * 3,
            [0.0] * 3,
        ]

    def slope(t: float, y: np.ndarray, sent: np.ndarray, torque: np.ndarray) -> np.ndarray:
        r = y[:3]
        p = y[3:6]
        v = y[6:9]
        u = y[9:12]
        q = y[12:16]
        w = y[16:19]
        f = y[19]
        past = y[20:23]
        turn = Rotation.from_quat(q).as_matrix()
        air = v - [world["wind"], 0.0, 0.0]
        ball_air = u - [world["wind"], 0.0, 0.0]
        across = turn.T @ air * [1.0, 1.0, 0.0]
        push = (
            turn @ (np.array([0.0, 0.0, world["gain"] * f]) - world["drag"] * across)
            - world["square"] * np.linalg.norm(air) * air
        )
        push = (
            push
            + world["swirl"] * np.array([v[1], -v[0], 0.0])
            + [0.0, world["beat"] * np.sin(BEATS * t), -M * G]
        )
        push = (
            push
            + world["wake"] * np.array([-past[1], past[0], 0.0])
            + [0.0, world["side"] * np.tanh(5.0 * v[0]), 0.0]
        )
        pull = -world["ball_square"] * np.linalg.norm(ball_air) * ball_air - np.array(
            [0.0, 0.0, m * G]
        )
        gap, rate = (
            p - r,
            u - v,
        )  # |gap|^2 = L^2: gap . (p'' - r'') = -|rate|^2, and back to it where rounding left it
        along = (
            gap @ (pull / m - push / M)
            + rate @ rate
            + 40.0 * gap @ rate
            + 200.0 * (gap @ gap - L * L)
        )
        tie = max(along / (gap @ gap) / (1.0 / m + 1.0 / M), 0.0) * gap
        demanded = sent[1][max(np.searchsorted(sent[0], t - world["late"], "right") - 1, 0)]
        spun = 0.5 * np.array([*(q[3] * w + cross(q, w)), -q[:3] @ w])
        turning = (torque - cross(w, J * w)) / J
        changes = (
            v,
            u,
            (push + tie) / M,
            (pull - tie) / m,
            spun,
            turning,
            [(demanded - f) / world["lag"]],
            (v - past) / REMEMBERS,
        )
        return np.concatenate(changes)

    start = reference(0.0)[0]
    hold = (M + m) * G / world["gain"]
    y = np.concatenate(
        [start, start - [0, 0, L], np.zeros(6), [0, 0, 0, 1.0], np.zeros(3), [hold], np.zeros(3)]
    )
    times = TICK * np.arange(round(seconds / TICK))
    sent = []
    path = [y]
    for t in times:
        place, speed, pushed = reference(t)
        force = (M + m) * (4.0 * (place - y[:3]) + 3.5 * (speed - y[6:9]) + pushed + [0.0, 0.0, G])
        turn = Rotation.from_quat(y[12:16]).as_matrix()
        up = force / np.linalg.norm(force)
        head = 0.4 * np.sin(0.5 * t + turned[3])
        left = np.cross(up, [np.cos(head), np.sin(head), 0.0])
        left /= np.linalg.norm(left)
        aim = np.column_stack([np.cross(left, up), left, up])
        off = 0.5 * (aim.T @ turn - turn.T @ aim)
        torque = J * (-160.0 * np.array([off[2, 1], off[0, 2], off[1, 0]]) - 20.0 * y[16:19])
        sent.append(float(np.clip(force @ turn[:, 2], 0.05, world["top"])))
        held = np.array([times[: len(sent)], sent])
        for begin in t + STEP * np.arange(round(TICK / STEP)):
            k1 = slope(begin, y, held, torque)
            k2 = slope(begin + 0.5 * STEP, y + 0.5 * STEP * k1, held, torque)
            k3 = slope(begin + 0.5 * STEP, y + 0.5 * STEP * k2, held, torque)
            y = y + STEP / 6.0 * (
                k1 + 2.0 * (k2 + k3) + slope(begin + STEP, y + STEP * k3, held, torque)
            )
        y[12:16] /= np.linalg.norm(y[12:16])
        path.append(y)
    return record_poses(
        world, np.append(times, seconds), np.array(path), times, np.array(sent), rng
    )


def record_poses(
    world: dict,
    clock: np.ndarray,
    path: np.ndarray,
    times: np.ndarray,
    sent: np.ndarray,
    rng: np.random.Generator,
) -> FlightLog:
    """The capture's poses at its rate, with double exponential noise, rounded to a tenth of a
    millimetre; the throttle as sent.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Slerp

    shots = np.arange(0.05, clock[-1] - 0.05, SHOT) + 0.002 * rng.uniform()
    spline = CubicSpline(clock, path[:, :6])
    slerp = Slerp(clock, Rotation.from_quat(path[:, 12:16]))
    tilt = Rotation.from_rotvec([0.0, world["tilt"], 0.0])
    turn = slerp(shots)
    vehicle = tilt.apply(
        spline(shots - world["stamp"])[:, :3]
        + slerp(shots - world["stamp"]).apply([world["arm"], 0.0, 0.0])
    )
    ball = tilt.apply(spline(shots - world["ball_stamp"])[:, 3:])
    vehicle, ball = (np.round(x + rng.laplace(0.0, 2e-4, x.shape), 4) for x in (vehicle, ball))
    quat = (tilt * turn * Rotation.from_rotvec(rng.laplace(0.0, 6e-4, (len(shots), 3)))).as_quat()
    return FlightLog(
        {
            "pos_w": Channel(shots, vehicle, "m", "world"),
            "payload_pos_w": Channel(shots, ball, "m", "world"),
            "quat_wb": Channel(shots, quat, "1", "world"),
            "thrust_command": Channel(times, sent[:, None] / world["top"], "N"),
        }
    )


def diagnose_world(seed: int) -> dict:
    """Fly a world and diagnose it; returns a line of the ledger."""
    name, hidden, world = draw_world(seed)
    line = {"seed": seed, "vehicle": name, "hidden": hidden}
    begin = time.process_time()
    try:
        logs = [fly_lissajous(world, np.random.default_rng([seed, i])) for i in range(FLIGHTS)]
        diagnosis = diagnose_flights.explain(FlyerModel(logs, describe_vehicle(name)), seed=seed)
    except (VisthrowError, ValueError, FloatingPointError) as error:
        return line | {"verdict": "failed", "why": str(error)[:200]}
    groups = [{f.name, *f.partners} for f in diagnosis.findings if f.name in diagnosis.theta]
    return line | {
        "verdict": diagnosis.overall,
        "groups": [sorted(g) for g in groups],
        "laws": [law.formula for law in diagnosis.laws[:1]],
        "judged": judge_answer(hidden, groups, diagnosis.overall),
        "seconds": time.process_time() - begin,
    }


def judge_answer(hidden: str, groups: list[set[str]], overall: str) -> str:
    """Judgement of an answer: right, class, missed or false; for a force outside the catalogue
    unknown, or part where names are given beside it.
    """
    if not hidden:
        return "false" if groups else "right" if overall == "NO EFFECT" else "unsure"
    if hidden in FOREIGN:
        if overall in ("UNKNOWN", "EXPLAINED IN PART"):
            return "part" if groups else "unknown"
        return "false" if groups else "missed"
    hits = [g for g in groups if hidden in g]
    if not hits:
        return "false" if groups else "missed"
    fits = hits[0] == {hidden} or any(hits[0] <= alike for alike in ALIKE)
    return (
        ("right" if hits[0] == {hidden} else "class")
        if fits and all(hidden in g for g in groups)
        else "false"
    )


def main() -> None:
    """Diagnose the world of every seed of a list; writes a line for each, and prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--ledger", type=Path, required=True)
    args = parser.parse_args()
    seeds = [int(line) for line in args.seeds.read_text().split()]
    count: Counter[tuple[str, str]] = Counter()
    with (
        mp.get_context("spawn").Pool(args.jobs, maxtasksperchild=4) as pool,
        args.ledger.open("a") as ledger,
    ):
        for line in pool.imap_unordered(diagnose_world, seeds):
            ledger.write(json.dumps(line) + "\n")
            ledger.flush()
            count[
                line["hidden"] if line["hidden"] in ("", *FOREIGN) else "hidden",
                line.get("judged", "failed"),
            ] += 1
    for (kind, judged_), number in sorted(count.items()):
        print(f"{kind or 'null':8} {judged_:8} {number}")


if __name__ == "__main__":
    main()
