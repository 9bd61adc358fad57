"""Optimised excitation: it beats its start, keeps within the limits, and every capable vehicle
flies it.
"""

from dataclasses import replace

import numpy as np
from pytest import approx, fixture, mark, raises

from tests.configs import load_experiment
from tests.synthetic_diagnosis import explain_without_laws
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.inputs import setup
from visthrow.diagnose.models.ball import BallModel
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.imu import ImuModel
from visthrow.diagnose.planning import design, fly_manoeuvres, plan
from visthrow.diagnose.planning.manoeuvres import Manoeuvre, catalogue
from visthrow.task import plant_of

BASES = {m.name: m for m in catalogue()}
ABOUT = ("rotor_drag_xy", "rotor_drag_z", "cmd_delay", "motor_tau", "thrust_curve")


def plant(params):

    return fly_manoeuvres.vehicle_of(params, plant_of(load_experiment("state")))


def hovered(params):
    """A diagnosis of a hover of the setup's vehicle, and the simulator of its manoeuvres."""
    (hover,) = fly_manoeuvres.fly(
        plant(params), [fly_manoeuvres.adapt_to_payload(BASES["hover"], params)], 0
    )
    model = FlyerModel(
        [hover.setup_log(params, {params.position: 3e-4, "payload_pos_w": 3e-4})], params
    )
    diagnosis = explain_without_laws(model)
    return diagnosis, *fly_manoeuvres.simulator_of(
        model, diagnosis, lambda logs: FlyerModel(logs, params)
    )


@fixture(scope="module")
def quadrotor():
    params = replace(setup.load("nanobench_cf21").flyer, every=6, window=2.0, step=0.04)
    return hovered(params)


def test_the_optimiser_finds_more_than_the_best_that_it_began_with(quadrotor):
    """Sweeps along all axes at once give more information per second on drag, delay and the thrust
    map; an optimiser that returns its start fails.
    """
    diagnosis, simulate, flown = quadrotor
    aim = plan.PlanningGoal(diagnosis, ABOUT)
    chosen = [flown(BASES[name]) for name in ("vertical sine", "circle")]
    rates = [
        aim.nats(aim.information(s.model)) / m.seconds for m, s in zip(chosen, simulate(chosen))
    ]
    best = chosen[int(np.argmax(rates))]
    optimum = design.optimise(aim, best, simulate, design.Limits(), seed=1, steps=0)
    assert optimum.start == approx(max(rates), rel=0.02)  # but for the noise
    assert optimum.rate > 1.15 * optimum.start
    (again,) = simulate([optimum.manoeuvre])
    assert again.used < 1.0
    assert aim.nats(aim.information(again.model)) / best.seconds == approx(optimum.rate, rel=0.02)


@mark.parametrize("base", BASES.values(), ids=lambda m: m.name)
def test_the_start_is_the_manoeuvre_and_every_design_keeps_within_the_limits(base: Manoeuvre):
    same = design.design(base, design.Limits(), design.START)
    for name in ("pos_w", "yaw", "rates_b", "thrust_factor", "release"):
        np.testing.assert_allclose(
            getattr(same, name), getattr(base, name), atol=1e-12, err_msg=name
        )
    limits = design.Limits(half=(1.5, 1.0), highest=2.0, speed=1.5)
    allowed = limits.around(base.pos_w)
    for numbers in np.random.default_rng(3).random((20, len(design.NUMBERS))):
        r = design.design(base, limits, numbers)
        moved = np.abs(r.pos_w[:, :2]).max(0)
        assert np.all(moved <= np.array(allowed.half) + 1e-9)
        assert (
            allowed.lowest - 1e-9
            <= r.pos_w[:, 2].min()
            <= r.pos_w[:, 2].max()
            <= allowed.highest + 1e-9
        )
        assert (
            np.linalg.norm(r.vel_w, axis=1).max() <= 1.02 * allowed.speed
        )  # the hover before and after is not part of the fit
        assert np.abs(r.rates_b).max() <= limits.rate + np.abs(base.rates_b).max() + 1e-9


def test_a_payload_is_never_dropped_where_the_vehicle_cannot():
    cable, bare = (setup.load(name).flyer for name in ("cf_payload", "nanobench_cf21"))
    for params in (cable, bare):
        flown = [
            m
            for m in (fly_manoeuvres.adapt_to_payload(m, params) for m in BASES.values())
            if m is not None
        ]
        assert {m.payload for m in flown} == {params.cable is not None}
        assert not any(np.any(m.release) for m in flown)


@mark.parametrize("name", ["cf_payload", "nanobench_cf21"])
def test_the_simulated_flight_of_a_setup_is_one_that_its_model_explains(name):
    """The log's input, attitude and path belong together by the setup's own numbers: hardly
    anything is left without any effect.
    """
    params = setup.load(name).flyer
    chosen = [
        fly_manoeuvres.adapt_to_payload(BASES[m], params) for m in ("fast passes x", "circle")
    ]
    for flight in fly_manoeuvres.fly(plant(params), chosen, 0):
        model = FlyerModel([flight.setup_log(params, {})], params)
        off = np.concatenate(model.residuals({}))
        assert np.sqrt(np.mean(off**2)) < 3e-4, flight.manoeuvre.name


def test_neither_a_ball_nor_a_vehicle_without_position_flies_a_manoeuvre():
    model = BallModel.__new__(BallModel)
    with raises(DiagnoseError, match="flown by a vehicle"):
        fly_manoeuvres.simulator_of(model, None)
    unlocated = ImuModel.__new__(ImuModel)
    unlocated.params = setup.load("nanobench_imu").imu
    with raises(DiagnoseError, match="flown by a vehicle"):
        fly_manoeuvres.simulator_of(unlocated, None)


@mark.parametrize("limits", [{"speed": 0.0}, {"half": (1.0, -1.0)}, {"highest": 0.5}])
def test_limits_that_leave_no_room_are_refused(limits):
    with raises(DiagnoseError, match="above"):
        design.Limits(**limits)


@mark.parametrize("name", ["motor_command", "motor_speed", "thrust_command", "command"])
def test_the_simulated_log_holds_whatever_input_a_setup_names(name):
    """Channels of standard names have one unit and frame; a log in another cannot be made."""
    params = replace(setup.load("nanobench_cf21").flyer, input=name, torque=None)
    hover = replace(BASES["hover without payload"], seconds=3.0)
    rows = slice(len(hover.time))
    names = ("pos_w", "yaw", "rates_b", "thrust_factor", "release")
    short = replace(hover, **{n: getattr(hover, n)[rows] for n in names})
    (flight,) = fly_manoeuvres.fly(plant(params), [short], 0)
    assert np.sum(flight.setup_log(params, {})[name].valid) >= len(short.time)
