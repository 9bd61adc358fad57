"""Axes, signs and units of commands that differ between log and simulation: each is hidden, named,
corrected.
"""

import json
from dataclasses import asdict

import numpy as np
from numpy.testing import assert_allclose
from pytest import fixture, mark
from scipy.spatial.transform import Rotation

from sim.params import GRAVITY
from tests.flightlogs import log_at, with_channels
from tests.flown import fly, setting_with
from tests.plants import paper_plant
from visthrow.diagnose.select.diagnose_flights import correct_interface_mistakes
from visthrow.diagnose.throw import command_mistakes as interface
from visthrow.diagnose.throw.command_mistakes import suspect
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.logs.flightlog import Channel, FlightLog

PLANT = paper_plant()
WEIGHT = GRAVITY * PLANT.total_mass


def lag_rates(seed: int, lag: float = 0.05) -> FlightLog:
    """Attitudes of a vehicle whose rates follow its commands ``lag`` seconds later, and the
    commands.
    """
    rng = np.random.default_rng(seed)
    sent = np.arange(0.0, 8.0, 0.02)
    bends = rng.normal(size=(3, 5)) * [1.2, 0.9, 0.7, 0.5, 0.3]
    rates = sum(
        bends[:, k, None] * np.sin((k + 1) * 1.3 * sent + rng.uniform(0, 6, (3, 1)))
        for k in range(5)
    ).T
    thrust = WEIGHT * (1.0 + 0.1 * rng.normal(size=len(sent)))
    time = np.arange(0.0, 8.0, 0.005)
    real = np.column_stack([np.interp(time - lag, sent, c) for c in rates.T])
    turn, quats = Rotation.identity(), []
    for rate in real:
        turn = turn * Rotation.from_rotvec(0.005 * rate)
        quats.append((turn * Rotation.from_rotvec(3e-3 * rng.normal(size=3))).as_quat())
    log = log_at(time, quat_wb=np.array(quats), pos_w=np.zeros((len(time), 3)))
    command = Channel(sent, np.column_stack((thrust, rates)), "N, rad/s", "body")
    return with_channels(log, command=command)


FULL = 4.0 * PLANT.vehicle.controller.max_thrust
WRONG = {
    "rate_axes": lambda u: u[:, [0, 2, 1, 3]],
    "rate_sign": lambda u: u * [1.0, 1.0, -1.0, 1.0],
    "rate_unit": lambda u: u * [1.0, 57.29578, 57.29578, 57.29578],
    "thrust_unit": lambda u: u * [1.0 / 9.80665e-3, 1.0, 1.0, 1.0],
    "thrust_unit of full": lambda u: u * [1.0 / FULL, 1.0, 1.0, 1.0],
}


@fixture(scope="module")
def logs():
    return [lag_rates(seed) for seed in range(3)]


def change_command(log, change):
    c = log["command"]
    return with_channels(log, command=Channel(c.time, change(c.values), c.unit, c.frame))


@mark.parametrize("name", WRONG)
def test_each_mistake_is_suspected_and_put_right(logs, name):
    wrong = [change_command(log, WRONG[name]) for log in logs]
    mistakes = suspect(wrong, PLANT)
    assert [m.name for m in mistakes] == [name.split(" ")[0]]
    assert mistakes[0].logs == 3
    for log, meant in zip(wrong, logs):
        assert_allclose(
            mistakes[0].mend(log)["command"].values, meant["command"].values, rtol=1e-4, atol=1e-9
        )


def test_mistakes_that_come_together_are_all_suspected(logs):
    degrees = 180.0 / np.pi
    turned = [
        change_command(
            log, lambda u: u[:, [0, 1, 3, 2]] * [1000.0 / GRAVITY, -degrees, degrees, degrees]
        )
        for log in logs
    ]
    assert [m.name for m in suspect(turned, PLANT)] == ["rate_axes", "rate_unit", "thrust_unit"]


def test_good_logs_and_logs_that_disagree_are_not_suspected(logs):
    assert suspect(logs, PLANT) == []
    mixed = [change_command(logs[0], WRONG["rate_axes"]), *logs[1:]]
    assert suspect(mixed, PLANT) == []
    strangers = [
        change_command(log, lambda u, other=other: other["command"].values)
        for log, other in zip(logs, [*logs[1:], logs[0]])
    ]
    assert suspect(strangers, PLANT) == []
    heavier = [change_command(log, lambda u: u * [1.6, 1.0, 1.0, 1.0]) for log in logs]
    assert suspect(heavier, PLANT) == []


def simulate(logs):
    return ThrowModel(logs, PLANT, only=["com_x"])


@mark.parametrize(("change", "names"), [("rate_axes", ["rate_axes", "rate_unit"]), ("", [])])
def test_the_simulation_decides_what_is_put_right(monkeypatch, change, names):
    """A real mistake stays corrected; one suspected without reason is dropped again."""
    flights = fly(setting_with({}), free=1, throws=0, seconds=1.0, seed=3)
    both = (lambda u: WRONG["rate_unit"](WRONG[change](u))) if change else (lambda u: u)
    wrong = [change_command(log, both) for log in flights]
    if not change:  # as a relation by chance would have it
        turned = np.diag([1.0, 1.0, 1.0, -1.0]).tolist()
        monkeypatch.setattr(
            interface,
            "suspect",
            lambda *_: [interface.Mistake("rate_sign", "c", "e", 0.0, 2, 48, turned)],
        )
    model, logs = correct_interface_mistakes(wrong, PLANT, simulate)
    assert [m.name for m in model.mistakes] == names
    assert all(m.nats > 100.0 for m in model.mistakes)
    assert len(json.dumps([asdict(m) for m in model.mistakes])) >= 2
    for log, meant in zip(logs, flights):
        assert_allclose(log["command"].values, meant["command"].values, rtol=1e-4, atol=1e-9)
