"""The replay: the simulator's own flights come back, events fall where they should, lanes do not
see each other.
"""

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import fixture, raises
from scipy.spatial.transform import Rotation

from sim.effects.setting import Setting, generalise
from sim.hybrid import HybridSim
from sim.kernels.replay import kernel as rk
from sim.kernels.replay.lanes import _BUILDS, Recording, Replay
from sim.params import SensingParams, change_values
from tests.plants import EVERYTHING, paper_plant

PERIODS, RELEASED_AT = 40, 20
ROUNDING = 1e-11  # m, rad: of the same operations in another order, after 400 steps in float64


def plant():
    """The paper's plant in float64: its delay of 22 ms and its lag of 110 ms end steps of 2 ms, in
    both simulators alike.
    """
    return change_values(paper_plant(), {"sim.precision": "float64"})


def one(value):
    return np.array([value])


@fixture(scope="module")
def flight():
    """A flight of the simulator: start, commands, and states at the ends of the periods."""
    sim = HybridSim(plant(), 1, extensions=EVERYTHING)
    tilt = np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    sim.place(pos_w=np.array([[0.0, 0.0, 1.5]]), cable_dir_w=np.tile(tilt, (1, 15, 1)))
    fields = [name for name in rk.STATE_FIELDS if not name.startswith(("payload", "slack"))]
    start = {name: sim.get(name) for name in fields} | {"payload_pos_w": sim.get("payload_pos_w")}
    start |= {
        "payload_vel_w": sim.get("payload_vel_w"),
        "slack_first": np.zeros(1),
        "slack_last": np.zeros(1),
    }
    times, commands = [-1.0], [sim.get("queue")[0, 0]]
    recorded = {name: [] for name in ("pos_w", "quat_wb", "payload_pos_w", "rate_b")}
    for k in range(PERIODS):
        times.append(0.02 * k)
        thrust = 2.6 * (1 + 0.2 * np.sin(0.4 * k))
        commands.append(np.array([thrust, 1.5 * np.sin(0.3 * k), 1.5 * np.cos(0.2 * k), 0.3]))
        sim.set_command(commands[-1][None], one(k == RELEASED_AT))
        sim.step()
        for name, values in recorded.items():
            values.append(sim.get(name)[0].copy())
    return (
        start,
        np.array(times),
        np.array(commands),
        {name: np.array(values) for name, values in recorded.items()},
    )


def replay(flight, plants, sensings=None, count=1, stamps=None, end=0.02 * PERIODS, **lane):
    """Replay the flight in some lanes; returns the recorded vectors by group, each (stamps, lanes,
    3), and all outputs.
    """
    start, times, commands, recorded = flight
    stamps = 0.02 * (1 + np.arange(PERIODS)) if stamps is None else stamps
    hanging = stamps <= 0.02 * RELEASED_AT + 0.1
    quats = recorded["quat_wb"][np.clip(np.round(stamps / 0.02).astype(int) - 1, 0, PERIODS - 1)]
    data = {
        "command_time": times,
        "command": commands,
        "vehicle_time": stamps,
        "vehicle_quat": quats,
        "payload_time": stamps[hanging],
        "gyro_time": stamps,
    }
    n, m = len(stamps), int(hanging.sum())
    windows = {
        "start": 0.0,
        "end": end,
        "first_knot": 0.0,
        "knots": 9,
        "payload": rk.ATTACHED,
        "latch": 0.02 * RELEASED_AT,
        "clock_zero": 0.0,
        "command_first": 0,
        "command_last": len(times),
        "vehicle_first": 0,
        "vehicle_count": n,
        "payload_first": 0,
        "payload_count": m,
        "gyro_first": 0,
        "gyro_count": n,
    }
    lanes = {
        "window": 0,
        "plant": 0,
        "state": 0,
        "axis": -1,
        "knot": 0,
        "size": 0.0,
        "substep": 0.002,
        "keep": -1,
        "resume": -1,
        "parent": -1,
        "shared": 0,
        "skip": -1,
    } | lane
    lanes = {name: np.broadcast_to(value, count).copy() for name, value in lanes.items()}
    plants = [generalise(Setting(p)).plant for p in plants]  # as a diagnosis flies them
    engine = Replay(plants, sensings or [SensingParams()] * len(plants))
    flown = engine.run(
        start, Recording({k: one(v) for k, v in windows.items()}, data), lanes, 0.1, 9
    )
    out = flown.samples
    return {
        "pos": out[0 : 2 * n : 2],
        "turn": out[1 : 2 * n : 2],
        "payload": out[2 * n : 2 * n + m],
        "rate": out[2 * n + m : 3 * n + m],
    }, flown


def test_replay_is_the_simulator(flight):
    replayed, _ = replay(flight, [plant()])
    truth = flight[3]
    assert np.abs(replayed["pos"][:, 0] - truth["pos_w"]).max() < ROUNDING
    assert np.abs(replayed["turn"]).max() < ROUNDING
    assert (
        np.abs(replayed["payload"][:, 0] - truth["payload_pos_w"][: len(replayed["payload"])]).max()
        < ROUNDING
    )
    assert np.abs(replayed["rate"][:, 0] - truth["rate_b"]).max() < 1e3 * ROUNDING
    assert all(len(build.replay.module.execs) == 1 for build in _BUILDS.values()), "compiled once"


def test_commands_switch_where_they_should(flight):
    """A delay longer by a tenth of a substep moves the flight as its derivative says: nothing is
    rounded to steps.
    """
    late = [0.0, 2e-4, 2e-3]
    plants = [change_values(plant(), {"vehicle.queue.delay": 0.022 + x}) for x in late]
    replayed, _ = replay(flight, plants, count=3, plant=np.arange(3))
    small, large = ((replayed["pos"][:, i] - replayed["pos"][:, 0]) / late[i] for i in (1, 2))
    assert np.abs(large - small).max() < 0.05 * np.abs(large).max()


def test_a_command_that_does_not_come_leaves_the_one_before(flight):
    """A lane that skips a command flies as though the log held the one before in its place."""
    start, times, commands, truth = flight
    skipped = np.array([5, 12])
    replayed, _ = replay(flight, [plant()], count=2, skip=skipped)
    for lane, number in enumerate(skipped):
        held = commands.copy()
        held[number] = held[number - 1]
        assert norm(held - commands) > 0.01
        expected, _ = replay((start, times, held, truth), [plant()])
        for name, values in expected.items():
            assert_array_equal(replayed[name][:, lane], values[:, 0])


def test_release_falls_between_steps(flight):
    """The payload's path bends at latch plus lag, to a fraction of a substep."""
    lags = [0.1037, 0.1038]
    plants = [change_values(plant(), {"release.lag": x}) for x in lags]
    ends = replay(flight, plants, count=2, plant=np.arange(2), keep=np.array([0, 0]))[1].ends
    shift = ends["payload_pos_w"][1] - ends["payload_pos_w"][0]
    assert 0.0 < norm(shift) < 1e-3
    half = [change_values(plant(), {"release.lag": 0.10375})]
    middle = replay(flight, half, keep=0)[1].ends["payload_pos_w"][0] - ends["payload_pos_w"][0]
    assert_allclose(middle, 0.5 * shift, rtol=0.02, atol=1e-9)


def test_lanes_do_not_see_each_other(flight, monkeypatch):
    monkeypatch.setattr("sim.kernels.replay.lanes.cores", lambda: 2)
    heavy = change_values(plant(), {"rope.payload_mass": 0.08})
    rows = np.array([0, 1, 0, 1, 1, 0, 0])
    replayed, _ = replay(flight, [plant(), heavy], count=7, plant=rows)
    alone = [replay(flight, [x])[0]["pos"][:, 0] for x in (plant(), heavy)]
    for i, row in enumerate(rows):
        assert_array_equal(replayed["pos"][:, i], alone[row])
    assert np.abs(alone[0] - alone[1]).max() > 1e-3


def test_latent_forces_push(flight):
    """A constant force on the vehicle, made of all its triangles, is gravity changed by it."""
    force = 0.01
    mass = plant().vehicle.body.mass
    knots = np.arange(9)
    replayed, _ = replay(
        flight,
        [plant()],
        count=10,
        axis=np.append(np.full(9, 2), -1),
        knot=np.append(knots, 0),
        size=np.append(np.full(9, force), 0.0),
    )
    pushed = np.sum(replayed["pos"][:, :9] - replayed["pos"][:, 9:], axis=1)
    early = 0.02 * (1 + np.arange(PERIODS)) < 0.12  # before the rope answers
    time = 0.02 * (1 + np.arange(PERIODS))[early]
    hanging = plant().rope.payload_mass + plant().rope.rope_mass
    low, high = 0.5 * force / (mass + hanging) * time**2, 0.5 * force / mass * time**2
    assert np.all((pushed[early, 2] > 0.9 * low) & (pushed[early, 2] < 1.1 * high))


def test_sensors(flight):
    x = SensingParams(
        vehicle_delay=0.003,
        payload_delay=0.004,
        frame_tilt=(0.02, -0.01, 0.03),
        marker_rotation=(0.01, 0.02, -0.03),
        marker_offset=(0.01, -0.02, 0.03),
        payload_offset=(0.001, 0.002, 0.003),
        scale=0.01,
        gyro_bias=(0.1, 0.2, 0.3),
    )
    stamps = 0.02 * (2 + np.arange(PERIODS - 4))
    replayed, _ = replay(flight, [plant()], [x], stamps=stamps)
    vehicle, payload, gyro = (
        replay(flight, [plant()], stamps=stamps - late)[0] for late in (0.003, 0.004, 0.0)
    )
    measured = Rotation.from_quat(flight[3]["quat_wb"][1 : 1 + len(stamps)])
    attitude = measured * Rotation.from_rotvec(vehicle["turn"][:, 0])
    frame, marker = Rotation.from_rotvec(x.frame_tilt), Rotation.from_rotvec(x.marker_rotation)
    expected = 1.01 * frame.apply(vehicle["pos"][:, 0] + attitude.apply(x.marker_offset))
    assert_allclose(replayed["pos"][:, 0], expected, atol=1e-9)
    turn = (measured.inv() * frame * attitude * marker).as_rotvec()
    assert_allclose(replayed["turn"][:, 0], turn, atol=1e-9)
    hanging = payload["payload"][: len(replayed["payload"]), 0]
    expected = 1.01 * frame.apply(hanging + x.payload_offset)
    assert_allclose(replayed["payload"][:, 0], expected, atol=1e-9)
    turning = replayed["rate"][:, 0] - gyro["rate"][:, 0]
    assert_allclose(turning, np.tile(x.gyro_bias, (len(stamps), 1)), atol=1e-9)


def com_velocity(ends):
    """Velocity of the centre of mass of payload and loose rope at the end of a lane [m/s]."""
    rope = plant().rope
    u, link, rod = ends["cable_vel_w"][0], rope.length / 15, rope.rope_mass / 15
    below = np.array(
        [(rope.payload_mass + rod * (14 - i)) * link + rod * link / 2 for i in range(15)]
    )
    below[-1] += rope.payload_mass * rope.payload_offset
    root = ends["payload_vel_w"][0] - link * u.sum(0) - rope.payload_offset * u[-1]
    return root + (below[:, None] * u).sum(0) / (rope.payload_mass + rope.rope_mass)


def test_rope_that_leaves_falls_with_the_payload(flight):
    """The centre of mass of payload and loose rope is a projectile; the payload, which the rope
    tugs at, is not.
    """
    tail = change_values(plant(), {"release.rope_tail": 1.0})
    early, late = (
        replay(flight, [tail], keep=0, stamps=np.array([0.4]), end=end)[1].ends
        for end in (0.56, 0.78)
    )
    fallen = 0.22 * np.array([0.0, 0.0, -9.81])
    assert_allclose(com_velocity(late) - com_velocity(early), fallen, atol=1e-9)
    assert norm(late["payload_vel_w"][0] - early["payload_vel_w"][0] - fallen) > 1e-4


def test_mixed_segments_are_refused():
    rigid = change_values(plant(), {"rope.segments": 1})
    with raises(ValueError, match="one number of segments"):
        Replay([plant(), rigid], [SensingParams()] * 2)
