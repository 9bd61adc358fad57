"""Causes that only some of the flights ask for are marked, and what else would explain the flights is told."""

from types import SimpleNamespace

from visthrow.diagnose.reporting.report import instead, not_firm


def diagnosis(**partners):
    """Of causes that were named, with the other members of their classes."""
    findings = [SimpleNamespace(name=name, partners=others) for name, others in partners.items()]
    return SimpleNamespace(findings=[*findings, SimpleNamespace(name="other", partners=())], theta=dict.fromkeys(partners, 1.0))


def test_a_cause_named_in_few_folds_is_marked():
    gain = SimpleNamespace(folds=4, left_out="flights", named_in={"lag": 0.25, "drag": 1.0, "mass": 0.5, "thrust": 0.5})
    said = not_firm(diagnosis(lag=(), drag=(), mass=("thrust",)), gain)
    assert said == ["lag is named in 25 % of the 4 searches that leave flights out"]
    assert not_firm(diagnosis(curve=()), gain) == ["curve is named in 0 % of the 4 searches that leave flights out"]


def test_nothing_is_said_without_folds():
    assert not_firm(diagnosis(lag=()), None) == []
    assert not_firm(diagnosis(lag=()), SimpleNamespace(folds=0, left_out="flights", named_in={})) == []


def test_two_of_three_are_not_firm_and_three_of_four_are():
    """In recorded flights what two of three parts named was told otherwise by the next flight."""
    named = {"lag": 2 / 3, "sag": 1 / 3, "curve": 1 / 3, "drag": 1.0}
    three = SimpleNamespace(folds=3, left_out="parts of flights", named_in=named)
    assert not_firm(diagnosis(lag=(), drag=()), three) == [
        "lag is named in 67 % of the 3 searches that leave parts of flights out"
    ]
    assert len(not_firm(diagnosis(sag=("curve",)), three)) == 1
    four = SimpleNamespace(folds=4, left_out="flights", named_in={"lag": 0.75})
    assert not_firm(diagnosis(lag=()), four) == []


def test_two_causes_that_may_be_two_others_are_told():
    sets = [(("lag", "drag"), 0.0), (("lag", "mass"), 0.4), (("mass", "curve"), 1.66), (("sag",), 2.9)]  # the second is a class
    told = instead(SimpleNamespace(theta={"lag": 1.0, "drag": 2.0}, sets=sets))
    assert told == ["curve, mass in place of drag, lag, 1.7 nats behind", "sag in place of drag, lag, 2.9 nats behind"]
    assert instead(SimpleNamespace(theta={"lag": 1.0}, sets=sets)) == []  # a law took the place of one
    assert instead(SimpleNamespace(theta={}, sets=())) == []
