"""Plans: what to do in one session, and which truths are planned for."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.planning import plan
from visthrow.diagnose.select import search


@pytest.fixture(scope="module")
def degenerate():
    """Two effects that do the same."""
    model = SyntheticModel(
        effects=catalogue(12),
        truth={"effect_03": 12.0},
        same={"effect_07": ("effect_03", 0.5)},
        seed=2,
    )
    return search.explain(model, laws=False)


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


def test_a_member_that_is_far_behind_is_no_truth_to_plan_for(degenerate):
    """Flights that show only the other member promise what they show of it."""
    names, aim = [f.name for f in degenerate.findings], plan.PlanningGoal(degenerate)
    pair = names.index("effect_03"), names.index("effect_07")
    base, new = (
        np.diag(np.isin(np.arange(len(names)), which).astype(float)) for which in (pair, pair[:1])
    )
    for behind, planned in ((6.0, False), (0.5, True)):  # score of the other member
        score = np.zeros(len(names))
        score[list(pair)] = 6.0, behind
        aim.base = SimpleNamespace(information=base, score=score)
        assert (aim._gap(pair, new) > plan.DECISIVE) == planned
