"""The small models against independent physics: scipy's integrator, closed forms, and recovery of
planted parameters.
"""

import json
import re
from copy import deepcopy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from pytest import approx, mark, raises
from scipy.spatial.transform import Rotation

from bench.diagnose import beside_aeroid, flown
from bench.diagnose.flown import LATE, G, ball_log, fly
from sim.params import LawParams
from tests.commands import run_command
from tests.flightlogs import level_log, log_at, with_channels
from tests.places import DATA
from tests.plants import paper_plant
from tests.synthetic_diagnosis import explain_without_laws, selector_of
from visthrow import config
from visthrow.common.errors import ConfigError, DiagnoseError, LogError
from visthrow.diagnose.inputs import fit as fitting
from visthrow.diagnose.inputs import measures
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.models.ball import BallModel, BallParams
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import CableParams, FlyerParams, TorqueParams
from visthrow.diagnose.models.quadrotor.imu import ImuModel, ImuParams
from visthrow.diagnose.models.stand import StandModel, StandParams
from visthrow.diagnose.reporting.diagnosis_report import summary
from visthrow.diagnose.reporting.gain import evaluate_on_others
from visthrow.diagnose.select import diagnose_flights, result
from visthrow.logs.export import export
from visthrow.logs.flightlog import Channel, FlightLog

BALL = BallParams(G, 0.0, 0.02, 0.3, 1)
STAND = StandParams(1.5e-6, 2e-8, 0.0, 0.1, 11.0, 0.02, 0.01, 0.05, 0.02, 100.0)
QUADROTOR = {
    "input": "motor_command",
    "mass": 0.03,
    "gravity": G,
    "thrust_map": (0.0, 0.06, 0.1),
    "motor_time_constant": 0.03,
    "command_delay": 0.0,
    "reference_voltage": 3.8,
    "voltage_coefficient": 0.0,
    "window": 1.0,
    "every": 1,
    "most_windows": 40,
}
FLYER = FlyerParams(
    **QUADROTOR,
    step=0.02,
    position="pos_w",
    attitude="quat_wb",
    drag_xy=0.0,
    drag_z=0.0,
    lowest=-10.0,
)
LATE_FLYER = replace(FLYER, command_delay=LATE)
DRIVEN_BY_THRUST = replace(FLYER, input="thrust_command", thrust_map=(0.0, 1.0, 0.0))
TORQUE = TorqueParams((1.6e-5, 1.6e-5, 3e-5), 0.03, 0.03, 0.006, (1.0, -1.0, -1.0, 1.0))
IMU = ImuParams(**QUADROTOR, step=0.01, torque=TORQUE)


def estimate(model, names) -> dict[str, tuple[float, float]]:
    """Estimates and deviations."""
    result = fitting.fit(model, names)
    return {
        n: (float(result.theta[i]), float(np.sqrt(result.covariance[i, i])))
        for i, n in enumerate(names)
    }


def assert_near(estimates, name, truth) -> bool:
    value, sd = estimates[name]
    return abs(value - truth) < 3.0 * sd


class TestBall:
    def test_what_flies_is_found(self):
        spin = 0.0, 0.0, 0.3
        logs = [ball_log(drag=0.04, spin=spin, seed=i, heading=2.1 * i) for i in range(4)]
        model = BallModel(logs, BALL)
        assert len(model.stretches) == 4
        truth = {"ball_drag": 0.04, "side_spin": 0.3, "top_spin": 0.0}
        estimates = estimate(model, [*truth, "frame_tilt_x", "frame_tilt_y"])
        assert estimates["ball_drag"][0] == approx(0.04, rel=0.03)
        assert estimates["side_spin"][0] == approx(0.3, rel=0.05)
        assert all(assert_near(estimates, *size) for size in truth.items())

    def test_wind_shows_where_the_drag_is(self):
        """Without drag wind has no effect: derivatives of the plain model do not show it."""
        truth, stamps, paths = beside_aeroid.world(240000100)
        positions = paths + default_rng(1).normal(0.0, 5e-4, paths.shape)
        diagnosis = explain_without_laws(beside_aeroid.model_of(stamps, positions))
        assert diagnosis.overall == "KNOWN"
        assert set(diagnosis.theta) == set(truth)
        assert all(
            abs(diagnosis[name].estimate - size) < 3.0 * diagnosis[name].sd
            for name, size in truth.items()
        )
        unseen = paths + default_rng(2).normal(0.0, 5e-4, paths.shape)
        others = beside_aeroid.model_of(stamps, unseen)
        errors = evaluate_on_others(others, others, diagnosis.theta, diagnosis).errors
        before, after, noise = errors["payload_pos_w"]
        assert before > 20.0 * noise
        assert 0.7 * noise < after < 1.3 * noise
        for stretch in others.stretches:
            stretch.residual[10::60] += 0.3
        tested = evaluate_on_others(others, others, diagnosis.theta, diagnosis)
        assert tested.outliers >= sum(len(s.residual[10::60]) for s in others.stretches)
        assert tested.errors["payload_pos_w"][1] < 2.0 * noise

    def test_nothing_that_falls(self):
        time = np.arange(0, 3, 0.01)
        still = log_at(time, payload_pos_w=np.zeros((len(time), 3)))
        with raises(LogError, match="no stretch"):
            BallModel([still], BALL)


class TestStand:
    def log(self, zero=0.0, seed=0) -> FlightLog:
        speed = np.linspace(300, 1800, 12)
        volts = np.full(12, 11.0)
        thrust = 1.4e-6 * speed**2 + 3e-4 * speed + zero
        power = 2e-8 * speed**3
        current = (volts - np.sqrt(volts**2 - 0.4 * power)) / 0.2
        time = 2.0 * np.arange(12)
        rng = default_rng(seed)
        return log_at(
            time,
            thrust=thrust * (1 + rng.normal(0, 0.005, 12)),
            rotor_speed=speed,
            supply_voltage=volts,
            current=current,
        )

    def test_curve_and_zero_are_found(self):
        logs = [self.log(0.1, i) for i in range(4)]
        model = StandModel(logs, STAND)
        result = fitting.fit(model, ["thrust_gain", "thrust_linear", "load_cell_zero"])
        base = fitting.config.load(fitting.VehicleParams, fitting.config.find("vehicle", "paper"))
        vehicle = fitting.vehicle_of(setups.Setup("", stand=STAND), result, base)
        speed = np.array([600.0, 1200.0, 1700.0])
        thrust = vehicle.thrust.k_f * speed**2 + vehicle.thrust.k_1 * speed
        assert thrust == approx(1.4e-6 * speed**2 + 3e-4 * speed, rel=0.02)

    def test_command_line_writes_a_vehicle(self, tmp_path, capsys):
        for i in range(3):
            export(self.log(seed=i), tmp_path / f"{i}.csv")
        setup = setups.Setup("a stand", stand=STAND)
        (tmp_path / "mine.toml").write_text(config.dumps(setup))
        logs = [str(tmp_path / f"{i}.csv") for i in range(3)]
        out = tmp_path / "out"
        assert run_command(f"diagnose fit --config {tmp_path}/mine.toml --out {out}", *logs) == 0
        assert "thrust_gain" in capsys.readouterr().out
        assert run_command(f"config vehicle {out}/vehicle.toml") == 0
        vehicle = config.load(fitting.VehicleParams, out / "vehicle.toml")
        speed = 1000.0
        assert vehicle.thrust.k_f * speed**2 + vehicle.thrust.k_1 * speed == approx(1.7, rel=0.03)
        record = json.loads((out / "fit.json").read_text())
        assert np.shape(record["covariance"]) == (len(record["names"]),) * 2
        assert len(record["logs"]) == 3


class TestFlyer:
    def test_an_attitude_on_another_clock_is_found_in_short_flights(self):
        """A delay of 0.12 s, without an accelerometer that shows it beforehand."""
        logs = [fly(4.0, late=0.12, seed=seed) for seed in range(3)]
        diagnosis = diagnose_flights.diagnose(logs, FlyerModel(logs, LATE_FLYER), laws=False)
        assert diagnosis.named == ("attitude_delay",)
        assert diagnosis["attitude_delay"].verdict == result.FOUND
        assert diagnosis.theta["attitude_delay"] == approx(0.12, abs=2e-3)

    @mark.parametrize("params", [FLYER, IMU], ids=["flyer", "imu"])
    @mark.parametrize("thrust_map", [(0.0, 0.0, 0.0), (1.0, -1.0, 0.0)])
    def test_a_map_without_thrust_is_refused(self, params, thrust_map):
        with raises(ConfigError, match="thrust_map"):
            replace(params, thrust_map=thrust_map)

    @mark.parametrize("phase", [0.0, 0.003, 0.0085])
    def test_held_commands_pass_the_motors_lag_exactly(self, phase):
        """Closed form: thrust falls to each command by itself, wherever in a step of the
        integration that one comes.
        """
        rng, tau, mass = default_rng(3), 0.03, 0.03
        params = replace(DRIVEN_BY_THRUST, mass=mass, motor_time_constant=tau)
        time = np.arange(0.0, 4.0, 0.01)
        sent = np.arange(-phase, 4.0, 0.01)
        thrust = mass * G * (1.0 + 0.3 * rng.normal(size=len(sent)))
        since = np.maximum(time[:, None] - sent[1:], 0.0)
        rises = 0.5 * since**2 - tau * since + tau**2 * (1.0 - np.exp(-since / tau))
        height = 5.0 + 0.5 * (thrust[0] / mass - G) * time**2 + rises @ np.diff(thrust) / mass
        log = level_log(time, np.outer(height, [0.0, 0.0, 1.0]))
        log = with_channels(log, thrust_command=Channel(sent, thrust[:, None], "N"))
        off = np.concatenate(FlyerModel([log], params).residuals({}))
        assert np.abs(off).max() < 1e-4  # motion capture has more noise

    def test_a_cable_is_attached_where_its_setup_says(self):
        mount = (0.01, 0.0, -0.03)
        log = fly(4.0, cable=0.5, mount=mount, noise=1e-6)
        worst = []
        for point in (mount, (0.0, 0.0, 0.0)):
            cable = CableParams(0.5, 0.008, point)
            model = FlyerModel([log], replace(LATE_FLYER, cable=cable))
            worst.append(np.abs(np.concatenate(model.residuals({}))).max())
            assert np.allclose(model.windows({})[0].knots["mount_b"], point, rtol=0.0, atol=1e-12)
        assert worst[0] < 1e-4
        assert worst[1] > 3e-3

    def test_a_command_that_does_not_come_shows_by_its_column(self):
        """Closed form: once the motors' lag is over, the speed is off by the impulse that is
        missing while the one before is held.
        """
        time = np.arange(0.0, 4.0, 0.05)
        thrust = FLYER.mass * G * (1.0 + 0.2 * np.sin(time / 0.05))
        sent = Channel(time, np.column_stack([thrust] * 4), "N, rad/s", "body")
        params = replace(FLYER, input="command", thrust_map=(0.0, 1.0, 0.0))
        model = FlyerModel([with_channels(fly(4.0, noise=1e-6), command=sent)], params)
        (columns,) = model.without_commands({}, [1])
        k = np.searchsorted(time, model.stretches[1].data["start"], "right") + 4
        path = columns[:, 5].reshape(-1, 3)
        speed = norm(path[-1] - path[-6]) / 0.05  # samples of 10 ms
        missing = abs(thrust[k - 1] - thrust[k]) * 0.05
        assert speed == approx(missing / FLYER.mass, rel=0.01)
        assert not FlyerModel([fly(4.0)], FLYER).without_commands({}, [1])

    def test_a_push_that_another_vehicle_drives_is_a_law_of_its_measured_position(self):
        logs = [fly(6.0, downwash=0.03, seed=i) for i in range(3)]
        diagnosis = diagnose_flights.explain(FlyerModel(logs, LATE_FLYER))
        assert diagnosis.overall == "UNKNOWN"
        assert diagnosis.laws[0].formula == "F = c 1/d d_z/d z"
        law = diagnosis.laws[0]
        assert law.coefficient == approx(0.03, rel=0.02)
        for log in logs:
            del log.channels["neighbour_pos_w"]
        unaware = diagnose_flights.explain(FlyerModel(logs, LATE_FLYER))
        assert all("/d" not in law.formula for law in unaware.laws)

    def test_what_neither_name_nor_law_explains_is_reported(self):
        logs = [fly(6.0, beat=0.01, seed=i) for i in range(3)]
        diagnosis = explain_without_laws(FlyerModel(logs, LATE_FLYER))
        assert diagnosis.overall in ("UNKNOWN", "EXPLAINED IN PART")
        assert any("noise alone" in reason for reason in diagnosis.reasons)

    @staticmethod
    def in_wind(monkeypatch, lean: float, **flight) -> FlyerModel:
        """A model of two flights in wind along x, whose headings stand and whose leans are those
        of :func:`bench.diagnose.flown.attitude` times ``lean``.
        """
        plain = flown.attitude

        def north(time):
            return Rotation.from_euler("ZYX", plain(time).as_euler("ZYX") * [0.0, lean, lean])

        monkeypatch.setattr(flown, "attitude", north)
        logs = [fly(6.0, seed=seed, **flight) for seed in range(2)]
        model = FlyerModel(logs, replace(FLYER, drag_xy=flight["drag"]))
        model.choose(
            ["wind_x", "wind_y", "frame_tilt_y", "marker_rot_y", "thrust_gain", "cmd_delay"]
        )
        return model

    @mark.parametrize("stated", [(), ("wind_x=0", "wind_y=0")])
    def test_wind_is_named_wind_unless_the_air_is_stated_to_stand(self, stated, monkeypatch):
        model = self.in_wind(monkeypatch, 0.1, drag=0.03, wind=1.5)
        model.effects = measures.narrow(model.effects, measures.parse(stated))
        if stated:
            model.choose(["wind_x", "wind_y"])  # nothing else may take their place
        diagnosis = explain_without_laws(model)
        named = {f.name for f in diagnosis.findings if f.verdict in result.NAMED}
        assert stated or not named & {"frame_tilt_y", "marker_rot_y"}
        assert ("wind_x" in named) != bool(stated)

    def test_wind_and_tilt_are_one_class_where_their_forms_hardly_differ(self, monkeypatch):
        """A tilt that is strongly behind, but by a small part of what the wind is worth."""
        model = self.in_wind(monkeypatch, 0.3, drag=0.01, wind=4.0, beat=0.01, noise=2e-3)
        diagnosis = explain_without_laws(model)
        assert diagnosis["wind_x"].verdict == diagnosis["frame_tilt_y"].verdict == result.CLASS
        assert diagnosis["wind_x"].estimate == approx(4.0, rel=0.1)
        assert "frame_tilt_y" in diagnosis["wind_x"].partners

    def test_another_of_a_group_is_simulated_however_little_it_promises(self, monkeypatch):
        model = self.in_wind(monkeypatch, 0.3, drag=0.01, wind=4.0, noise=2e-3)
        selector = selector_of(model)
        named = {c.name: c for c in selector.candidates}
        wind, tilt, gain = (
            frozenset({named[n]}) for n in ("wind_x", "frame_tilt_y", "thrust_gain")
        )
        selector.best = selector._try(selector.nominal, [wind])[0]
        listed = {tilt: -9.0, gain: -9.0}
        tried = {gain | {c}: -1.0 for c in selector.candidates[:4]}
        assert selector._choose_next(listed, tried, -np.inf) == tilt

    def test_a_flight_whose_thrust_differs_says_what_and_by_how_much(self):
        logs = [fly(6.0, gain=(1.0, 1.0, 1.0, 0.93)[i], seed=i) for i in range(4)]
        model = FlyerModel(logs, LATE_FLYER)
        model.choose(["thrust_gain", "thrust_curve", "rotor_drag_xy", "cmd_delay"])
        text = summary(explain_without_laws(model))
        event = next(line for line in text.splitlines() if line.startswith("EVENT"))
        size = re.fullmatch(
            r"EVENT +flight 3 differs from the others in thrust_gain by (.+)", event
        )
        assert float(size[1]) == approx(-0.07, abs=0.005)

    def test_motor_gains_from_rates(self):
        """Rates of closed form: one motor weaker by a tenth turns the vehicle as rigid-body
        mechanics says.
        """
        log = fly(5.0)
        time = log["pos_w"].time
        u = log["motor_command"].values[:, 0]
        lost = 0.1 * (0.06 * u + 0.1 * u * u)  # of the front left motor
        torque = np.outer(lost, [-0.03, 0.03, -0.006])
        spin = 0.01 * np.cumsum(torque / [0.2, 0.2, 0.3], axis=0)
        rates = Channel(time, spin, "rad/s", "body")  # small: gyroscopic terms vanish
        weak = replace(FLYER, torque=replace(TORQUE, inertia=(0.2, 0.2, 0.3)))
        model = FlyerModel([with_channels(log, rate_b=rates)], weak)
        channels = np.concatenate([s.channel for s in model.stretches])
        good, bad = (
            norm(np.concatenate(model.residuals(theta))[channels == 1])
            for theta in ({"motor_fl": -0.1}, {})
        )
        assert good < 0.1 * bad

    @staticmethod
    def carry_weight(place: list[float], rise=0.0) -> FlightLog:
        """Four seconds at a place, under the vehicle's weight and a share more each second."""
        time = np.arange(0.0, 4.0, 0.01)
        thrust = FLYER.mass * G * (1.0 + rise * time[:, None])
        log = level_log(time, np.tile(place, (len(time), 1)))
        return with_channels(log, thrust_command=Channel(time, thrust, "N"))

    @mark.parametrize(
        ("name", "size", "expected"),
        [
            ("frame_tilt_x", 0.01, [0.0, -0.01 * G, 0.0]),
            ("frame_tilt_y", 0.01, [0.01 * G, 0.0, 0.0]),
            ("marker_rot_x", 0.01, [0.0, -0.01 * G, 0.0]),
            ("marker_rot_y", 0.01, [0.01 * G, 0.0, 0.0]),
            ("mass_quad", 0.003, [0.0, 0.0, -G / 11.0]),
            ("thrust_gain", 0.02, [0.0, 0.0, 0.02 * G]),
        ],
    )
    def test_effects_push_a_hovering_vehicle_as_their_equations_say(self, name, size, expected):
        """Closed form: half the acceleration that an effect makes times the time squared."""
        model = FlyerModel([self.carry_weight([0.0, 0.0, 2.0])], DRIVEN_BY_THRUST)
        measured = []
        for theta in ({}, {name: size}):
            lanes = model._lanes(model.size(theta))
            (first, *_) = model.simulate(lanes)
            measured.append(model.measure(model.stretches[0], first[None], lanes).reshape(-1, 3))
        since = model.stretches[0].time[::3] - model.stretches[0].data["start"]
        assert measured[1] - measured[0] == approx(
            0.5 * np.outer(since**2, expected), abs=3e-4
        )  # the angle squared

    def test_a_neighbour_is_measured_in_the_tilted_frame_too(self):
        log = self.carry_weight([3.0, 0.0, 2.0])
        place = log["pos_w"]
        above = replace(place, values=place.values + [0.0, 0.0, 1.0])
        model = FlyerModel([with_channels(log, neighbour_pos_w=above)], DRIVEN_BY_THRUST)
        lanes = model._lanes(model.size({"frame_tilt_y": 0.05}))
        (knots, *_) = model.knots(lanes)
        begins = knots["pos_w"][0] - knots["neighbour_pos_w"][0]
        assert begins == approx([-np.sin(0.05), 0.0, -np.cos(0.05)], abs=1e-9)

    @mark.parametrize("step", [0.02, 0.03, 0.06])
    def test_thrusts_keep_their_time_where_no_number_of_steps_fills_the_window(self, step):
        params = replace(DRIVEN_BY_THRUST, motor_time_constant=0.001, step=step)
        model = FlyerModel([self.carry_weight([0.0, 0.0, 2.0], rise=0.1)], params)
        driven = model._commands(model._lanes(model.size({})))
        since = driven["command_time"][0] + 0.5 * model.row
        held = (driven["command"][0].sum(1) / (FLYER.mass * G) - 1.0) / 0.1
        assert since - held == approx(0.006, abs=0.0015)  # half a command, and the motors' lag

    def test_more_laws_than_the_simulator_holds_are_refused(self):
        law = LawParams("vehicle force", (), "vel", -1e-3)
        with raises(LogError, match="5 laws; expected at most 4"):
            FlyerModel([fly(3.0)], FLYER).with_laws([law] * 5).residuals({})

    def test_an_accelerometer_may_begin_after_a_window(self):
        log = fly(4.0)
        late = log["pos_w"].time > 3.5
        force = Channel(log["pos_w"].time[late], np.tile([0.3, 0.0, G], (sum(late), 1)), "m/s^2")
        model = FlyerModel([with_channels(log, acc_b=force)], FLYER)
        assert np.all(np.isfinite(np.concatenate(model.residuals({"estimator_lean": 1.0}))))

    def test_a_log_without_a_window_is_refused_by_height_and_thrust(self):
        log = fly(3.0)
        highest = np.max(log["pos_w"].values[:, 2])
        above = replace(FLYER, lowest=highest + 0.5)
        with raises(LogError, match=rf"pos_w rises to {highest:.3g} m, windows are above lowest ="):
            FlyerModel([log], above)
        weak = replace(FLYER, thrust_map=tuple(1e-3 * c for c in FLYER.thrust_map))
        with raises(LogError, match=r"carries up to 0\.00\d+ of the weight, windows at least 0\.3"):
            FlyerModel([log], weak)

    def test_missing_channels_are_named(self):
        log = fly(3.0)
        del log.channels["quat_wb"]
        with raises(LogError, match="missing everywhere: quat_wb"):
            FlyerModel([log], FLYER)
        with raises(ConfigError, match="single motors"):
            replace(FLYER, input="thrust_command", torque=TORQUE)


class TestImu:
    """Motors' commands, accelerometer and gyro, and nothing else."""

    def logs(self, curve=0.0, inertia=(0.0, 0.0)) -> list[FlightLog]:
        """Return copies of two flights: a test may change them."""
        return [deepcopy(self.flight(curve, inertia, seed)) for seed in range(2)]

    @staticmethod
    @cache
    def flight(curve: float, inertia: tuple[float, float], seed: int) -> FlightLog:
        """A vehicle that turns to and fro about all axes while its thrust swings; integrated by
        Euler steps of 0.5 ms, with an accelerometer off by 0.2 m/s^2.
        """
        p, rng, step = IMU, default_rng(seed), 5e-4
        time = np.arange(0.0, 5.0, step)
        arm = p.torque.arm_x
        mixer = np.array(
            [[arm, -arm, arm, -arm], [-arm, -arm, arm, arm], [0.006, -0.006, -0.006, 0.006]]
        )
        moment = np.array(p.torque.inertia) * (1.0 + np.array([inertia[0], inertia[0], inertia[1]]))
        hover = p.mass * G / 4.0
        tones = rng.uniform(8.0, 25.0, 3), rng.uniform(0.0, 6.0, 4)
        unmixed = np.linalg.pinv(mixer)
        thrust, rate, sent = np.full(4, hover), np.zeros(3), np.zeros(4)
        rows = []
        for i, t in enumerate(time):
            if i % 10 == 0:  # commands at 200 Hz
                rate_command = [3.0, 3.0, 1.0] * np.sin(tones[0] * t + tones[1][:3])
                torque = np.array(p.torque.inertia) * [30.0, 30.0, 10.0] * (rate_command - rate)
                level = hover * (1.0 + 0.3 * np.sin(9.0 * t + tones[1][3]))
                sent = np.clip(level + unmixed @ torque, 0.2 * hover, 3.0 * hover)
                acc = (thrust * (1.0 + curve * (thrust / hover - 1.0))).sum() / p.mass
                command = (-0.06 + np.sqrt(0.06**2 + 0.4 * sent)) / 0.2
                rows.append([t, acc, *rate, *command])
            real = thrust * (1.0 + curve * (thrust / hover - 1.0))
            rate = rate + step / moment * (mixer @ real - np.cross(rate, moment * rate))
            thrust = sent + (thrust - sent) * np.exp(-step / 0.05)
        t, acc, *columns = np.array(rows).T
        rates, command = np.array(columns[:3]).T, np.array(columns[3:]).T
        force = np.column_stack([0.0 * acc, 0.0 * acc, acc + 0.2])
        return log_at(
            t,
            motor_command=command,
            acc_b=force + rng.normal(0, 0.3, force.shape),
            rate_b=rates + rng.normal(0, 0.02, rates.shape),
        )

    def test_lag_curve_and_inertia_without_a_position(self):
        truth = {"motor_tau": 0.02, "thrust_curve": 0.2, "inertia_xy": 0.3, "inertia_z": -0.2}
        logs = self.logs(0.2, (0.3, -0.2))
        model = ImuModel(logs, IMU)
        fitted = fitting.fit(model, [*fitting.DEFAULT_FREE["imu"]])
        sizes_fitted = dict(zip(fitted.names, fitted.theta))
        sd = dict(zip(fitted.names, np.sqrt(np.diag(fitted.covariance))))
        for name, size in truth.items():
            assert abs(sizes_fitted[name] - size) < 3.0 * sd[name] + 0.02 * abs(size), name
            assert sd[name] < 0.15 * abs(size), name

    def test_without_torques_the_accelerometer_alone_tells_the_motors_lag(self):
        logs = self.logs()
        for log in logs:
            del log.channels["rate_b"]
        model = ImuModel(logs, replace(IMU, torque=None))
        assert model.channels == ("acc_b",)
        assert not {"inertia_xy", "com_x", "motor_fl"} & {e.name for e in model.effects}
        diagnosis = diagnose_flights.diagnose(logs, model, laws=False)
        assert diagnosis.named == ("motor_tau",)
        assert diagnosis["motor_tau"].low < 0.02 < diagnosis["motor_tau"].high
        names = [n for n in fitting.DEFAULT_FREE["imu"] if not n.startswith("inertia")]
        assert list(fitting.fit(model, names).names) == names

    def test_a_voltage_that_only_some_logs_hold_is_not_used(self):
        logs = self.logs()
        assert not ImuModel(logs, IMU).notes
        logs[0].channels["battery_voltage"] = Channel(np.arange(9.0), np.full(9, 3.8), "V")
        model = ImuModel(logs, IMU)
        assert not model.has_voltage
        assert model.notes == ("battery_voltage is not used: only 1 of 2 logs hold it",)

    def test_torques_are_left_out_where_the_air_turns_the_vehicle(self):
        logs = self.logs()
        for log in logs:
            rate = log["rate_b"]
            rate.values[:] += 40.0 * np.sin(4.0 * rate.time)[:, None] * [1.0, -1.0, 0.5]
        strong = tuple(1.8 * c for c in IMU.thrust_map)  # the weight fixes the map's scale
        model = ImuModel(logs, replace(IMU, thrust_map=strong))
        assert model.channels == ("acc_b",)
        assert "with a correlation of 0." in model.notes[0]
        diagnosis = diagnose_flights.diagnose(logs, model, laws=False)
        assert set(diagnosis.named) == {"thrust_gain", "motor_tau"}
        assert diagnosis.theta["thrust_gain"] == approx(1.0 / 1.8 - 1.0, abs=0.03)
        assert diagnosis["inertia_xy"].missing == ("rate_b",)
        assert any("no torque or inertia" in reason for reason in diagnosis.reasons)


class TestSetups:
    def test_one_model_a_setup(self):
        with raises(ConfigError, match="ball and stand: a setup has only one model"):
            setups.Setup("", ball=BALL, stand=STAND)
        with raises(ConfigError, match="has no model"):
            setups.model_of(setups.Setup("bare"), [])

    def test_a_mapping_without_a_model_names_its_program(self, refused):
        swing = DATA / "real" / "pendulum_single" / "single_pendulum_id.csv.gz"
        for command in ("explain", "fit"):
            refused(
                f"diagnose {command} {swing} --config pendulum_encoder",
                message="its model is a program of the repository: examples/pendulum",
            )

    def test_a_simulated_vehicle_gets_what_a_flight_showed(self):
        sizes = {"motor_tau": 0.007, "mass_quad": 0.01, "rotor_drag_xy": 0.02}
        fitted = SimpleNamespace(names=tuple(sizes), theta=np.array(list(sizes.values())))
        vehicle = fitting.vehicle_of(setups.Setup("", flyer=FLYER), fitted, paper_plant().vehicle)
        assert vehicle.motor.time_constant == approx(FLYER.motor_time_constant + 0.007)
        assert vehicle.body.mass == approx(FLYER.mass + 0.01)
        assert vehicle.aero.drag_x == vehicle.aero.drag_y == approx(FLYER.drag_xy + 0.02)

    def test_fit_refuses_what_the_logs_lack(self):
        model = BallModel([ball_log()], BALL)
        with raises(DiagnoseError, match="did you mean 'ball_drag'"):
            fitting.fit(model, ["bal_drag"])
        with raises(DiagnoseError, match="nothing to fit"):
            fitting.fit(model, [])
        with raises(LogError, match="no effect 'x'"):
            model.residuals({"x": 1.0})
