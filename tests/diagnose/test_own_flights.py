"""Flights of ``visthrow fly`` against the simulator that flew them: the diagnosis must find
nothing.
"""

import numpy as np
from pytest import fixture, mark

from visthrow.diagnose.select import diagnose_flights
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.recorded import MEASURED, fly

SEEDS = (1,)
LATE = (8e-3, 12e-3)
"""Age of the poses that the pilot of these flights receives [s]."""


@fixture(scope="module")
def flown():
    """Policy and flights, as ``visthrow fly --seed 1`` saves them."""
    loaded = load_policy("vision", None, [])
    return loaded, [fly(loaded, np.array([2.0, 0.0, 0.0]), seed=seed) for seed in SEEDS]


def diagnose(loaded, logs) -> diagnose_flights.Diagnosis:
    """Diagnose logs as ``explain`` does."""
    experiment = loaded.experiment
    return diagnose_flights.explain(
        ThrowModel(logs, plant_of(experiment), sensing=experiment.sensing)
    )


def test_flights_of_fly_hide_nothing(flown):
    """Poses stamped when the pilot reads them, 10 ms late, gave a release lag, and UNKNOWN."""
    diagnosis = diagnose(*flown)
    assert (diagnosis.overall, dict(diagnosis.theta), diagnosis.events) == ("NO EFFECT", {}, ())


@mark.parametrize("name", MEASURED)
def test_measured_channels_were_true_when_they_are_stamped(flown, name):
    """Their error is the noise alone: it has no part along the motion, where 10 ms of age would be
    10 ms of it.
    """
    for log in flown[1]:
        true, measured = log[name], log[f"measured_{name}"]
        moved = np.gradient(true.values, true.time, axis=0)
        off = (
            np.array([np.interp(measured.time, true.time, column) for column in true.values.T]).T
            - measured.values
        )
        age = (off * moved).sum() / (moved**2).sum()
        assert abs(age) < 0.2 * LATE[0]
