"""Commands that got lost: what each would have changed, and that they are found and told beside
what else there is.
"""

from functools import cache

import numpy as np

from sim.kernels.replay.lanes import Recording
from tests.flown import fly, setting_with
from tests.plants import paper_plant
from tests.synthetic_diagnosis import SyntheticModel
from visthrow.diagnose.select import lost_commands as dropped
from visthrow.diagnose.select import search
from visthrow.diagnose.select.point import Problem, linearise
from visthrow.diagnose.throw.replay import Lane
from visthrow.diagnose.throw.throw_model import ThrowModel

SHARE = 0.12
ONLY = ("cmd_delay", "com_x", "rate_gain", "wind_x", "payload_drag")


@cache
def model_of(lost: float, throws: int = 2, **theta: float) -> ThrowModel:
    return ThrowModel(
        fly(setting_with(theta), seed=4, free=1, throws=throws, seconds=3.0, lost=lost),
        paper_plant(),
        only=ONLY,
    )


def test_a_column_is_what_the_missing_command_changes():
    model = model_of(SHARE, throws=1)
    columns = model.without_commands({}, range(len(model.windows({}))))
    (setting, states), flights = model.begun({}), model.flights
    w = int(model._retained[len(columns) // 2])
    c = flights.cuts[w]
    f = flights.flights[c.flight]
    acts = f.command_time + setting.plant.vehicle.queue.delay
    first = int(flights.windows["command_first"][w])
    inside = np.flatnonzero(
        (np.append(acts[1:], np.inf) > c.start) & (acts < c.end) & (np.arange(len(acts)) > 0)
    )
    assert columns[len(columns) // 2].shape[1] == len(inside)
    lane, largest = [Lane(w, 0, w, rough=True)], 0.0
    simulation = model.simulation(setting)
    plain = flights.fly(simulation, states, lane).seen
    for column, k in zip(columns[len(columns) // 2].T[::9], inside[::9]):
        sent = flights.recording.data["command"].copy()
        sent[first + k] = sent[first + k - 1]
        recording = Recording(flights.recording.windows, flights.recording.data | {"command": sent})
        seen = flights.fly(simulation, states, lane, recording).seen
        change = (seen - plain)[: int(flights.rows[w]), 0].ravel()
        np.testing.assert_allclose(column, change, atol=1e-12)
        largest = max(largest, np.abs(change).max())
    assert largest > 1e-3  # a turn of that [rad], else nothing is compared


def told(diagnosis):
    return [s for s in diagnosis.scatter if s.found]


def test_lost_commands_are_found_beside_a_cause():
    diagnosis = search.explain(model_of(SHARE, com_x=0.003))
    assert (diagnosis.overall, diagnosis.named, [s.name for s in told(diagnosis)]) == (
        "KNOWN",
        ("com_x",),
        [dropped.NAME],
    )
    assert abs(diagnosis.theta["com_x"] - 0.003) < 3e-4
    found = told(diagnosis)[0]
    assert found.low < SHARE < found.high
    assert found.nats > 50.0


def test_a_model_without_commands_has_no_verdict_on_them():
    model = SyntheticModel()
    windows = model.windows({})
    problem = Problem.of(model, windows, range(len(windows)))
    point = linearise(problem, np.zeros(len(model.effects)), windows=windows)
    assert dropped.verdict(problem, point, (), 5.0) is None
