"""Confirmation of names by held-out flights, and alternative explanations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from pytest import approx, mark

from tests.synthetic_diagnosis import EFFECTS, SyntheticModel, explain_without_laws
from visthrow.diagnose.reporting.diagnosis_report import instead
from visthrow.diagnose.select import candidates, held_out, result, verdicts


@mark.parametrize(
    ("nats", "came", "sure"),
    [
        ([30.0, 40.0, 35.0], [29.0, 41.0, 36.0], True),
        (
            [0.01, 30.0, 40.0, 35.0],
            [0.0, 29.0, 41.0, 36.0],
            True,
        ),  # one flight cannot tell: it counts neither way
        (
            [30.0, 40.0, 35.0],
            [90.0, -60.0, 10.0],
            False,
        ),  # three flights that do not agree
        ([1.0, 1.2, 1.1], [1.0, 1.2, 1.1], False),  # 3 nats agree by chance as well
        ([200.0, 0.1], [200.0, 0.1], False),  # one flight alone
    ],
)
def test_names_are_confirmed_by_what_flights_agree_on(nats, came, sure):
    share, low, _ = held_out.share_of(np.array(nats), np.array(came))
    assert share == approx(sum(came) / sum(nats))
    assert (low > 0.0) == sure


def test_of_what_flights_hardly_show_no_size_is_claimed():
    """An effect a millionth as strong: its interval would be the prior's."""
    weak = EFFECTS[7]
    weak = replace(weak, prior_sd=1e-6 * weak.floor, floor=1e-6 * weak.floor)
    effects = (*EFFECTS[:7], weak, *EFFECTS[8:])
    diagnosis = explain_without_laws(world({"effect_05": 40.0}, effects=effects))
    assert diagnosis[weak.name].verdict == result.NOT_IDENTIFIABLE
    assert "hardly add to the prior" in diagnosis[weak.name].sentence
    assert diagnosis["effect_01"].verdict != result.NOT_IDENTIFIABLE


def world(truth, **options) -> SyntheticModel:
    """Twelve flights of some effects."""
    return SyntheticModel(truth=truth, throws=8, free=4, seed=2, **options)


GAIN = result.ChannelGain("pos_w", "m", 0.02, 0.0101, 0.01, float("nan"), 0.5, 0.4, 0.6, ())


def contradict(monkeypatch, truth, same=(), **changes):
    """A diagnosis that its held-out flights contradict."""
    plain = held_out.measure

    def measure(*args):
        return replace(plain(*args), **changes)

    monkeypatch.setattr(held_out, "measure", measure)
    return explain_without_laws(world(truth, same=dict(same)))


@mark.parametrize(
    ("share", "low", "high", "verdict", "reason"),
    [
        (0.4, -0.2, 1.0, result.CANDIDATE, "confirm effect_05 (they show 40 % [-20, 100]"),
        (-0.1, -0.3, 0.1, result.NOT_IDENTIFIABLE, "are predicted worse with effect_05"),
    ],
)
def test_names_that_held_out_flights_do_not_confirm_are_none(
    monkeypatch, share, low, high, verdict, reason
):
    diagnosis = contradict(monkeypatch, {"effect_05": 40.0}, share=share, low=low, high=high)
    assert (diagnosis.overall, dict(diagnosis.theta)) == (result.UNKNOWN, {})
    assert diagnosis["effect_05"].verdict == verdict
    assert reason in diagnosis.reasons[0]


def test_the_test_that_failed_is_reported_with_the_flight_that_would_settle_it(monkeypatch):
    """Here the names bring the nats that they promise, and no channel's error falls for sure."""
    monkeypatch.setattr(held_out, "compares_phases", lambda point: False)
    gain = replace(GAIN, after=0.019, gain=0.05, low=-0.1, high=0.2)
    diagnosis = contradict(monkeypatch, {"effect_05": 40.0}, channels=(gain,), folds=2)
    assert diagnosis["effect_05"].verdict == result.CANDIDATE
    assert "no channel's error surely decreases: pos_w 5 % [-10, 20]" in diagnosis.reasons[0]
    assert "fly once more, for example: swing" in diagnosis.reasons[0]


def test_an_error_that_hardly_moves_a_landing_is_negligible(monkeypatch):
    monkeypatch.setattr(held_out, "compares_phases", lambda point: False)
    gain = replace(GAIN, after=4e-3, floor=1e-3)
    assert contradict(monkeypatch, {"effect_05": 40.0}, channels=(gain,)).overall == result.KNOWN


def test_intervals_of_the_gain_hold_what_they_promise():
    """Four flights that excite a cause unequally, each of which has a size of its own."""
    rng = np.random.default_rng(0)
    excited = rng.lognormal(6.0, 1.0, (400, 4))
    noise = rng.normal(1500.0, 150.0, (2, 400, 4))  # drawn anew, for what it adds to the fall
    before = excited * rng.normal(1.0, 0.2, excited.shape) + noise[0]
    inside = 0
    for promised, old, new in zip(excited, before, noise[1]):
        _, low, high = held_out.gain_of(old, new, promised, np.ones(4))
        inside += low < 1.0 - np.sqrt(6000.0 / (6000.0 + promised.sum())) < high
    assert 0.92 < inside / 400 < 0.995


@mark.parametrize("sure", [True, False])
def test_flights_that_excite_a_cause_unequally_confirm_it_where_they_agree(sure):
    """Recorded sums of squares: a flight falls as the size promises, or is far worse."""
    before = np.array([4850.5, 4876.6, 2241.5, 30308.6])
    after = np.array([1570.0 if sure else 9000.0, 1453.8, 2277.7, 1523.1])
    promised = np.array([3861.6, 4273.4, 342.2, 27537.8])
    assert (held_out.gain_of(before, after, promised, np.ones(4))[1] > 0.0) == sure


def test_a_cause_that_explains_nearly_all_in_each_flight_has_a_narrow_interval_of_the_gain():
    """A hundredth of the squares is left."""
    before = np.array([1e6, 2e6])
    _, low, high = held_out.gain_of(before, 0.01 * before, before * [1.05, 0.97], before)
    assert high - low < 0.1


def test_a_channel_without_an_interval_neither_confirms_nor_denies(monkeypatch):
    """One flight alone holds it, such as a payload that was tracked once."""
    monkeypatch.setattr(held_out, "compares_phases", lambda point: False)
    one = np.array([10.0, 0.0, 0.0])
    _, low, high = held_out.gain_of(3.0 * one, one, one, one)
    once = replace(GAIN, channel="one", low=low, high=high)
    often = replace(once, channel="often", low=0.3, high=0.6)
    assert (once.interval, often.interval) == ("[no interval]", "[30, 60]")
    truth = {"effect_05": 40.0}
    with monkeypatch.context() as patch:
        assert list(contradict(patch, truth, channels=(once, often)).theta) == ["effect_05"]
    assert not contradict(monkeypatch, truth, channels=(once,)).theta


def test_nothing_is_named_over_an_interval_that_holds_zero():
    """Also where the evidence for it is overwhelming."""
    diagnosis = explain_without_laws(world({"effect_05": 40.0}))
    findings = [
        replace(f, low=-f.low, verdict=result.CANDIDATE) if f.name == "effect_05" else f
        for f in diagnosis.findings
    ]
    wide = held_out.judge(replace(diagnosis, findings=tuple(findings)))
    assert (wide.overall, dict(wide.theta)) == (result.UNKNOWN, {})
    assert wide["effect_05"].verdict == result.CANDIDATE
    assert "interval holds 0" in wide.reasons[0]
    rivals = [replace(f, low=abs(f.low)) for f in findings]
    rivalled = held_out.judge(replace(diagnosis, findings=tuple(rivals)))
    assert "sets of causes without them" in rivalled.reasons[0]
    assert diagnosis["effect_05"].differs > diagnosis["effect_05"].sd
    findings = [replace(f, nats=-1.0) if f.name == "effect_05" else f for f in findings]
    unasked = held_out.judge(replace(diagnosis, findings=tuple(findings)))["effect_05"]
    assert (unasked.verdict, unasked.estimate) == (result.BOUNDED, 0.0)
    assert unasked.sentence.endswith("if present at all.")


def test_a_name_that_few_searches_find_again_is_a_candidate(monkeypatch):
    """Of two, the other keeps its name, with the size and interval that are printed."""
    truth, named_in = {"effect_05": 40.0, "effect_02": 40.0}, {"effect_05": 1.0, "effect_02": 2 / 3}
    far = replace(GAIN, channel="quat_wb", after=0.027)
    for channels, error in (
        ((GAIN,), ", no residual above the noise"),
        (
            (GAIN, far),
            "; on held-out flights the error of quat_wb is 2.7 times that of noise alone",
        ),
    ):
        with monkeypatch.context() as patch:
            diagnosis = contradict(patch, truth, named_in=named_in, channels=channels)
        assert diagnosis.reasons == (f"1 named, 1 candidate besides{error}",)
    assert diagnosis["effect_02"].verdict == result.CANDIDATE
    assert "repeated without some flights, does not always" in diagnosis["effect_02"].sentence
    printed = diagnosis["effect_05"]
    assert diagnosis.theta == {"effect_05": printed.estimate}
    assert printed.sd**2 <= diagnosis.covariance[0][0] < printed.sd**2 + printed.differs**2
    work = diagnosis.work
    trained = held_out.cross_validate(diagnosis).trained
    sizes = trained[:, work.active[0]] * EFFECTS[5].floor
    assert np.all(np.abs(sizes - printed.estimate) < 3.0 * printed.sd)
    assert not trained[:, 2].any()  # nor is the candidate written
    assert diagnosis.overall == result.KNOWN


def test_held_out_figures_are_those_of_the_names_that_stay(monkeypatch):
    plain = held_out.measure
    truth, named_in = {"effect_05": 40.0, "effect_02": 40.0}, {"effect_05": 1.0}
    diagnosis = contradict(monkeypatch, truth, named_in=named_in)
    assert list(diagnosis.theta) == ["effect_05"]
    again = plain(replace(diagnosis, work=replace(diagnosis.work, crossed=None)))
    assert diagnosis.held_out.share == again.share
    gains = [(c.channel, c.after, c.gain) for c in again.channels]
    assert [(c.channel, c.after, c.gain) for c in diagnosis.held_out.channels] == gains


def test_a_withdrawn_class_is_one_candidate(monkeypatch):
    truth = {"effect_05": 40.0, "effect_03": 12.0}
    same = {"effect_07": ("effect_03", 0.5)}
    diagnosis = contradict(monkeypatch, truth, same, named_in={"effect_05": 1.0})
    assert diagnosis["effect_03"].partners == ("effect_07",)
    assert diagnosis["effect_03"].verdict == diagnosis["effect_07"].verdict == result.CANDIDATE
    assert diagnosis.reasons[0].startswith("1 named, 1 candidate besides")


def test_two_causes_that_may_be_two_others_are_reported():
    sets = [
        (("lag", "drag"), 0.0),
        (("lag", "mass"), 0.4),
        (("mass", "curve"), 1.66),
        (("sag",), 2.9),
    ]  # the second is a class
    lines = instead(SimpleNamespace(theta={"lag": 1.0, "drag": 2.0}, sets=sets))
    assert lines == [
        "curve, mass in place of drag, lag, 1.7 nats behind",
        "sag in place of drag, lag, 2.9 nats behind",
    ]
    assert (
        instead(SimpleNamespace(theta={"lag": 1.0}, sets=sets)) == []
    )  # a law took the place of one
    assert instead(SimpleNamespace(theta={}, sets=())) == []


def test_several_forms_at_once_are_another_form(monkeypatch):
    """Two effects that differ from flight to flight at once: neither is the cause."""
    numbers = dict.fromkeys(("size", "low", "high", "nats", "flights"), 8.0)
    effect = "", "", "", (), "N", "rope", 1.0, 0.1, ""
    form = candidates.Scatter(*effect, found=True, **numbers)
    forms = tuple(replace(form, name=f"effect_{i:02d}_by_flight") for i in (1, 4))
    overall = []
    for count in (1, 2):
        shares = forms[:count], {}
        monkeypatch.setattr(verdicts, "random_shares_of", lambda selection, shares=shares: shares)
        overall.append(explain_without_laws(world({"effect_05": 40.0})).overall)
    assert overall == [result.KNOWN, result.UNKNOWN]
