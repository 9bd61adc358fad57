"""Logs of small vehicles with equations and integrators of their own: a thrown ball, and a
quadrotor with or without a payload.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from visthrow.logs.flightlog import Channel, FlightLog

G = 9.81
TIGHT = {"rtol": 1e-10, "atol": 1e-12}

LATE = -0.005
"""The test's motors follow a smooth command; its samples, held for a period, lag by half a sample
[s].
"""


def attitude(time: np.ndarray) -> Rotation:
    angles = np.column_stack(
        [0.6 * np.sin(0.5 * time), 0.35 * np.sin(2.3 * time + 1), 0.35 * np.sin(1.7 * time)]
    )
    return Rotation.from_euler("ZYX", angles)


def fly(
    seconds=6.0,
    gain=1.0,
    drag=0.0,
    cable=None,
    payload_drag=0.0,
    volts_slope=0.0,
    noise=2e-4,
    seed=0,
    *,
    wind=0.0,
    late=0.0,
    fade=0.0,
    swirl=0.0,
    beat=0.0,
    downwash=0.0,
    mount=(0.0, 0.0, 0.0),
) -> FlightLog:
    """A vehicle with a closed-form attitude and motors that hold it up; equations and integrator
    share no code with the package.
    """
    rng = np.random.default_rng(seed)
    mass = 0.03
    payload = 0.008
    step = 0.005
    load = mass + (payload if cable else 0.0)
    phases = rng.uniform(0, 6, 2)
    half = np.arange(0.0, seconds + step, 0.5 * step)
    begin = 10.0 * seed  # no two flights turn alike
    rot = attitude(half + begin).as_matrix()
    demand = (
        load
        * G
        / rot[:, 2, 2]
        * (1.0 + 0.15 * np.sin(3.1 * half + phases[0]) + 0.1 * np.sin(1.3 * half + phases[1]))
    )
    volts = 4.1 - 0.05 * half
    level = gain * (1.0 + volts_slope * (volts - 3.8)) * (1.0 + fade * half)

    near = [attitude(half + begin + shift).apply(mount) for shift in (-1e-3, 0.0, 1e-3)]
    arm_rate = (near[2] - near[0]) / 2e-3
    arm_acc = (near[2] - 2.0 * near[1] + near[0]) / 1e-6

    # another vehicle, which passes above
    above = np.column_stack([3.0 * np.sin(0.9 * half + phases[0]), np.cos(half), 6.0 + 0.0 * half])

    def slope(i, state):
        p = state[:3]
        v = state[3:6]
        thrust = state[6]
        body = rot[i].T @ (v - [wind, 0.0, 0.0])
        force = rot[i] @ np.array([-drag * body[0], -drag * body[1], thrust * level[i]]) - [
            0,
            0,
            mass * G,
        ]
        apart = p - above[i]
        force = force + downwash * apart[2] / np.sum(apart**2) * np.array([0.0, 0.0, 1.0])
        force = force + [swirl * v[1], beat * np.sin(4.5 * half[i]) - swirl * v[0], 0.0]
        lag = [(demand[i] - thrust) / 0.03]
        if cable is None:
            return np.concatenate([v, force / mass, lag])
        vp = state[10:13]
        gap = state[7:10] - p - near[1][i]
        rate = vp - v - arm_rate[i]
        along = gap / np.sqrt(gap @ gap)
        weight = -payload_drag * np.sqrt(vp @ vp) * vp - [0, 0, payload * G]
        apart = weight / payload - force / mass - arm_acc[i]
        pull = (along @ apart + rate @ rate / cable) / (1 / mass + 1 / payload)
        return np.concatenate(
            [v, (force + pull * along) / mass, lag, vp, (weight - pull * along) / payload]
        )

    state = np.array([0, 0, 5.0, 0, 0, 0, demand[0]])
    if cable:
        hung = near[1][0] + [0.1 * cable, 0, 5.0 - cable * np.sqrt(0.99)]
        state = np.concatenate([state, hung, arm_rate[0]])
    path = [state]
    for i in range(0, len(half) - 2, 2):
        k1 = slope(i, state)
        k2 = slope(i + 1, state + 0.5 * step * k1)
        k3 = slope(i + 1, state + 0.5 * step * k2)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + slope(i + 2, state + step * k3))
        path.append(state)
    path, time = np.array(path)[::2], half[::4][: len(path[::2])]
    thrust = demand[::4][: len(time)] / 4.0
    command = (-0.06 + np.sqrt(0.06**2 + 0.4 * thrust)) / 0.2

    def measure(columns):
        return Channel(time, columns + rng.normal(0, noise, (len(time), 3)), "m", "world")

    channels = {
        "pos_w": measure(path[:, :3]),
        "quat_wb": Channel(time, attitude(time + begin - late).as_quat(), "1", "world"),
        "motor_command": Channel(time, np.tile(command[:, None], 4), "1"),
        "battery_voltage": Channel(time, 4.1 - 0.05 * time, "V"),
    }
    if downwash:
        channels["neighbour_pos_w"] = Channel(time, above[::4][: len(time)], "m", "world")
    return FlightLog(channels | ({"payload_pos_w": measure(path[:, 7:10])} if cable else {}))


def ball_log(
    drag=0.0, wind=(0.0, 0.0), spin=(0.0, 0.0, 0.0), noise=1e-4, seed=0, heading=0.0
) -> FlightLog:
    """A throw, held before and after: scipy's integrator."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(2.5, 4.0)
    start = np.array([0, 0, 1.5, speed * np.cos(heading), speed * np.sin(heading), 2.5])

    def slope(_, state):
        air = state[3:] - [*wind, 0.0]
        return [*state[3:], *(-drag * np.linalg.norm(air) * air + np.cross(spin, air) + [0, 0, -G])]

    time = np.arange(0.0, 0.8, 1 / 240)
    path = solve_ivp(slope, (0, 0.8), start, t_eval=time, **TIGHT).y[:3].T
    rest = np.arange(1, 60) / 240
    time = np.concatenate([time, 0.8 + rest])
    path = np.concatenate([path, np.tile(path[-1], (len(rest), 1))])
    return FlightLog(
        {"payload_pos_w": Channel(time, path + rng.normal(0, noise, path.shape), "m", "world")}
    )
