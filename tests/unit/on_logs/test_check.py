"""`visthrow diagnose check`: a flight of closed forms, and every fault of its log."""

import json
import re
from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from bench import delays
from tests.commands import run_command
from tests.flightlogs import (
    DELAY,
    UNITS,
    G,
    flight,
    level_log,
    log_at,
    log_of,
    upright,
    with_channels,
)
from visthrow.diagnose.inputs.setup import VELOCITIES, describe_vehicle
from visthrow.diagnose.select.diagnose_flights import diagnose, find_refused
from visthrow.logs.check import physics, thrust_checks
from visthrow.logs.check.excitation import QUESTIONS, excitation
from visthrow.logs.check.relations import relate
from visthrow.logs.check.rows import NOTHING, KnownVehicle
from visthrow.logs.check.run import check, contradictions, table
from visthrow.logs.check.signals import look, noise
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.samples import Samples


def faults(log: FlightLog, verdict: str = "bad", vehicle: KnownVehicle = NOTHING) -> str:
    """Topics, channels and words of all rows with a verdict."""
    (checked,) = check([log], vehicle)
    return " | ".join(
        f"{r.topic} {r.channel}: {r.text}"
        for r in checked.rows
        if r.verdict == verdict and r.topic != "answers"
    )


def test_a_good_flight_has_nothing_wrong():
    (checked,) = check([log_of(flight())])
    assert checked.verdict == "ok", table(checked)
    answers = {row.channel: row.verdict for row in checked.rows if row.topic == "answers"}
    assert answers["rotor drag"] == answers["wind against frame tilt"] == "ok"
    assert answers["battery sag"] == "warn"
    assert "mirrored y" not in answers
    (delay,) = [r for r in checked.rows if r.topic == "delay" and r.channel == "command, rate_b"]
    assert delay.figures["delay_s"] == approx(DELAY, abs=0.003)


@mark.parametrize(
    ("factor", "word"), [(1.3, ""), (0.5, "half"), (0.0, "sensor is dead"), (2.0, "twice")]
)
def test_a_rotor_that_reads_unlike_the_others_is_named(factor, word):
    columns = flight()
    speeds = np.tile(1000.0 + 20.0 * np.sin(columns["time"])[:, None], (1, 4))
    speeds[:, 2] *= factor
    text = faults(log_of(columns, motor_speed=Channel(columns["time"], speeds, "rad/s")))
    named = re.findall(r"(\w+ \w+) reads (\S+) of the others", text)
    assert named == [("rear left", f"{factor:.2f}")] * bool(word)
    assert word in text


def test_telemetry_at_3_hz_is_of_no_other_flight():
    log = log_of({name: values[::33] for name, values in flight(120.0).items()})
    doubts = faults(log, "warn")
    assert "of another flight" not in faults(log) + doubts
    assert "too seldom to be held against the force" in doubts


def test_thrust_in_pulses_follows_past_a_crash():
    """A flight of pulses from 1000 us that begins on the ground and ends upside down on it."""
    columns = flight(40.0)
    time = columns["time"]
    thrust = columns.pop("command")[:, :1]
    ground = time < 5.0
    fallen = time > 38.0
    pulses = 1000.0 + 200.0 * np.repeat(thrust, 4, axis=1)
    columns["acc_b"][ground] = [0.0, 0.0, G]
    columns["acc_b"][fallen] = [0.0, 0.0, -3.0 * G]
    del columns["pos_w"], columns["vel_w"]
    pulses[ground] = 1000.0
    log = log_of(columns, motor_output=Channel(time, pulses, "us", "none"))
    row = next(row for row in thrust_checks.look(log) if "acc_b" in row.channel)
    assert row.verdict == "ok", row.text
    assert row.figures["correlation"] > 0.5


def test_a_thrown_payload_is_no_other_scale_of_the_thrust():
    """Half of the time without a payload that was a third of the whole: beside a flight that keeps
    it its thrust carries the same mass.
    """
    columns = flight()
    gone = columns["time"] > 0.5 * columns["time"][-1]
    lighter = {**columns, "command": columns["command"] * np.where(gone, 2.0 / 3.0, 1.0)[:, None]}
    kept = log_of(flight(seed=1))
    attached = Channel(columns["time"], ~gone, "bool")
    pressed = Channel(columns["time"], gone, "1")
    known = ({"attached": attached}, {"release_command": pressed}, {})
    tables = ["".join(map(table, check([kept, log_of(lighter, **more)]))) for more in known]
    assert ["the thrust's scale differs" in text for text in tables] == [False, False, True]


@mark.parametrize(
    ("channel", "factor", "words"),
    [
        ("rate_b", 180 / np.pi, "units degrees"),
        ("rate_b", np.pi / 180, "units degrees"),
        ("acc_b", 1 / G, "units in g"),
        ("vel_w", 1000.0, "units thousandths"),
        ("pos_w", 1000.0, "units thousandths"),
        ("pos_w", 1e-3, ""),
        ("quat_wb", [-1, -1, -1, 1], "frames"),  # turned around
        ("rate_b", [1, -1, -1], "(x,-y,-z)"),
    ],
)
def test_wrong_units_and_signs(channel, factor, words):
    columns = flight()
    columns[channel] *= factor
    text = faults(log_of(columns))
    assert text
    assert all(word in text for word in words.split(" ", 1)), text


@mark.parametrize("channel", ["rate_b", "vel_w", "acc_b"])
@mark.parametrize(
    ("order", "signs"), [((1, 0, 2), (1, 1, 1)), ((0, 1, 2), (1, -1, -1)), ((0, 2, 1), (1, 1, 1))]
)
def test_wrong_axes(channel, order, signs):
    columns = flight()
    columns[channel] = columns[channel][:, order] * signs
    text = faults(log_of(columns))
    if channel == "acc_b" and order == (1, 0, 2):
        return  # gravity alone does not distinguish x from y
    assert "frames" in text, text
    assert channel in text


@mark.parametrize("unread", [(), ("acc_b",)])
@mark.parametrize(("turned_deg", "refused"), [(3.0, False), (-10.0, True)])
def test_a_path_turned_beside_its_attitude_is_refused(unread, turned_deg, refused):
    columns = {name: values for name, values in flight().items() if name not in unread}
    turn = Rotation.from_euler("z", turned_deg, degrees=True)
    turned = {name: turn.apply(columns[name]) for name in ("pos_w", "vel_w")}
    (checked,) = check([log_of(columns | turned)])
    said = [r.figures["turned_deg"] for r in checked.rows if r.figures.get("of") == "path"]
    assert said == [approx(turned_deg, abs=0.5)] * refused


@mark.parametrize(
    ("channel", "rows", "change", "verdict", "words"),
    [
        ("quat_wb", slice(None), lambda q: q[:, [3, 0, 1, 2]], "bad", "frames"),  # wxyz
        ("quat_wb", slice(None, None, 2), lambda q: 0.0 * q, "bad", "quaternions of length 0"),
        ("command", slice(None), lambda c: c[:, [0, 2, 1, 3]], "bad", "commands as (y,x,z)"),
        ("pos_w", slice(500, 600), lambda p: p[0], "warn", "to the last digit for 0.99 s"),
        ("pos_w", 700, lambda p: p + 2.0, "warn", "2 jumps, the largest"),
        ("acc_b", slice(None), lambda a: np.clip(a, -3, 11), "warn", "saturated"),
    ],
)
def test_spoilt_samples_are_named(channel, rows, change, verdict, words):
    columns = flight()
    columns[channel][rows] = change(columns[channel][rows])
    assert words in faults(log_of(columns), verdict)


@mark.parametrize(("gain", "refused"), [(0.1, False), (0.0175, True)])
def test_rates_that_follow_with_a_small_gain_are_in_no_other_unit(gain, refused):
    columns = flight(20.0)
    columns["command"][:, 1:] /= gain
    assert ("the rates follow" in faults(log_of(columns))) == refused


def test_scrambled_commands_are_caught():
    columns = flight(40.0)
    columns["command"] = flight(40.0, seed=5)["command"]
    assert "command, rate_b: the rates do not follow" in faults(log_of(columns))


def test_a_hover_and_a_force_that_no_model_has_refuse_no_log():
    """Thrust that hardly varies does not show its clock; inflow is no delay."""
    columns = flight(20.0)
    level = (columns["vel_w"][:, :2] ** 2).sum(1)
    columns["command"][:, 0] *= 1.0 - 0.01 * level
    assert not faults(log_of(columns))
    columns = flight(40.0, scale=0.02)
    assert not faults(log_of(columns))
    columns["command"][:, 0] *= 1.0 + 0.05 * np.sin(0.2 * columns["time"])  # as a pack sags
    assert "cannot be judged" in faults(log_of(columns), "warn")


def test_a_mirror_image_of_motion_in_a_plane_cannot_be_told():
    time = np.arange(0.0, 20.0, 0.01)
    vel = np.sin(np.outer(time, [1.9, 0.0, 1.1]))
    turn = upright(np.gradient(vel, time, axis=0) + [0.0, 0.0, G])
    rows = physics.look(log_at(time, vel_w=vel, quat_wb=turn.as_quat()))
    assert [row.channel for row in rows if row.topic == "answers"] == ["mirrored y"]


@mark.parametrize("seed", range(6))
def test_a_good_flight_of_any_shape_is_not_refused(seed):
    """Other rates, sizes, noise, origins and stamps, seldom samples and gaps."""
    rng = default_rng([2611, seed])
    rate = float(rng.choice([20.0, 50.0, 120.0]))
    columns = flight(12.0, rate, seed=seed, scale=float(rng.choice([0.05, 0.3, 1.5])))
    columns["pos_w"] += rng.uniform(-50.0, 50.0, 3)
    for name, size in (("pos_w", 2e-3), ("rate_b", 0.1), ("acc_b", 1.0)):
        columns[name] += rng.uniform() * rng.normal(0.0, size, columns[name].shape)
    columns["time"] += float(rng.choice([-30.0, 1.7e9]))
    kept = {}
    for name, channel in log_of(columns).channels.items():
        elapsed = channel.time - columns["time"][0]
        every = np.arange(len(elapsed)) % rng.integers(1, 4) == 0
        kept[name] = channel.only(every & ((elapsed < 5.0) | (elapsed > 5.5)))
    assert not contradictions(check([FlightLog(kept)]), VELOCITIES)


def test_a_late_channel_that_no_model_reads_refuses_no_log():
    columns = flight(20.0)
    late = Channel(columns["time"] + 0.06, columns.pop("vel_w"), "m/s", "world")
    checked = check([log_of(columns, vel_w=late)])
    assert "vel_w" in contradictions(checked)[0]
    assert not contradictions(checked, VELOCITIES)
    assert find_refused(checked) == (0,)
    assert find_refused(checked, describe_vehicle(None)) == ()


def test_a_late_attitude_refuses_a_log_by_the_velocity_that_follows_its_position():
    """No model reads the velocity, which alone is exact enough to distinguish the clocks."""
    logs = []
    for seed, late in ((1, 0.0), (2, 0.1)):
        columns = flight(20.0, seed=seed)
        time = columns["time"] + late
        airborne = {
            name: Channel(time, columns.pop(name), *UNITS[name])
            for name in ("quat_wb", "rate_b", "acc_b", "command")
        }
        logs.append(log_of(columns, **airborne))
    assert find_refused(check(logs), describe_vehicle(None)) == (1,)
    (reason,) = contradictions(check(logs), VELOCITIES)
    assert "d(vel_w)/dt, quat_wb acc_b: the second is +" in reason
    assert "streams on clocks apart" in reason


def test_a_contradiction_is_reported_before_a_model_is_built():
    columns = flight()
    columns["rate_b"] *= 57.3

    def build():
        raise AssertionError("the model was built")

    assert diagnose([log_of(columns)], build).overall == "DATA INCONSISTENT"


def test_a_pose_stream_of_another_clock_is_reported():
    columns = flight()
    path = Samples(columns["time"], columns["pos_w"])
    columns["est_pos_w"] = path.at(path.time - 0.035)
    (checked,) = check([log_of(columns)])
    (row,) = [r for r in checked.rows if (r.channel, r.verdict) == ("pos_w, est_pos_w", "warn")]
    assert row.figures["delay_s"] == approx(0.035, abs=0.002)


def carry_payload() -> dict[str, np.ndarray]:
    """Columns of a vehicle that carries a payload along a smooth path, on a cable without mass."""
    time = np.arange(0.0, 10.0, 0.01)
    below = 0.5 * np.sin(np.outer(time, [1.9, 2.3, 1.1]) + [0.0, 1.0, 2.0]) + [0, 0, 2]

    def pull(path: np.ndarray) -> np.ndarray:
        return np.gradient(np.gradient(path, time, axis=0), time, axis=0) + [0, 0, G]

    hung = pull(below)
    above = below + 0.5 * hung / norm(hung, axis=1, keepdims=True)
    thrust = 0.8 * pull(above) + 0.2 * hung
    turn = upright(thrust)
    rng = default_rng(3)
    columns = {"time": time, "pos_w": above, "payload_pos_w": below}
    noisy = {n: v + rng.normal(0, 3e-4, v.shape) for n, v in columns.items() if n != "time"}
    return {"time": time, "quat_wb": turn.as_quat(), **noisy}


def test_positions_with_exchanged_axes_are_caught_below_a_payload():
    columns = carry_payload()
    assert not faults(log_of(columns))
    swapped = {n: columns[n][:, [1, 0, 2]] for n in ("pos_w", "payload_pos_w")}
    assert "fit with (y,x,z) of positions" in faults(log_of(columns | swapped))


@mark.parametrize(
    ("late", "verdict", "words"),
    [
        (0.5, "bad", "the commands' clock is late"),
        (-0.15, "warn", "the commands' clock early?"),
        (0.12, "bad", "the stream of the thrust is about"),
    ],
)
def test_commands_on_another_clock_than_the_flight_are_caught(late, verdict, words):
    columns = flight()
    moved = Channel(columns["time"] + late, columns["command"], *UNITS["command"])
    assert words in faults(log_of(columns, command=moved), verdict)


def test_commands_that_oppose_a_swing_are_not_late():
    """Angles that a disturbance swings, and a controller that commands rates against them: as good
    as behind the commands is a mirror image that goes before them.
    """
    rng = default_rng(13)
    time = np.arange(0.0, 30.0, 0.01)
    periods = rng.uniform(0.5, 1.5, 3)
    gain, lag, width = rng.uniform([2.0, 0.02, 0.02], [6.0, 0.1, 0.3])
    push = []
    for period in periods:
        wander = np.interp(time, np.arange(31.0), rng.normal(size=31))
        turns = 0.01 * np.cumsum(1.0 + width * wander) / period
        push.append(20.0 * np.sin(2.0 * np.pi * turns + rng.uniform(0.0, 6.0)))
    angle = rate = np.zeros(3)
    rows = []
    for pushed in np.transpose(push) * [1.0, 1.0, 0.3]:
        rate_command = -gain * angle
        rate = rate + 0.01 * ((rate_command - rate) / lag + pushed)
        angle = angle + 0.01 * rate
        rows.append((2.0, *rate_command, *rate))
    columns = np.array(rows)
    rates = columns[:, 4:] + rng.normal(0.0, 0.01, (len(time), 3))
    log = log_of({"time": time, "command": columns[:, :4], "rate_b": rates})
    assert "clock is late" not in faults(log)


@mark.parametrize(
    ("late", "step", "reported"),
    [
        (-0.03, 0.01, False),
        (0.02, 0.01, False),
        (0.3, 0.01, True),
        (0.0, 0.2, False),  # a command that is logged seldom
        (0.3, 0.2, True),
    ],
)
def test_a_payload_that_leaves_before_its_command_is_reported(late, step, reported):
    columns = carry_payload()
    gone = np.maximum(columns["time"] - 6.0, 0.0)
    columns["payload_pos_w"] -= np.outer(gone, [2.4, 0.0, 3.2])
    stamps = np.arange(step - 0.01, 10.0, step)
    pressed = Channel(stamps, (stamps > 6.0 + late).astype(float), "1")
    text = faults(log_of(columns, release_command=pressed))
    assert ("before its release is commanded" in text) == reported


def test_a_payload_that_waits_on_the_floor_does_not_leave_before_its_command():
    columns = carry_payload()
    time = columns["time"]
    floor = time < 6.0
    columns["payload_pos_w"][floor] = columns["pos_w"][floor] + [0.15, 0.0, 0.0]
    columns["payload_pos_w"] -= np.outer(np.maximum(time - 8.0, 0.0), [2.4, 0.0, 3.2])
    pressed = Channel(time, (time > 8.0).astype(float), "1")
    assert "before its release" not in faults(log_of(columns, release_command=pressed))


def test_a_drifting_clock_is_reported():
    columns = flight(40.0)
    path = Samples(columns["time"], columns["pos_w"])
    columns["est_pos_w"] = path.at(path.time * 1.001)
    match = re.search(r"the delay runs from (\S+) to (\S+) ms", faults(log_of(columns), "warn"))
    # pieces about 32.5 and 2.5 s, of a clock that gains a millisecond a second
    assert float(match[1]) == approx(-32.5, abs=3.0)
    assert float(match[2]) == approx(-2.5, abs=1.0)


def test_deviations_of_delays_hold_what_they_say():
    """80 motions, seeds that nothing was chosen by; 95 % +- 2.4 % of truths within 1.96 sd."""
    cases = [delays.measure(seed, kind) for seed in range(5000, 5020) for kind in delays.KINDS]
    assert np.mean([abs(error) < 1.96 * sd for error, sd in cases]) >= 0.88


@mark.parametrize("width", [0.05, 0.3])
def test_a_delay_that_noise_hides_is_not_reported(width):
    """Slow motion of one message: no delay, and no deviation of a few milliseconds."""
    for seed in range(6):
        rng, time = default_rng(seed), np.arange(0.0, 20.0, 0.02)
        pos = np.outer(np.sin(0.3 * time), [width, 0.0, 0.0])
        vel = np.outer(np.cos(0.3 * time), [0.3 * width, 0.0, 0.0])
        pos, vel = pos + rng.normal(0, 1e-3, pos.shape), vel + rng.normal(0, 5e-3, vel.shape)
        relation = relate(Samples(time, pos).derivative(), Samples(time, vel))
        assert abs(relation.delay) < 2.0 * relation.delay_sd


@mark.parametrize(("count", "clipped", "reported"), [(60, 0, False), (60, 6, True), (40, 0, False)])
def test_the_least_of_few_samples_is_no_rail(count, clipped, reported):
    values = default_rng(0).normal(0.0, 1.0, (count, 3))
    values[:clipped, 0] = np.max(values)
    log = log_at(0.02 * np.arange(count), rate_b=values)
    assert ("saturated" in faults(log, "warn")) == reported


def test_gaps_and_clocks():
    columns = flight()
    keep = np.ones(len(columns["time"]), bool)
    keep[300:420] = False
    text = faults(log_of({name: values[keep] for name, values in columns.items()}), "warn")
    assert "the longest 1.21" in text
    time = np.r_[0:30, 90] / 9.0
    held = Channel(time, time, "V")
    assert [row.verdict for row in look("battery_voltage", held, {"held": 9})] == ["ok"]
    columns = flight()
    columns["time"] += default_rng(0).uniform(-0.004, 0.004, len(columns["time"]))
    assert "clock" in faults(log_of(columns), "warn")
    columns = flight()
    other = Channel(columns["time"] + 500.0, columns["pos_w"], "m", "world")
    assert "never overlap" in faults(log_of(columns, est_pos_w=other))


def test_copies_are_found_whatever_their_stamps():
    first, second = flight(), flight(seed=1)
    copy = dict(first, time=first["time"] + 7.0)
    part = {name: values[400:1200] for name, values in first.items()}
    results = check(list(map(log_of, (first, second, copy, part))))
    marked = [any(r.topic == "duplicates" for r in result.rows) for result in results]
    assert marked == [False, False, True, True]


def test_a_standing_vehicle_answers_nothing():
    columns = flight(scale=1e-6)
    (checked,) = check([log_of(dict(columns, motor_command=np.zeros((len(columns["time"]), 4))))])
    assert "never left its place" in table(checked)
    assert all(r.verdict == "warn" for r in checked.rows if r.topic == "answers")


def test_a_payload_on_the_floor_is_not_frozen_and_not_on_the_cable():
    columns = flight()
    payload = columns["pos_w"] - [0.0, 0.0, 0.4]
    payload[600:] = payload[600]
    time = columns["time"]
    landing = Channel(time[600:601], payload[600:601], "m", "world")
    attached = Channel(time, time < time[550], "bool")
    columns["payload_pos_w"] = payload
    assert not faults(log_of(columns, landing=landing, attached=attached))
    assert "stands still" in faults(log_of(columns))


def test_explain_names_nothing_where_channels_contradict_each_other(tmp_path, capsys):
    columns = flight()
    columns["rate_b"] *= 57.3
    log_of(columns).save(tmp_path / "a.npz")
    run_command(f"diagnose explain {tmp_path}/a.npz --no-report --json {tmp_path}/a.json")
    assert "DATA INCONSISTENT" in capsys.readouterr().out
    answer = json.loads((tmp_path / "a.json").read_text())
    assert answer["overall"] == "DATA INCONSISTENT"
    bad = [row.name for row in check([log_of(columns)])[0].rows if row.verdict == "bad"]
    assert all(any(f": {name}: " in reason for reason in answer["reasons"]) for name in bad)
    assert not contradictions(check([log_of(columns)]), frozenset(bad))
    command = f"diagnose explain {tmp_path}/a.npz --no-report --overrule"
    assert run_command(command, "units nothing") == 2
    error = capsys.readouterr().err
    assert "no bad row 'units nothing' of check" in error
    assert bad[0] in error


@mark.parametrize(
    ("rate", "times", "compared"), [(4.4, 1.0, True), (0.2, 1.0, False), (4.4, 1.5, False)]
)
def test_clocks_are_compared_where_one_noisy_payload_moves_fast_enough(rate, times, compared):
    """Tracks with 1.5 mm of noise: of one that swings fast, of one that drifts, and of two."""
    time = np.arange(0.0, 30.0, 0.01)
    swing = 0.1 * np.column_stack([np.sin(rate * time), np.cos(rate * time), 0.0 * time])
    logs = []
    for seed, late in ((0, 0.0), (1, 0.02)):
        noise = default_rng(seed).normal(0.0, 1.5e-3, swing.shape)
        logs.append(log_at(time + late, payload_pos_w=times**seed * swing + noise))
    delays = [r.figures["delay_s"] for r in check(logs)[1].rows if "rms_m" in r.figures]
    assert delays == ([approx(0.02, abs=3e-3)] if compared else [])


def test_bodies_exchanged():
    columns = flight()
    for above in (0.4, -0.4):
        columns["payload_pos_w"] = columns["pos_w"] + [0, 0, above]
        assert ("bodies exchanged" in faults(log_of(columns))) == (above > 0)


def test_order_of_motors():
    columns = flight()
    turning = np.gradient(columns["rate_b"], columns["time"], axis=0)
    roll, pitch = 0.01 * turning[:, :1], 0.01 * turning[:, 1:2]
    right = 0.5 + np.hstack([roll - pitch, -roll - pitch, roll + pitch, -roll + pitch])
    noisy = right + default_rng(0).normal(size=right.shape)
    good, swapped, loose = (
        log_of(dict(columns, motor_command=motors))
        for motors in (right, right[:, [1, 0, 3, 2]], noisy)
    )
    assert "order of the motors" not in faults(good)
    assert "roll turns against the motors" in faults(swapped)
    assert "too loosely" in faults(loose, "warn")


@mark.parametrize("count", [1, 2, 3, 19])
def test_too_short(count):
    columns = {name: values[:count] for name, values in flight().items()}
    assert "at least 20" in faults(log_of(columns))


def test_an_autopilot_that_says_once_that_it_flies_is_no_fault():
    log = log_of(flight(), flying=Channel([2.0], [True], "bool"))
    assert check([log])[0].verdict == "ok"


def test_no_more_seconds_are_flown_than_were_logged():
    """Samples in pairs: the median step is half of the mean one, or twice."""
    columns = flight(20.0, scale=0.1)
    for nearer in (0.004, 0.016):
        columns["time"] = np.arange(2000) // 2 * 0.02 + np.arange(2000) % 2 * nearer
        figures = excitation(log_of(columns))
        assert figures["seconds_flown"] == approx(figures["seconds"], abs=0.1)


def test_a_flight_that_excites_everything_answers_every_question():
    """No question asks for a channel or a figure that does not exist."""
    columns = flight(20.0)
    time = columns["time"]
    columns["pos_w"] -= [0.0, 0.0, 2.9]
    angle = 0.5 * np.sin(4.0 * time)
    cable = 0.4 * np.column_stack([np.sin(angle), 0.0 * time, -np.cos(angle)])
    columns["payload_pos_w"] = columns["pos_w"] + cable
    columns["motor_command"] = np.repeat(columns["command"][:, :1] / 4.0, 4, axis=1)
    log = log_of(
        columns,
        battery_voltage=Channel(time, 16.0 - 0.05 * time, "V"),
        release_command=Channel(time, time > 15.0, "1"),
        keypoints=Channel(time, np.zeros((len(time), 8, 2)), "1", "image"),
    )
    answers = {row.channel: row.text for row in check([log])[0].rows if row.topic == "answers"}
    assert answers == {question.name: "can be answered" for question in QUESTIONS}


def test_long_and_constant_logs():
    zero = np.zeros((72_000, 3))
    log = log_at(0.1 * np.arange(72_000), pos_w=zero, rate_b=zero)
    assert "one value from beginning to end" in faults(log)
    assert "long" in faults(log, "warn")


def test_invalid_channels_do_not_stop_it():
    columns = flight()
    pos = log_of(columns)["pos_w"]
    none = replace(pos, valid=~pos.valid)
    assert "valid" in faults(log_of(columns, est_pos_w=none))
    assert check([FlightLog({})])[0].verdict == "bad"


def test_command_line(tmp_path, capsys):
    log_of(flight(6.0)).save(tmp_path / "a.npz")
    pictures = f"--out {tmp_path} --json {tmp_path}/a.json"
    assert run_command(f"diagnose check {tmp_path}/a.npz {pictures}") == 0
    assert "a.npz: ok" in capsys.readouterr().out
    assert (tmp_path / "01-a.npz.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "a.json").read_text())["logs"][0]["verdict"] == "ok"
    assert run_command(f"diagnose check {tmp_path}/b.npz") == 2
    FlightLog({}).save(tmp_path / "empty.npz")
    command = f"diagnose check {tmp_path}/a.npz {tmp_path}/empty.npz --no-pictures"
    lengths = []
    for more in ("", "--all"):
        assert run_command(f"{command} {more}") == 1, "one bad log is enough"
        lengths.append(len(capsys.readouterr().out.splitlines()))
    assert lengths[1] > lengths[0]


def test_the_plant_says_how_long_the_cable_must_be(tmp_path, capsys):
    columns = flight(6.0)
    columns["payload_pos_w"] = columns["pos_w"] - [0.0, 0.0, 0.9]
    log_of(columns).save(tmp_path / "a.npz")
    for plant, reported in (("", False), ("--plant state", True)):
        run_command(f"diagnose check {tmp_path}/a.npz --no-pictures {plant}")
        assert ("another cable" in capsys.readouterr().out) == reported


def test_a_setup_for_tables_alone_is_refused_where_no_log_is_a_table(
    tmp_path, monkeypatch, refused
):
    """A flying model's cable and mass are of use without a table; a mapping is not, and is not
    ignored in silence.
    """
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        log_of(flight()).save(tmp_path / f"{name}.npz")
    mapping = (
        '[table.time]\ncolumn = "t"\n[[table.channels]]\nname = "current"\ncolumns = ["i"]\nunit ='
        ' "A"\n'
    )
    (tmp_path / "mine.toml").write_text(f'about = "a table"\n{mapping}')
    (tmp_path / "t.csv").write_text("t,i\n" + "".join(f"{0.01 * n},{n % 7}\n" for n in range(200)))
    check_with = "diagnose check --no-pictures --config"
    unused = "is not used: it states how to read the columns of a table"
    for words in ("mine.toml a.npz", "mine.toml a.npz+b.npz", "pendulum_encoder a.npz"):
        refused(f"{check_with} {words}", message=unused)
    refused("diagnose explain a.npz --config mine.toml", message=unused)
    refused(
        "diagnose explain t.csv --config mine.toml",
        message="where that holds a model, such as [flyer]",
    )
    for words in ("mine.toml a.npz t.csv", "cf_payload a.npz"):
        assert run_command(f"{check_with} {words}") in (0, 1)


@mark.parametrize(("mass", "hangs"), [(0.15, True), (0.25, False)])
def test_a_thrust_that_carries_more_than_the_model_weighs_hints_at_a_load(mass, hangs):
    rows = thrust_checks.look(log_of(flight(20.0)), KnownVehicle(mass=mass))
    (row,) = [row for row in rows if row.topic == "thrust"]
    assert row.verdict == "warn"
    assert ("hangs below" in row.text) == hangs


@mark.parametrize(("times", "verdict"), [(1.0, "ok"), (0.01, "bad"), (45.0, "bad")])
def test_a_map_that_carries_no_vehicle_is_found_by_the_path(times, verdict):
    """Without an accelerometer, across two jumps of the capture."""
    columns = flight(20.0)
    columns["pos_w"][700:720] += [0.0, 0.0, 0.4]
    speeds = np.tile(500.0 * np.sqrt(columns["command"][:, :1]), 4)
    log = log_of(columns, motor_speed=Channel(columns["time"], speeds, "rad/s"))
    for name in ("acc_b", "vel_w"):
        del log.channels[name]
    vehicle = KnownVehicle(mass=0.2, thrust_input="motor_speed", thrust_map=(0.0, 0.0, times / 1e6))
    rows = [row for row in thrust_checks.look(log, vehicle) if "path" in row.channel]
    (row,) = [row for row in rows if row.topic in ("thrust", "units")]
    assert row.verdict == verdict
    assert row.figures["mass_kg"] == approx(0.2 * times, rel=0.05)


@mark.parametrize("jump_deg", [0.0, 95.0])
def test_a_reset_of_an_attitude_makes_its_rates_no_other_flights(jump_deg):
    """An autopilot turns its estimate about the vertical when it first knows north."""
    columns = flight(20.0, scale=0.05)
    turned = Rotation.from_euler("z", jump_deg, degrees=True)
    early = columns["time"] < 1.2
    before = turned * Rotation.from_quat(columns["quat_wb"][early])
    columns["quat_wb"][early] = before.as_quat()
    rows = [row for row in physics.look(log_of(columns)) if "rate_b" in row.channel]
    assert {row.verdict for row in rows} == {"ok"}


@mark.parametrize(("count", "judged"), [(20, False), (60, True)])
def test_few_samples_of_an_accelerometer_say_nothing_of_gravity(count, judged):
    time = np.arange(0.0, 2.0, 0.02)
    log = level_log(time, np.zeros((len(time), 3)))
    force = Channel(time[:count], np.tile([0.0, 0.0, 5.0], (count, 1)), *UNITS["acc_b"])
    rows = physics.look(with_channels(log, acc_b=force))
    assert any("mean force" in row.text for row in rows) == judged


def test_delays_of_pieces_that_noise_hides_are_no_drift():
    """Pieces of a slow motion agree, but each measures its delay to 50 ms at best."""
    rng, time = default_rng(0), np.arange(0.0, 40.0, 0.01)
    pos = np.column_stack([np.sin(time), np.cos(time), 0.0 * time])
    noisy = [pos + rng.normal(0.0, 0.3, pos.shape) * [1.0, 1.0, 0.0] for _ in range(2)]
    log = log_at(time, pos_w=noisy[0], est_pos_w=noisy[1])
    assert "the delay runs" not in faults(log, "warn")


def test_values_in_steps_are_as_noisy_as_their_rounding():
    values = np.round(np.linspace(0.0, 1.0, 400)[:, None], 1)
    assert noise(Channel(0.01 * np.arange(400), values, "m")) == approx([0.1 / np.sqrt(12.0)])


def test_a_thrust_that_the_model_reads_and_the_log_lacks_is_a_warning():
    log = log_of(flight(5.0), thrust_cmd=Channel(np.arange(9.0), np.ones(9), "N"))
    (row,) = thrust_checks.look(log, KnownVehicle(thrust_input="thrust_command"))
    assert row.verdict == "warn"
    assert "did you mean 'thrust_cmd'?" in row.text


@mark.parametrize(("stiffness", "damping", "lasting"), [(4.0, 2.0, 0.6), (2.0, 3.0, 0.8)])
def test_thrust_that_answers_gusts_is_on_no_other_clock(stiffness, damping, lasting):
    """A height controller commands thrust when a gust has pushed already: the force leads."""
    time = np.arange(0.0, 25.0, 0.01)
    decay = np.exp(-time[:400] / lasting)
    gusts = np.convolve(default_rng(0).normal(size=len(time) + 399), decay, "valid")
    gusts /= np.std(gusts)
    thrust = 0.0 * time
    place = np.zeros((len(time), 3))
    height = speed = 0.0
    lift = 9.81
    for i, gust in enumerate(gusts):
        thrust[i] = 9.81 - stiffness * height - damping * speed
        lift += 0.01 / 0.05 * (thrust[i] - lift)
        speed += 0.01 * (lift - 9.81 + gust)
        height += 0.01 * speed
        place[i, 2] = height
    log = level_log(time, place, thrust_command=thrust)
    *_, row = thrust_checks.look(log)
    assert (row.topic, row.verdict) == ("delay", "ok")
    early = Channel(time - 0.4, thrust, "N")
    *_, row = thrust_checks.look(with_channels(log, thrust_command=early))
    assert row.verdict != "ok"


@mark.parametrize(
    ("turned_deg", "late", "share", "words"),
    [
        (0.0, 0.0, 1.0, ""),
        (20.0, 0.0, 1.0, ""),
        (50.0, 0.0, 1.0, "acc_b fits turned by +50 deg about z"),
        (-50.0, 0.03, 1.0, "acc_b fits turned by -50 deg about z"),
        (90.0, 0.0, 1.0, "acc_b fits as (-y,x,z)"),
        (180.0, 0.0, 0.3, ""),
    ],
)
def test_a_turned_accelerometer_is_named(turned_deg, late, share, words):
    """Also where the path comes late; a mount that is a little off belongs there. Exchanged axes
    refuse the log. No mount changes a force's size.
    """
    time = np.arange(0.0, 30.0, 0.01)
    turns = np.outer(time, [1.9, 2.3, 1.1]) + [0.0, 1.0, 2.0]
    vel = np.sin(turns)
    acc = np.gradient(vel, time, axis=0) + [0.0, 0.0, G]
    thrust = acc + 0.4 * vel  # against the rotors' drag
    turn = upright(thrust)
    force = turn.inv().apply(acc) + default_rng(4).normal(0.0, 0.2, acc.shape)
    force = Rotation.from_euler("z", turned_deg, degrees=True).apply(force) * [share, share, 1.0]
    airborne = log_at(time - late, quat_wb=turn.as_quat(), acc_b=force)
    log = log_at(time, pos_w=np.cumsum(vel, axis=0) * 0.01, vel_w=vel)
    log = with_channels(log, **airborne.channels)
    bad = faults(log)
    text = bad + faults(log, "warn")
    assert words in text
    assert ("acc_b fits" in text) == bool(words)
    assert ("acc_b fits" in bad) == (turned_deg == 90.0)


def test_a_payload_that_swings_in_circles_exchanges_no_axes():
    """A velocity that a filter delays looks like a quarter turn of the cable's pull; on a circle
    drag looks like a turned path.
    """
    time = np.arange(0.0, 20.0, 0.01)
    circle = np.column_stack([np.cos(6.0 * time), np.sin(6.0 * time), np.zeros_like(time)])
    force_w = circle + [0.0, 0.0, G]
    thrust = force_w - 0.12 * circle  # less the cable's pull
    turn = upright(thrust)
    force = turn.inv().apply(force_w) + default_rng(5).normal(0.0, 0.1, force_w.shape)
    late = 6.0 * (time - 0.08)
    vel = np.column_stack([np.sin(late), -np.cos(late), np.zeros_like(time)]) / 6.0
    log = log_at(time, vel_w=vel, quat_wb=turn.as_quat(), acc_b=force)
    assert "acc_b fits" not in faults(log)
    dragged = upright(force_w + 2.0 * vel).as_quat()
    assert not faults(log_at(time, vel_w=vel, quat_wb=dragged))


def test_commands_that_come_ten_times_a_second_are_of_no_other_flight():
    """Rates that turn back and forth between two commands do not follow those that are logged."""
    time = np.arange(0.0, 40.0, 0.01)
    rng = default_rng(6)
    steps = rng.normal(0.0, 1.0, (len(time) // 4, 3)).repeat(4, axis=0)
    rates = np.roll(steps, 3, axis=0)
    log = log_at(time, rate_b=rates)
    slow = Channel(time[::10], steps[::10], "rad/s", "body")
    log = with_channels(log, rate_setpoint_b=slow)
    assert "not the same flight" not in faults(log)
    assert "too seldom" in faults(log, "warn")


def test_a_noisy_path_dilutes_its_velocity():
    """Positions of a receiver whose noise makes half of what their slope moves."""
    time = np.arange(0.0, 60.0, 0.1)
    rng = default_rng(7)
    vel = np.sin(np.outer(time, [0.7, 0.9, 1.1]))
    pos = np.cumsum(vel, axis=0) * 0.1 + rng.normal(0.0, 0.09, vel.shape)
    log = log_at(time, pos_w=pos, vel_w=vel)
    assert "no unit explains it" not in faults(log)
    assert "noise dilutes it" in faults(log, "warn")
