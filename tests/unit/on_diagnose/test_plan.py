"""Plans: what to do in one session, and which truths are planned for."""

from types import SimpleNamespace

import numpy as np
from pytest import mark

from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.planning import plan


def test_a_session_holds_what_separates_more_than_what_stands_before_it():
    said = (
        ("circle", (("a", "b"), ("a", "c"))),
        ("swing", (("a", "c"),)),
        ("hover", ()),
        ("weigh", (("a", "d"),)),
    )
    proposals = [
        plan.FlightProposal(name, "", 10.0, 12.0, separates, 1, "") for name, separates in said
    ]
    assert [p.name for p in plan.session(proposals)] == ["circle", "weigh"]


@mark.parametrize(("telling", "repeats"), [(0, 3), (1, 2), (2, 1)])
def test_a_name_needs_three_flights_that_tell_of_it(telling, repeats):
    """Held-out flights confirm by what is left when one of them is; two leave an interval without
    end.
    """
    goal = plan.PlanningGoal.__new__(plan.PlanningGoal)
    one = np.ones(1)
    goal.priors = Priors(one, one, -9.0 * one, 9.0 * one, one > 0.0)
    goal.diagnosis = SimpleNamespace(work=SimpleNamespace(active=()))
    goal.pairs, goal.vague = [], [0]
    flights = np.zeros((4, 1, 1))
    flights[:telling] = 10.1
    goal.base = SimpleNamespace(
        information=flights.sum(0), statistics=SimpleNamespace(information=flights)
    )
    assert goal.settled(np.full((1, 1), 100.0)) == ([(0,)], repeats)
