"""What ``bench.runner`` makes of its measurements; and, slow, the measurements themselves
over UDP.
"""

import argparse
import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy import stats

from bench import faults as hil_faults
from bench import figures as hil
from bench import processes as hil_processes
from bench import runner
from bench import soak as hil_soak
from bench import throws as hil_throws
from bench.processes import Pair
from visthrow.cli import main
from visthrow.common.errors import VisthrowError
from visthrow.onboard.policy import Policy, find_policy

SOAK_MINUTES = 1.0
MOST_GROWTH = 100e3
"""Of the runner's memory [bytes/s]: 6 MB a minute; a list of every tick's record would grow by
more. A minute is short for a line, the recorder's buffers breathe.
"""


def test_upper_bound_of_a_ratio_of_pairs():
    """Against the delta method, for pairs that go along with each other."""
    rng = np.random.default_rng(0)
    base = 0.03 + 0.01 * rng.random(400)
    pairs = np.column_stack(
        (1.1 * base + 0.004 * rng.standard_normal(400), base + 0.004 * rng.standard_normal(400))
    )
    value, upper = hil.bootstrap_upper(pairs)
    rest = pairs[:, 0] - value * pairs[:, 1]
    deviation = rest.std() / pairs[:, 1].mean() / np.sqrt(len(pairs))
    assert value == pytest.approx(1.1, abs=0.02)
    assert upper - value == pytest.approx(stats.norm.ppf(0.9) * deviation, rel=0.15)


def test_growth_of_memory():
    rising = [(float(t), 1e6 + 500.0 * t + (1e5 if t < 20 else 0.0)) for t in range(200)]
    assert hil_soak.slope(rising) == pytest.approx(500.0)
    assert hil_soak.slope(rising[:5]) is None


def test_a_policy_that_never_releases_is_the_same_otherwise(tmp_path):
    import torch

    shipped = Policy.load(find_policy("vision_located"))
    made = Policy.load(hil_soak.never_releasing("vision_located", tmp_path / "p.npz"))
    seen = torch.randn(200, shipped.obs_dim)
    torch.testing.assert_close(made.act(seen)[:, :4], shipped.act(seen)[:, :4], rtol=0, atol=0)
    assert (made.act(seen)[:, 4] == -1.0).all()


def test_an_interrupted_series_goes_on_where_it_was(tmp_path, monkeypatch):
    flown = []

    def direct(seeds, args):
        for seed in seeds:
            yield {"way": "direct", "seed": seed, "error": 0.02 + 0.001 * seed, "duration": 1.0}

    def wire(seed, folder, args, cores):
        flown.append(seed)
        if seed == 2 and len(flown) == 3:
            raise KeyboardInterrupt
        return {
            "way": "wire",
            "seed": seed,
            "error": None if seed == 3 else 0.022 + 0.001 * seed,
            "duration": 1.0,
            "missed": 0,
            "missed_ours": 0,
            "late_periods": 0,
            "breaches": [],
        }

    monkeypatch.setattr(hil_throws, "_direct", direct)
    monkeypatch.setattr(hil_throws, "_over_the_wire", wire)
    args = argparse.Namespace(
        throws=4, seed=0, policy="state", out=str(tmp_path), keep_runs=False, speed=1.0, jobs=1
    )
    with pytest.raises(KeyboardInterrupt):
        hil_throws.series(args)
    with (tmp_path / "throws-state.jsonl").open("a") as file:
        file.write('{"way": "wire", "seed": 2, "err')  # cut short
    report = hil_throws.series(args)
    assert flown == [0, 1, 2, 2, 3], "what was flown is not flown again"
    assert len(hil.json_lines(tmp_path / "throws-state.jsonl")) == 8
    assert report.tables[0].rows[0][1] == "3 of 4"
    assert report.figures["ratio"] == pytest.approx(
        np.mean([0.022, 0.023, 0.024]) / np.mean([0.02, 0.021, 0.022])
    )
    assert "NOT met" in report.notes[0], "one did not land"


def test_throws_side_by_side_share_nothing(tmp_path, monkeypatch):
    """Each seed once, never two at once on one core; after an error nothing more is begun."""
    busy, flown, ports = set(), [], set()

    def wire(seed, folder, args, cores):
        assert not busy & set(cores)
        busy.update(cores)
        time.sleep(0.01)
        busy.difference_update(cores)
        flown.append(seed)
        ports.add(hil_processes.free_port())
        if seed == 11:
            raise VisthrowError("no")
        counts = {"missed": 0, "missed_ours": 0, "late_periods": 0, "breaches": []}
        return {"way": "wire", "seed": seed, "error": 0.02, "duration": 1.0, **counts}

    def direct(seeds, args):
        return ({"way": "direct", "seed": seed, "error": 0.02, "duration": 1.0} for seed in seeds)

    monkeypatch.setattr(hil_throws, "_direct", direct)
    monkeypatch.setattr(hil_throws, "_over_the_wire", wire)
    monkeypatch.setattr(
        hil_processes.os, "sched_getaffinity", lambda _: set(range(20)), raising=False
    )
    args = argparse.Namespace(
        throws=10, seed=0, policy="state", out=str(tmp_path), keep_runs=False, speed=1.0, jobs=4
    )
    assert hil_throws.series(args).figures["seeds"] == list(range(10))
    assert (sorted(flown), len(ports)) == (list(range(10)), 10)
    assert hil_processes.own_cores(10) == [(None, None)] * 10, (
        "one core is to spare for whoever asks"
    )
    args.throws = 40
    with pytest.raises(VisthrowError, match="no"):
        hil_throws.series(args)
    assert len(flown) < 20


@pytest.mark.parametrize(
    "words",
    ["--throws 1", "--minutes 0", "--rate 0.1", "--throws 5 --speed 3", "--throws 5 --jobs 0"],
)
def test_what_cannot_be_measured(words, tmp_path, capsys):
    assert runner.main([*words.split(), "--out", str(tmp_path)]) == 2
    assert "expected" in capsys.readouterr().err


def test_a_run_that_does_not_start_says_why(tmp_path):
    with pytest.raises(VisthrowError, match=r"did not start.*no policy 'nobody'"):
        Pair(("--config", "fake", "--set", "policy=nobody"), hil_soak.STILL).fly(tmp_path / "run")


def test_a_short_soak_over_udp(tmp_path, capsys):
    """Three seconds: all is counted, and the fake saw nothing that it should not.

    Times are for a quiet machine.
    """
    out, run = tmp_path / "soak.json", tmp_path / "run"
    assert (
        runner.main(
            ["--minutes", "0.05", "--json", str(out), "--keep", str(run), "--out", str(tmp_path)]
        )
        == 0
    )
    figures = json.loads(out.read_text())["figures"]
    assert figures["ticks"] > 50
    assert figures["breaches"] == []
    assert all(
        figures["latency_ms"][name]
        for name in ("poll", "estimate", "observation", "policy", "send", "total")
    )
    assert not figures["interrupted"]
    assert hil.json_lines(tmp_path / "soak.jsonl")[0]["memory_bytes"] > 50e6
    assert "within the bars" in capsys.readouterr().out.replace("NOT ", "")
    assert main(["hil", "replay", str(run)]) == 0


@pytest.mark.slow
def test_an_interrupted_soak_tells_what_there_is(tmp_path):
    out = tmp_path / "soak.json"
    words = ["--minutes", "0.3", "--json", str(out), "--out", str(tmp_path)]
    bench = subprocess.Popen(
        [sys.executable, "-m", "bench.runner", *words], stdout=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120.0
    while not (tmp_path / "soak.jsonl").is_file() and time.monotonic() < end:
        time.sleep(0.2)
    time.sleep(6.0)
    bench.send_signal(signal.SIGINT)
    text, _ = bench.communicate(timeout=120.0)
    figures = json.loads(out.read_text())["figures"]
    assert figures["interrupted"]
    assert 1.0 < figures["seconds"] < 17.0
    assert figures["ticks"] > 50
    assert "INTERRUPTED after" in text


@pytest.mark.slow
def test_a_minute_at_200_hz(tmp_path):
    """No tick of ours is missed and memory stays flat; how long a tick takes is for a quiet machine
    to say.
    """
    args = argparse.Namespace(
        minutes=SOAK_MINUTES, rate=200.0, policy="vision", core=None, keep=None, out=str(tmp_path)
    )
    figures = hil_soak.soak(args).figures
    assert figures["ticks"] + figures["missed"] >= 60 * 50 * SOAK_MINUTES
    assert figures["missed_ours"] == 0
    assert figures["breaches"] == []
    if figures["memory_bytes_per_s"] is not None:
        assert abs(figures["memory_bytes_per_s"]) < MOST_GROWTH


TOLD = (
    *(f"{name}{where}" for name in ("ctrl-c", "sigterm", "sighup") for where in ("", "-in-hover")),
    "time-over",
)
"""Ways for a run to end that it hears of."""

ITSELF = {
    "ardupilot": "levelled: no set-points",
    "px4": "left OFFBOARD: no set-points",
    "betaflight": "override: the pilot's sticks count again",
}
"""What each kind does by itself when nobody speaks any more."""

LANDS = {"ardupilot": "mode 9", "px4": "mode 4.6"}

FLOWN_THROUGH = {"none", "clock-forth", "clock-back", "shuffle", "double", "late", "disk-full"}
ENDS = {
    **dict.fromkeys(
        ("stop", "repeat", "swap", "jump", "order", "zero-quaternion", "nan-quaternion"),
        ("recover", "abort"),
    ),
    **dict.fromkeys(("reset", "stuck", "in-progress", "no-answer"), ("recover", "abort")),
    **dict.fromkeys(("payload-lost", "rare"), ("recover",)),
    **dict.fromkeys(
        ("silent", "taken", "not-armed", "no-numbers", "denied", *TOLD, "ctrl-c-twice"), ("abort",)
    ),
    "limits": ("throw",),
    "killed": (),
    "killed-in-hover": (),
    "no-arming": ("ready", "abort"),
    "very-late": (),
    "slow-mechanism": ("refused",),
}
"""By fault what the runner does from then on, in this order, maybe with more between and after."""


@pytest.mark.slow
def test_every_fault_over_udp(tmp_path):
    """The same outcomes between two processes as in lock step (tests/loopback); times are the
    machine's.
    """
    out = tmp_path / "faults.json"
    assert runner.main(["--faults", "--speed", "0.5", "--json", str(out)]) == 0
    figures = json.loads(out.read_text())["figures"]
    assert set(figures) == set(hil_faults.known_cases()) == FLOWN_THROUGH | set(ENDS)
    for name, found in figures.items():
        assert found["breaches"] == [], name
        assert (
            found["releases"] <= (name in ("stuck", "in-progress", "denied")) or name == "no-answer"
        ), name
        steps = iter(step["what"].split()[0].rstrip(":") for step in found["states"])
        assert all(wanted in steps for wanted in ENDS.get(name, ())), (name, found["states"])
        case = hil_faults.known_cases()[name]
        if case.since in ("fault", "act"):
            assert found["began_in"] == ("armed" if name.endswith("-in-hover") else "throw"), name
        if name in FLOWN_THROUGH:
            assert found["states"] == [], name
    assert [event["what"] for event in figures["killed"]["events"]] == ["levelled: no set-points"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_every_way_to_end_a_run_over_udp(kind, tmp_path):
    """In hover and in throw: it lands, or does by itself what the table says; the
    summary is there.
    """
    out, names = tmp_path / "faults.json", (*TOLD, "ctrl-c-twice", "killed", "killed-in-hover")
    assert (
        runner.main(["--faults", *names, "--kind", kind, "--speed", "0.5", "--json", str(out)]) == 0
    )
    figures = json.loads(out.read_text())["figures"]
    assert (
        set(figures)
        == set(names)
        == {name for name, case in hil_faults.known_cases().items() if case.ends}
    )
    for name, found in figures.items():
        assert (found["breaches"], found["releases"]) == ([], 0), name
        assert found["summary"] == ("killed" not in name), name
        events = [event["what"] for event in found["events"]]
        if "killed" in name:
            assert ITSELF[kind] in events, name
        elif kind in LANDS:
            assert LANDS[kind] in events, name
        if "killed" not in name:
            assert found["states"][0]["what"].startswith("abort"), name


@pytest.mark.parametrize(
    "words",
    [["swop"], ["none", "--jobs", "0"], ["none", "--speed", "2"], ["none", "--kind", "px4"]],
)
def test_faults_that_cannot_be_injected(words, capsys):
    assert runner.main(["--faults", *words]) == 2
    assert re.search(
        "did you mean 'swap'|expected 1 or more, and|expected ctrl-c, ", capsys.readouterr().err
    )
