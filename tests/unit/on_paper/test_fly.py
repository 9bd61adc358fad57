"""The baseline in flight: controller against closed forms, throws in its model and on the plants,
front and command.
"""

from dataclasses import replace

import numpy as np
from pytest import approx, fixture, importorskip, mark

from tests.commands import run_command
from tests.configs import load_experiment
from visthrow.paper import results
from visthrow.paper.baseline import front
from visthrow.paper.baseline import pendulum_model as pm
from visthrow.paper.baseline.fly_plan import (
    Delays,
    delays_of,
    fly_pendulum,
)
from visthrow.paper.baseline.front import pareto
from visthrow.paper.baseline.mpc import MPC, MPCParams
from visthrow.paper.baseline.spline import PlanParams
from visthrow.paper.baseline.throw_plan import plan_throw
from visthrow.task import Experiment, plant_of

importorskip("piqp")

MODEL_ERROR = 0.05
"""Landing error in the baseline's model from random starts [m] (measured 0.01): the paper's best is
0.027.
"""


FEED_FORWARD = 0.3
"""Of the first command against the flat input [N, rad/s]: one is held for 20 ms, the other changes
(measured 0.16).
"""

CONDENSED = 1e-4
"""Of the first command against a dense solution of the same programme; the solver stops at 1e-6."""


@fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment("state")


@fixture(scope="module")
def plan(experiment, one_start):
    return plan_throw(
        pm.pendulum_of(plant_of(experiment)),
        2.0,
        1.13,
        1.7,
        PlanParams(),
        0.04,
        lag=experiment.release.lag,
    )


def test_controller_on_its_reference_commands_the_feed_forward(plan):
    controller = MPC(plan.model)
    states, inputs = plan.reference(0.0, 0.02, 62)
    command = controller.step(states[0], (states, inputs))
    assert np.abs(command - inputs[0]).max() < FEED_FORWARD


def test_controller_solves_its_least_squares():
    """Near hover without active bounds the programme is linear least squares: solved densely by
    numpy as well.
    """
    model, params = pm.Pendulum(0.212, 0.06, 0.363), MPCParams(stages=12)
    states, inputs = pm.hover(model, np.tile([0.0, 0.0, 0.95], (13, 1)))
    inputs = inputs[:12]
    start = states[0].copy()
    start[:2] += [0.01, -0.005]
    command = MPC(model, params).step(start, (states, inputs))
    _, a, b = pm.linearise(model, states[:1], inputs[:1], params.period)
    rows, right = [], []
    propagate, effect = np.eye(16), np.zeros((16, 48))
    for k in range(13):
        scale = np.sqrt(params.state_weights)[:, None]
        rows.append(scale * effect)
        right.append(-scale[:, 0] * (propagate @ (start - states[0])))
        if k < 12:
            effect = a[0] @ effect
            effect[:, 4 * k : 4 * k + 4] += b[0]
            propagate = a[0] @ propagate
    rows.append(np.diag(np.tile(np.sqrt(params.input_weights), 12)))
    right.append(np.zeros(48))
    dense = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0][:4] + inputs[0]
    assert np.abs(command - dense).max() < CONDENSED


@mark.parametrize(("below", "limit"), [(2.0, 3.5), (-2.0, 2.0)])
def test_thrust_stops_at_its_limit(below, limit):
    model, params = pm.Pendulum(0.212, 0.06, 0.363), MPCParams(min_thrust=2.0, max_thrust=3.5)
    count = params.stages
    states, inputs = pm.hover(model, np.tile([0.0, 0.0, 3.0], (count + 1, 1)))
    start = states[0].copy()
    start[2] -= below
    command = MPC(model, params).step(start, (states, inputs[:count]))
    assert command[0] == approx(limit, abs=1e-3)


def test_throws_in_the_planners_model_land_near_the_target(plan):
    flown = fly_pendulum(plan, 2)
    assert flown.success.all()
    assert np.all(flown.error < MODEL_ERROR)
    assert np.allclose(flown.duration, plan.duration, atol=0.02)
    again = fly_pendulum(plan, 2)
    assert np.array_equal(flown.landing_w, again.landing_w)


def test_delays_by_name(experiment):
    assert delays_of(experiment, "none") == Delays()
    both = delays_of(experiment)
    assert both.command == approx(0.022 + 0.008 + 0.033)
    instant = replace(experiment.vehicle, motor=replace(experiment.vehicle.motor, kind="instant"))
    assert delays_of(replace(experiment, vehicle=instant)).command == approx(0.022 + 0.008)


def test_front_and_hypervolume_by_hand():
    """Points (1, 3), (2, 1), (3, 2) under the corner (4, 4): the third is beaten; 1 x 1 + 2 x 3 =
    7.
    """
    points = np.array([[3.0, 2.0], [1.0, 3.0], [2.0, 1.0], [5.0, 0.1]])
    assert pareto(points).tolist() == [1, 2, 3]
    assert front.hypervolume(points, (4.0, 4.0)) == approx(7.0)
    assert front.hypervolume(np.empty((0, 2))) == 0.0


def test_the_command_writes_tables_and_picture(tmp_path, capsys, one_start):
    packed = tmp_path / "all.json"
    command = f"baseline --quick --targets 1.5 --policies state --out {tmp_path} --json {packed}"
    assert run_command(command) == 0
    text = (tmp_path / "report.md").read_text()
    assert "0.127 ± 0.019, 1.546 ± 0.010" in text, "the paper's TO+MPC stands beside our model"
    assert "learnt state policy, training simulator" in text
    units = [result.unit for result in results.load(packed)]
    assert sorted((u["kind"], u["plant"], u["throws"], u["target"]) for u in units) == [
        ("baseline", "pendulum", 2, 1.5),
        ("baseline", "pendulum", 2, 2.0),
        ("baseline", "pendulum", 2, 2.0),
        ("policy", "hybrid", 10, 2.0),
    ]
    assert {u["speed"] for u in units if u["kind"] == "baseline" and u["target"] == 2.0} == {2.2}
    assert (tmp_path / "front.png").stat().st_size > 10_000
    assert text.splitlines()[0] in capsys.readouterr().out
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "throws").iterdir()}
    assert run_command(command) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "throws").iterdir()} == kept, (
        "nothing is flown twice"
    )


def test_the_command_refuses_what_it_cannot_fly(tmp_path, refused):
    refused(f"baseline --plants hybird --out {tmp_path}", message="did you mean 'hybrid'")
