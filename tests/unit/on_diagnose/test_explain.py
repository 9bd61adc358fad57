"""``visthrow diagnose explain`` on logs of which some are copies, or wrong."""

import json

import numpy as np
from pytest import approx, fixture

from bench.diagnose.altered import change_channels
from bench.diagnose.cases import logs_of
from bench.worlds.world import Recipe
from tests.commands import run_command
from visthrow import cli
from visthrow.diagnose.reporting.explain_cli import REFUSED
from visthrow.logs.flightlog import FlightLog
from visthrow.task import draw_plants, load_experiment

MODEL = ("--only", "com_x", "--set", "rope.segments=1", "--device", "cpu", "--no-report")


@fixture(scope="module")
def flights():
    """Three throws of a vehicle whose centre of mass lies 3 mm forward."""
    return logs_of(Recipe(4, "rod", {"com_x": 3e-3}, 30.0, free=0, throws=3))


def explained(logs, folder, *arguments):
    """Exit status, and the JSON of an explanation."""
    for i, log in enumerate(logs):
        log.save(folder / f"{i}.npz")
    names = [str(folder / f"{i}.npz") for i in range(len(logs))]
    status = cli.main(["diagnose", "explain", *names, *MODEL, "--out", str(folder), *arguments])
    return status, json.loads((folder / "diagnosis.json").read_text())


@fixture(scope="module")
def once(flights, tmp_path_factory):
    """Folder, exit status and JSON of the flights' explanation."""
    folder = tmp_path_factory.mktemp("once")
    return folder, *explained(flights, folder)


def in_millimetres(log: FlightLog) -> FlightLog:
    return change_channels(log, {"pos_w": lambda x: 1e3 * x, "payload_pos_w": lambda x: 1e3 * x})


def test_a_copied_log_counts_once(flights, once, tmp_path):
    _, status, once = once
    again, twice = explained([*flights, flights[0]], tmp_path)
    assert status == again == 0
    assert twice["duplicates"] == {"3": 0}
    assert (twice["flights"], once["model"], once["plant"]) == (3, "throw", "state")
    assert once["overrides"] == ["rope.segments=1"]
    assert "effects out: one of them may be the true cause" in once["reasons"][-1]
    assert twice["theta"] == approx(once["theta"])


def test_a_page_of_an_earlier_diagnosis_is_named(flights, tmp_path, capsys):
    (tmp_path / "report.html").write_text("of last week")
    assert explained(flights[:1], tmp_path)[0] == 0
    assert f"{tmp_path / 'report.html'}, its pictures" in capsys.readouterr().out


def test_what_was_explained_is_what_training_draws(once, tmp_path):
    """From flights to the draws of a training, through the files that users pass on."""
    out = tmp_path / "mine.toml"
    assert run_command(f"diagnose apply {once[0]}/diagnosis.json --out {out}") == 0
    diagnosed = load_experiment(out).diagnosed
    assert diagnosed.effects == ("com_x",)
    (sd,) = np.sqrt(diagnosed.covariance[0])
    assert 2e-5 < sd < 4e-4, "of 3 mm that three throws show to a few hundredths"
    centres = [plant.vehicle.body.com[0] for plant in draw_plants(load_experiment(out), 0)]
    assert np.mean(centres) == approx(3e-3, abs=3.0 * sd)
    assert np.std(centres) == approx(sd, rel=0.5)


def test_one_bad_log_of_three_does_not_refuse_the_others(flights, tmp_path):
    status, answer = explained([in_millimetres(flights[0]), *flights[1:]], tmp_path)
    assert (status, answer["flights"]) == (0, 2)
    assert any(reason.startswith("left out: 0.npz") for reason in answer["reasons"])


def test_where_most_logs_are_bad_the_status_says_so(flights, tmp_path):
    status, answer = explained([*map(in_millimetres, flights[:2]), flights[2]], tmp_path)
    assert (status, answer["overall"]) == (REFUSED, "DATA INCONSISTENT")
    assert np.size(answer["findings"]) == 0


def test_no_earlier_answer_is_left_where_an_explanation_stops(flights, tmp_path):
    """Neither where the logs contradict themselves, nor where a run ends without an answer."""
    earlier = tmp_path / "diagnosis.json"
    earlier.write_text('{"overall": "KNOWN"}')
    names = []
    for i, log in enumerate(map(in_millimetres, flights)):
        names.append(str(tmp_path / f"{i}.npz"))
        log.save(names[-1])
    command = ["diagnose", "explain", *names, "--out", str(tmp_path), "--device", "cpu"]
    assert cli.main(command) == REFUSED
    assert json.loads(earlier.read_text())["overall"] == "DATA INCONSISTENT"
    assert cli.main([*command, "--without", "0,1,2"]) == 2
    assert not earlier.exists()
