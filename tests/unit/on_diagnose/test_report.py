"""Gain on held-out flights, effects hidden in the flights' own noise, the plan, and the report."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from tests.commands import run_command
from tests.places import DATA
from tests.synthetic_diagnosis import EFFECTS, SyntheticModel, explain_without_laws
from visthrow.common.errors import DiagnoseError
from visthrow.common.storage import write_json
from visthrow.diagnose.inputs import measures
from visthrow.diagnose.likelihood import forms
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.planning import fly_manoeuvres, manoeuvres, plan
from visthrow.diagnose.reporting import blind, explain_cli, gain
from visthrow.diagnose.reporting import diagnosis_report as report
from visthrow.diagnose.select import result
from visthrow.diagnose.throw.landing import PredictedLandings
from visthrow.view import page

SWING = str(DATA / "real" / "pendulum_single" / "single_pendulum_id.csv.gz")
STAND = str(DATA / "real" / "motor_prop_stand" / "all_tests.csv.gz")
TRUTH = {"effect_03": 12.0, "effect_04": -9.0}


ARMS = {"effect_03": 2.0, "effect_04": 5.0}
"""Distance by which an effect moves landings, per its unit, along x and along y."""


class Throwing(SyntheticModel):
    """Also predicts where throws land: off by what the effects' sizes miss of the truth, and by 2
    mm at random.
    """

    def landings(self, theta, flights=None):
        """See :meth:`visthrow.diagnose.throw.throw_model.ThrowModel.landings`."""
        numbers = np.array(
            sorted({w.flight for w in self._windows}) if flights is None else list(flights)
        )
        floors = {e.name: e.floor for e in self.effects}
        missing = np.array(
            [ARMS[n] * (size * floors[n] - theta.get(n, 0.0)) for n, size in self.truth.items()]
        )
        scatter = np.array([default_rng(int(n)).normal(0.0, 2e-3, 3) for n in numbers])
        off = np.tile([*missing, 0.0], (len(numbers), 1)) + scatter
        return PredictedLandings(numbers, np.zeros_like(off), off, 0.1 * off)


@fixture(scope="module")
def diagnosed():
    model = Throwing(truth=TRUTH, seed=1)
    return model, explain_without_laws(model)


def test_landings_are_reported_in_millimetres(diagnosed, measured):
    """Before, after with causes sized by the other flights, and by each cause alone; in the text
    too.
    """
    floors = {e.name: e.floor for e in EFFECTS}
    alone = {n: abs(ARMS[n] * size * floors[n]) for n, size in TRUTH.items()}
    landing = measured.landing
    assert landing.held_out
    assert landing.throws == 6
    assert landing.before == approx(np.hypot(*alone.values()), rel=0.1)
    assert landing.low <= landing.after <= landing.high < 0.5 * landing.before
    assert landing.released_before == approx(0.1 * landing.before)
    for name, moved in landing.moved.items():
        assert moved == approx(alone[name], rel=0.2)
    text = report.summary(diagnosed[1], measured)
    assert f"It moves landings by {1e3 * landing.moved['effect_03']:.0f} mm." in text
    assert f"falls from {1e3 * landing.before:.0f} to {1e3 * landing.after:.0f} mm" in text
    assert report.to_json(diagnosed[1], measured)["gain"]["landing"]["after"] == landing.after


@fixture(scope="module")
def measured(diagnosed):
    return gain.measure(diagnosed[1])


def test_flights_without_a_measured_landing_have_no_gain_in_landings(diagnosed, monkeypatch):
    model, diagnosis = diagnosed
    monkeypatch.setattr(model, "landings", lambda theta, flights: None)
    assert gain.measure(diagnosis).landing is None


def test_prediction_does_not_look_at_what_it_predicts(diagnosed):
    _, diagnosis = diagnosed
    point = diagnosis.work.after
    window = point.windows[0]
    late = window.time > window.time.min() + 0.7
    plain, spoilt = (
        forms.predict(window, point.noise, residual)[0]
        for residual in (window.residual, window.residual + late)
    )
    assert_allclose(spoilt[~late], plain[~late])
    assert_allclose((spoilt - plain)[late], 1.0 / window.sigma[late])


@fixture(scope="module")
def hidden(diagnosed):
    return blind.hide(diagnosed[1], draws=60)


def test_completeness_rises_and_noise_is_not_named(hidden):
    assert hidden.false_alarms < 0.01
    for curve in hidden.curves:
        assert curve.up_to_class[-1] == 1.0
        assert curve.exact[0] < 0.1
        assert max(curve.wrong) < 0.05
        assert 2.0 < curve.limit / curve.sizes[0] < 20.0


SAME = {"effect_07": ("effect_03", 0.5)}


def twins() -> SyntheticModel:
    """Flights of an effect that another one acts like."""
    return SyntheticModel(truth={"effect_03": 12.0}, same=SAME, seed=2)


@fixture(scope="module")
def degenerate():
    return explain_without_laws(twins())


def test_the_plan_prefers_the_manoeuvre_that_separates(degenerate):
    apart = SyntheticModel(truth={"effect_03": 12.0}, throws=1, free=0, seed=9)
    alike = SyntheticModel(same=SAME, throws=1, free=0, seed=9)
    aim = plan.PlanningGoal(degenerate)
    models = {"hover": alike, "circle": apart}
    informations = [
        (m, aim.information(models[m.name])) for m in manoeuvres.catalogue() if m.name in models
    ]
    ranked = plan.propose(aim, informations)
    assert [p.name for p in ranked] == ["circle", "hover"]
    assert ranked[0].nats > plan.DECISIVE > ranked[1].nats
    assert ranked[0].repeats == 1
    assert ranked[0].separates
    assert ranked[1].repeats == 0


def test_a_session_holds_what_separates_more_than_what_stands_before_it():
    flights = (
        ("circle", (("a", "b"), ("a", "c"))),
        ("swing", (("a", "c"),)),
        ("hover", ()),
        ("weigh", (("a", "d"),)),
    )
    proposals = [
        plan.FlightProposal(name, "", 10.0, 12.0, separates, 1, "") for name, separates in flights
    ]
    assert [p.name for p in plan.session(proposals)] == ["circle", "weigh"]


@mark.parametrize(("telling", "repeats"), [(0, 3), (1, 2), (2, 1)])
def test_a_name_needs_three_flights_that_tell_of_it(telling, repeats):
    """Confirmation leaves out one held-out flight at a time; two give an unbounded interval."""
    goal = plan.PlanningGoal.__new__(plan.PlanningGoal)
    one = np.ones(1)
    goal.priors = Priors(one, one, -9.0 * one, 9.0 * one, one > 0.0)
    goal.diagnosis = SimpleNamespace(work=SimpleNamespace(active=()))
    goal.pairs, goal.vague = [], [0]
    flights = np.zeros((4, 1, 1))
    flights[:telling] = 10.1
    goal.base = SimpleNamespace(
        posterior=Posterior(flights.sum(0), np.zeros(1), goal.priors),
        statistics=SimpleNamespace(information=flights),
    )
    assert goal.settle(np.full((1, 1), 100.0)) == ([(0,)], repeats)


def test_a_scale_settles_what_no_flight_separates(degenerate, monkeypatch):
    """Weighed and found right, one member of a class is out, and the other has the name."""
    floor = {e.name: e.floor for e in EFFECTS}
    scale = measures.Measurement("weigh", "effect_07", floor["effect_07"], 60.0)
    monkeypatch.setattr(plan, "MEASUREMENTS", (scale,))
    (proposal,) = plan.propose(plan.PlanningGoal(degenerate, ("effect_03",)), [])
    assert proposal.name == "weigh"
    assert {frozenset(pair) for pair in proposal.separates} == {
        frozenset(("effect_03", "effect_07"))
    }
    assert not plan.propose(plan.PlanningGoal(degenerate, ("effect_00",)), [])
    model = twins()
    model.effects = measures.narrow(EFFECTS, measures.parse([f"effect_07={scale.sd}"]))
    assert explain_without_laws(model)["effect_03"].verdict == result.FOUND


@mark.parametrize("item", ["effect_07", "effect_07=much", "effect_07=-1", "nobody=1,effect_07=1"])
def test_measurements_that_are_none_are_refused(item):
    assert measures.parse(["a=1,b=2", "c=3"]) == {"a": 1.0, "b": 2.0, "c": 3.0}
    with raises(DiagnoseError, match=item.split("=")[0]):
        measures.narrow(EFFECTS, measures.parse([item]))


@mark.parametrize("manoeuvre", manoeuvres.catalogue(), ids=lambda m: m.name)
def test_manoeuvres_are_smooth_bounded_and_begin_at_rest(manoeuvre):
    r = manoeuvre
    assert r.time[-1] == approx(manoeuvre.seconds, abs=0.05)
    assert np.abs(r.vel_w[[0, -1]]).max() < 1e-6
    assert np.abs(np.gradient(r.vel_w, manoeuvres.PERIOD, axis=0)).max() < 12.0
    assert r.pos_w[:, 2].min() > (0.5 if manoeuvre.payload else 0.08)
    assert np.abs(r.pos_w[:, :2]).max() < 2.6
    assert np.linalg.norm(r.vel_w, axis=1).max() < 5.5
    assert len(r.csv().splitlines()) == 1 + len(r.time)


@mark.parametrize(
    ("part", "used"), [(0.0, 0.0), (0.9, 0.9), (1.2, 1.2), (np.nan, fly_manoeuvres.LOST)]
)
def test_a_flight_that_nears_the_ground_has_no_model(part, used):
    """It hovers 0.11 m high and is aborted at half of it."""
    chosen = next(m for m in manoeuvres.catalogue() if m.name == "hover low without payload")
    assert chosen.lowest == approx(0.055)
    place = np.repeat(chosen.pos_w, 4, axis=0) - [0.0, 0.0, part * chosen.lowest]
    flight = fly_manoeuvres.SimulatedFlight(chosen, None, {"pos_w": place}, None, None)
    simulated = flight.simulate(lambda _: "a model")
    assert simulated.used == approx(used)
    assert (simulated.model is None) == (used > 1.0)


def test_a_flight_in_which_the_payload_swings_too_far_has_no_model():
    """With the rope level, and the vehicle tilted by a tenth of a turn towards it, the swing is 54
    degrees; upright it is 90.
    """

    def level(turn: float) -> fly_manoeuvres.SimulatedFlight:
        chosen = next(m for m in manoeuvres.catalogue() if m.name == "throw at 2 m/s")
        rows = 4 * len(chosen.time)
        place = np.repeat(chosen.pos_w, 4, axis=0)
        hangs = np.where(
            np.arange(rows)[:, None] < 4 * np.argmax(chosen.release),
            [-0.38, 0.0, 0.0],
            [0.0, 0.0, 5.0],
        )  # then let go
        quat = np.tile([0.0, np.sin(0.5 * turn), 0.0, np.cos(0.5 * turn)], (rows, 1))
        truth = {"pos_w": place, "payload_pos_w": place + hangs, "quat_wb": quat}
        return fly_manoeuvres.SimulatedFlight(chosen, None, truth, None, None)

    flights = [level(0.0), level(0.2 * np.pi)]
    assert [flight.swing for flight in flights] == approx([90.0, 54.0])
    assert [flight.simulate(lambda _: "a model").model for flight in flights] == [None, "a model"]


def test_the_report_holds_sentences_pictures_and_numbers(
    tmp_path, diagnosed, measured, hidden, degenerate
):
    _, diagnosis = diagnosed
    made = report.sections(
        diagnosis, measured, hidden, step_check={"pos_w": 0.03}, provenance={"logs": 7}
    )
    paths = page.write(tmp_path, "A report", report.sentence_of(diagnosis), made)
    written = paths[0].read_text(encoding="utf-8")
    for text in (
        "KNOWN",
        "effect_03",
        "cause 4",
        "Held-out prediction error",
        "noise alone",
        "circle",
        "finer steps",
    ):
        assert text in written
    assert written.count("data:image/png;base64") >= 6
    assert "http" not in written.replace("http-equiv", "")  # self-contained
    write_json(tmp_path / "d.json", report.to_json(diagnosis, measured, hidden))
    data = json.loads((tmp_path / "d.json").read_text(encoding="utf-8"))
    assert {f["verdict"] for f in data["findings"]} <= set(result.VERDICTS)
    assert set(data["theta"]) == set(TRUTH)
    assert data["gain"]["channels"][0]["channel"] == "pos_w"
    weighed = [replace(f, partners=(*f.partners, "mass_quad")) for f in degenerate.findings]
    text = report.summary(replace(degenerate, findings=tuple(weighed)))
    assert "weigh the vehicle (--measured mass_quad=0.0003)" in text
    assert "CLASS" in text
    assert "cannot tell it from" in text


def test_terms_that_act_together_are_printed_together(diagnosed):
    """A drag is the first explanation here by a pair; the second is one term alone."""
    first = result.Law(
        "vehicle force", ("speed_across_squared",), "vel", 4e-3, "F = c v_xy² v", 1e-4, "kg", 20.0
    )
    second = replace(first, formula="F = c |v| v_xy v", coefficient=-8e-3)
    alone = replace(first, formula="F = c |v| v", coefficient=-2e-3)
    both = ((first, second), (alone,))
    unknown = replace(
        diagnosed[1], overall=result.UNKNOWN, laws=(first, second, alone), explanations=both
    )
    text = page.markdown_of("", "", report.sections(unknown))
    (line,) = (line for line in text.splitlines() if "**Law.**" in line)
    assert "v_xy² v with c = 0.004" in line
    assert "|v| v_xy v with c = -0.008" in line
    assert line.endswith("which act together.")
    rows = [line.split("|")[1:3] for line in text.splitlines() if line.startswith("| ")]
    numbers = [row[0].strip() for row in rows if "F = c" in row[1]]
    assert numbers[:2] == ["1", "1"]
    assert len(numbers) == 3


def test_where_nothing_was_named_no_error_with_names_is_given(diagnosed, measured):
    rows = {}
    for theta in (diagnosed[1].theta, {}):
        (section,) = (
            s
            for s in report.sections(replace(diagnosed[1], theta=theta), measured)
            if s.title == "Gain on held-out flights"
        )
        rows[bool(theta)] = section.parts[0].rows[0]
    assert rows[True][:3] == rows[False][:3]
    assert "-" not in rows[True][3:5]
    assert rows[False][3:5] == ("-", "-")


def test_a_disk_that_is_full_at_a_picture_leaves_the_verdict(
    tmp_path, diagnosed, monkeypatch, capsys
):
    def full(*_):
        raise OSError("no space left")

    model, diagnosis = diagnosed
    monkeypatch.setattr(page, "write", full)
    monkeypatch.setattr(model, "step_error", dict, raising=False)
    with raises(OSError, match="no space"):
        explain_cli.write_report(tmp_path, diagnosis, model, [], 0, limits=False)
    assert "KNOWN" in capsys.readouterr().out
    assert '"KNOWN"' in (tmp_path / explain_cli.DIAGNOSIS).read_text(encoding="utf-8")


def test_the_recording_is_written(tmp_path, diagnosed):
    from visthrow.diagnose.reporting import recording

    recording.write(tmp_path / "d.rrd", diagnosed[1], [])
    assert (tmp_path / "d.rrd").stat().st_size > 10_000


@mark.parametrize(
    ("arguments", "message"),
    [
        ("explain nothing.npz", "nothing.npz"),
        ("blind nothing.npz", "nothing.npz"),
        ("plan nothing.npz", "nothing.npz"),
        ("explain nothing.npz --config nobody", "nobody"),
        ("map .", "a folder without flight.npz"),
        ("plan nothing.npz --hall nan,5,3", "--hall nan,5,3: expected three lengths"),
        ("plan nothing.npz --hall 5,5,0.5", "a height above 0.8 m"),
        ("plan nothing.npz --manoeuvres hoover", "did you mean 'hover'"),
        (f"explain {STAND} --config motor_stand --only=", "no effect ''"),
        (
            f"explain {STAND} --config motor_stand --test other.csv --no-report",
            "other.csv: no such file",
        ),
        (f"explain nothing.npz --out {SWING}", "single_pendulum_id.csv.gz is no folder"),
        (f"blind nothing.npz --out {SWING}", "single_pendulum_id.csv.gz is no folder"),
        (f"plan nothing.npz --out {SWING}", "single_pendulum_id.csv.gz is no folder"),
        ("check nothing.npz --json .", "it is a folder; expected a file"),
    ],
)
def test_mistakes_on_the_command_line_are_reported(
    capsys, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    assert run_command(f"diagnose {arguments}") == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out == "", "before the search"


def test_an_event_is_left_out_or_weighs_little(diagnosed):
    """A flight that was left out has no windows any more; one whose window is far rougher than
    others has.
    """
    _, diagnosis = diagnosed
    flights = {w.flight for w in diagnosis.work.after.windows}
    with_events = replace(diagnosis, events=(min(flights), max(flights) + 1))
    little, out = (
        line for line in report.summary(with_events).splitlines() if line.startswith("EVENT")
    )
    assert f"flight {min(flights)} " in little
    assert little.endswith("has less weight")
    assert f"flight {max(flights) + 1} " in out
    assert out.endswith("left out")
    parts = [part.text for part in report.sections(with_events)[0].parts if hasattr(part, "text")]
    assert sum(text.startswith("**EVENT.**") for text in parts) == 2
