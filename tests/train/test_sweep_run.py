"""A sweep in real processes: killed in the middle of its runs, started again, and through submitit.

Tiny networks.
"""

import os
import signal
import subprocess

import numpy as np
from pytest import fixture, mark

from tests.commands import start
from tests.waiting import eventually
from visthrow.onboard.policy import Policy
from visthrow.paper.sweep.sweep_record import collect, status
from visthrow.paper.sweep.work_units import load_list
from visthrow.throws import results

LIST = """
changes = [
    "ppo.environments=32", "ppo.steps=8", "ppo.hidden=[16,16]", "ppo.iterations=30",
    "ppo.minibatches=4",
    "task.bounds.time_limit=0.4",
]
most_throws = 2
checkpoint_every = 2

[runs.tiny]
configs = ["state"]
seeds = [1, 2]
throws = ["own"]

[throws.own]
plant = "hybrid"
targets = [2.0]
count = 2
"""
PATIENCE = 300.0
"""Longest wait for what takes seconds on an idle machine [s]."""


@fixture
def path(tmp_path):
    found = tmp_path / "list.toml"
    found.write_text(LIST)
    return str(found)


def sweep(path, out, *extra):
    # The same bits need the same number of threads.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    line = f"sweep run {path} --out {out} --devices cpu --jobs 1"
    return start(line, *extra, env=environment, start_new_session=True)


def rows(source, out):
    path = source.folder(out) / "progress.csv"
    return path.read_text().count("\n") - 1 if path.is_file() else 0


def children(process):
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True
    )
    return [int(word) for word in listed.stdout.split()]


def same(work, one, two):
    for source in work.sources:
        a, b = (Policy.load(source.policy(out)).weights for out in (one, two))
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x.numpy(), y.numpy())
        assert rows(source, two) == 30


@mark.slow
def test_killed_at_any_moment_it_loses_nothing_and_repeats_nothing(path, tmp_path):
    """A SIGKILL of everything, a SIGKILL of the parent alone, a Ctrl-C; the end equals a run
    without any of it, bit for bit.
    """
    work, whole, broken = load_list(path), tmp_path / "whole", tmp_path / "broken"
    assert sweep(path, whole).wait(PATIENCE) == 0
    first, second = work.sources

    running = sweep(path, broken)
    eventually(lambda: rows(first, broken) >= 7, PATIENCE)
    for pid in [*children(running), running.pid]:
        os.kill(pid, signal.SIGKILL)
    running.wait()
    assert 6 <= rows(first, broken) < 30

    running = sweep(
        path, broken
    )  # its children end by themselves, with a checkpoint, when it is gone
    eventually(lambda: rows(first, broken) >= 15, PATIENCE)
    orphans = children(running)
    running.kill()
    running.wait()
    assert orphans
    assert not status(work, broken)[1]
    running = sweep(path, broken)  # waits until the orphan has let go
    eventually(lambda: rows(second, broken) >= 5, PATIENCE)
    before = first.policy(broken).stat().st_mtime_ns
    running.send_signal(signal.SIGINT)
    assert running.wait(PATIENCE) == 130
    kept = rows(second, broken)
    assert "running" not in "".join(status(work, broken)[0])

    assert sweep(path, broken).wait(PATIENCE) == 0
    assert kept >= 5
    same(work, whole, broken)
    assert first.policy(broken).stat().st_mtime_ns == before, "what is done is not done again"
    assert status(work, broken)[1]
    results_before = {p.name: p.stat().st_mtime_ns for p in (broken / "throws").iterdir()}
    assert len(results_before) == 2
    assert sweep(path, broken).wait(PATIENCE) == 0
    assert {p.name: p.stat().st_mtime_ns for p in (broken / "throws").iterdir()} == results_before
    training, throws = collect(work, broken, tmp_path / "records")
    assert len(results.load(throws)) == 2
    assert training.is_file()
