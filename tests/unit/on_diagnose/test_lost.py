"""Windows that the simulation does not follow: which are left out, when, and what they would have
been taken for.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.flown import fly, setting_with
from tests.plants import paper_plant
from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.models.law_terms import Term
from visthrow.diagnose.select import result, search, selector, terms
from visthrow.diagnose.select.point import Problem, candidate, linearise, lost, only
from visthrow.diagnose.throw.cutting import RINGING
from visthrow.diagnose.throw.initial_states import HUNG
from visthrow.diagnose.throw.throw_model import ThrowModel

EFFECTS = catalogue(12)
BAD = 10
"""Number of the window that is spoiled."""
ROUGH = 1.0
"""Noise that is added there, in its own."""


class Spoiled(SyntheticModel):
    """One window moves as nobody can know; with ``beyond`` only where the first effect is larger
    than that [floors].
    """

    shaken, rough, beyond = True, ROUGH, -1.0

    def _spoilt(self, theta, residuals):
        if abs(theta.get("effect_00", 0.0)) / EFFECTS[0].floor <= self.beyond:
            return residuals
        noise = (
            np.random.default_rng(1).standard_normal(len(residuals[BAD]))
            * self.rough
            * self._windows[BAD].sigma
        )
        return [r + noise if i == BAD else r for i, r in enumerate(residuals)]

    def windows(self, theta):
        found = super().windows(theta)
        return [replace(w, shaken=self.shaken and i == BAD) for i, w in enumerate(found)]

    def residuals(self, theta, about=None):
        return self._spoilt(theta, super().residuals(theta, about))


def lost_of(model) -> list[int]:
    windows = model.windows({})
    problem = Problem(model, tuple(range(len(windows))))
    return lost(linearise(problem, np.zeros(len(model.effects)), windows=windows))


@pytest.mark.parametrize(
    ("shaken", "rough", "expected"),
    [(True, 0.0, []), (True, ROUGH, [BAD]), (False, ROUGH, []), (False, 3.0, [BAD])],
)
def test_less_misfit_is_taken_from_a_window_after_slack(shaken, rough, expected):
    model = Spoiled(effects=EFFECTS, throws=8, seed=4)
    model.shaken, model.rough = shaken, rough
    assert lost_of(model) == expected


def test_a_window_that_is_lost_where_the_cause_is_is_left_out_and_the_search_goes_on():
    said = []
    model = Spoiled(effects=EFFECTS, truth={"effect_00": 15.0}, throws=8, seed=4)
    model.rough, model.beyond = 4.0, 5.0
    diagnosis = search.explain(model, laws=False, progress=said.append)
    assert sum("are left out, which the simulation does not follow" in line for line in said) == 1
    assert sum("named" in line for line in said) == 1
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("effect_00",)
    assert diagnosis.windows == len(model.windows({})) - 1


@pytest.mark.parametrize(
    ("active", "stands"), [([0], True), ([0, 5], False), ([5], False), ([], False)]
)
def test_without_lost_windows_the_search_goes_on_from_names_that_stand_alone(active, stands):
    """Otherwise it begins anew: the window may have brought the name.

    Terms that were looked at on the way are left behind.
    """
    model = SyntheticModel(effects=EFFECTS, truth={"effect_00": 15.0}, throws=8, seed=4)
    problem = Problem(model, tuple(range(len(model.windows({})))))
    nominal = linearise(problem, np.zeros(len(EFFECTS)))
    at = selector.Selector(problem, nominal, 5.0, lambda _: None, active=active, origin=nominal)
    at.point = candidate(at.problem, nominal, active)
    drag = terms.as_effect(Term("vehicle force", ("speed",), "vel"), 0.1, 7.0)
    at.problem, (at.origin, at.point) = terms.extended(problem, (at.origin, at.point), [drag])
    left = [i for i in problem.kept if i != BAD]
    assert at.stands_without([BAD], problem.only(left), only(nominal, left), 5.0) == stands
    assert len(at.point.windows) == len(at.origin.windows) == len(left)
    assert len(at.point.theta) == len(at.priors.floor) == len(EFFECTS)


def test_windows_soon_after_slack_are_marked(monkeypatch):
    """The rope whips for some time: what begins calmly is left with less freedom than it has."""
    logs = fly(setting_with({}), noise=0.2, free=1, throws=0, seconds=5.0)
    model = ThrowModel(logs, paper_plant(), only=["rope_length"])
    cuts = model.flights.cuts
    never = np.array([c.start - 1.0 for c in cuts])
    assert not any(
        c.after_slack for c in model._without_slack({"slack_first": never, "slack_last": never})
    )
    last = never.copy()
    last[1] = cuts[1].start + 0.1
    first = np.where(np.arange(len(cuts)) == 1, cuts[1].start + 0.05, never)
    after = model._without_slack({"slack_first": first, "slack_last": last})
    for c in after:
        assert c.after_slack == (c.retained and last[1] < c.start < last[1] + RINGING), c
    assert sum(c.after_slack for c in after) == 2


def test_a_rope_that_hung_still_begins_straighter():
    """In windows after hover, and in a flight's first one if it is hover itself; not where it flew,
    swung or came taut before.
    """
    model = ThrowModel(
        fly(setting_with({}), noise=0.2, free=1, throws=1, seconds=5.0),
        paper_plant(),
        only=["rope_length"],
    )
    bend = next(d for d in model._directions if d.calm is not None)
    before, spreads = None, set()
    for c in model.flights.cuts:
        phase = c.phase if before is None or before.flight != c.flight else before.phase
        assert c.at_rest == (phase == "hover"), c
        assert bend.spread(c) == pytest.approx((HUNG if c.at_rest else 1.0) * bend.calm)
        assert bend.spread(replace(c, after_slack=True)) == bend.sd > bend.calm
        before = c
        spreads.add(c.at_rest)
    assert spreads == {True, False}
