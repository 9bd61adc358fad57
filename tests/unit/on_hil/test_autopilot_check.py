"""The check of a recorded run's hover."""

import shutil
from types import SimpleNamespace

from pytest import approx, fixture, mark, raises

from hil.check import SETTLING, AutopilotCheck, hover_of_run
from hil.control.loop import Loop
from hil.control.recording.record import TICKS, RunRecorder
from hil.errors import RunError
from hil.poses.pose import VEHICLE
from tests.commands import run_command
from tests.configs import load_run
from tests.hil_flight import NEVER, Nobody
from tests.hil_runs import copy_run
from tests.level import LevelPlant
from tests.loopback.wire import peers

QUICK = ("states.check_hold=0.2",)


@fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that hovers for some seconds."""
    folder = tmp_path_factory.mktemp("hover") / "run"
    runner, source, clock, _ = peers(LevelPlant(), loaded=NEVER, overrides=QUICK)
    recorder = RunRecorder(folder, runner.params)
    recorder.close(Loop(runner, source, clock, Nobody(), recorder).fly(4.0))
    return folder


def test_the_hover_of_a_run_is_its_weight(run):
    good, text = hover_of_run(run)
    assert good
    words = text.removeprefix("hover took ").split()
    assert float(words[0]) == approx(1.0, abs=0.005)


@mark.parametrize(("factor", "good"), [(1.05, True), (1.12, False), (0.85, False)])
def test_a_hover_that_took_another_thrust_gives_the_share_to_write_down(
    run, tmp_path, factor, good
):
    def strengthen(ticks):
        for tick in ticks:
            if tick["command"]:
                tick["command"][0] *= factor

    passed, text = hover_of_run(copy_run(run, tmp_path, strengthen))
    assert passed == good
    assert run_command(f"hil check --hover-of {tmp_path}") == (0 if good else 1)
    ratio = float(text.split()[2])
    assert ratio == approx(factor, rel=0.01)
    share = float(text.split("the hover share is ")[1].split(",")[0])
    assert share == approx(0.1906 * ratio, rel=2e-3), "a straight line: as much more share"


def test_a_hover_counts_once_it_has_settled(run, tmp_path):
    """Neither the first second nor the one after a break is the hover's thrust."""

    def disturb(ticks):
        flown = [i for i, tick in enumerate(ticks) if tick["state"] == "ready" and tick["command"]]
        middle = flown[len(flown) // 2]
        ticks[middle]["state"] = "throw"
        for i in (*flown[:SETTLING], *range(middle + 1, middle + 1 + SETTLING)):
            ticks[i]["command"][0] *= 3.0

    assert hover_of_run(copy_run(run, tmp_path, disturb))[1].startswith("hover took 1.0")


@mark.parametrize(
    ("height", "speed", "counted"), [(0.31, 0.14, 1), (0.29, 0.14, 0), (0.31, 0.16, 0)]
)
def test_each_report_of_a_steady_flight_counts_once(height, speed, counted):
    params = load_run("fake")
    backend = SimpleNamespace(share=0.2, service=lambda now: None)
    check = AutopilotCheck(params, backend)
    state = SimpleNamespace(pos=(0.0, 0.0, height))
    track = SimpleNamespace(state=lambda now: state, calm_speed=lambda: speed)
    for now in (0.0, 0.02, 0.04):
        check.tick(now, SimpleNamespace(tracks={VEHICLE: track}))
    assert f"not measured: {counted} of" in check.meter.summary_text(0.3)[1]


def test_runs_that_say_nothing_of_a_hover(run, tmp_path):
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    (tmp_path / TICKS).unlink()
    with raises(RunError, match="not the folder of a run; expected"):
        hover_of_run(tmp_path)
    (tmp_path / TICKS).write_text("")
    with raises(RunError, match="0 ticks of steady hover before throws; expected 50 or more"):
        hover_of_run(tmp_path)
