"""Sweeps: identity of runs, finished work, distribution of work, and records."""

import json
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
from pytest import approx, fixture, importorskip, mark, raises

from tests.commands import run_command
from tests.waiting import eventually
from visthrow import config
from visthrow.common.errors import BusyError, ConfigError, StorageError
from visthrow.common.storage import write_json
from visthrow.paper import results
from visthrow.paper.sweep import pool
from visthrow.paper.sweep import work_units as units
from visthrow.paper.sweep.sweep_record import collect, status
from visthrow.paper.sweep.work import hold_lock, is_locked
from visthrow.paper.sweep.work_units import load_list

LIST = """
changes = ["ppo.iterations=2", "ppo.environments=8", "ppo.hidden=[8]"]

[runs.ready]
policies = ["state"]
throws = ["own"]

[runs.trained]
configs = ["state", "state_rigid_cable"]
seeds = [1, 2]
throws = ["own", "transfer"]

[throws.own]
plant = "hybrid"
targets = [1.5, 2.0]
count = 3

[throws.transfer]
plant = "reference"
targets = [2.0]
count = 150
fly_in = "full"
allow = ["rope"]
"""


@fixture
def path(tmp_path):
    list_file = tmp_path / "list.toml"
    list_file.write_text(LIST)
    return str(list_file)


def finish(source, out):
    """Leave what a finished training leaves, around a shipped policy."""
    folder = source.folder(out)
    folder.mkdir(parents=True)
    (folder / units.POLICY).write_bytes(
        units.find_policy("state").read_bytes() + source.name.encode()
    )
    rows = [
        {"target": t, "error_mean": 0.02, "duration_mean": 1.0, "success": 1.0} for t in (1.5, 2.0)
    ]
    made = {
        "commit": "c",
        "command": "visthrow train",
        "versions": {},
        "processors": {"cpu": "x"},
        "figures": {"throws": rows},
    }
    write_json(folder / units.SUMMARY, made)
    header = "iteration,released,landing_error,duration,rollout_s,learning_s,wall_s\n"
    (folder / units.PROGRESS).write_text(header + "1,1,0.5,1,0.25,0.5,1\n2,1,0.25,1,0.25,0.5,2\n")
    write_json(folder / "pieces" / "1.json", {"seconds": 3.0})


def throw(unit, out):
    """Leave what throws leave."""
    count = unit.count
    columns = {
        "success": np.ones(count, bool),
        "landing_w": np.full((count, 2), unit.target),
        "error": np.zeros(count),
    }
    results.save(units.throws_folder(out), results.Result(unit.unit(out), columns))


def test_a_run_is_its_resolved_config_and_seed(path):
    def keys(*changes):
        return {source.name: source.key for source in load_list(path, changes).sources}

    plain = keys()
    assert len(set(plain.values())) == 5
    assert keys("most_throws=1") == plain
    assert keys('commit="any"') == plain
    assert not set(keys('commit="same"').values()) & set(plain.values()) - {""}
    changed = keys('runs.trained.changes=["ppo.discount=0.98"]')
    assert not (set(changed.values()) & set(plain.values())) - {""}


def test_departures_are_what_differs_from_the_training(path, tmp_path):
    work = load_list(path)
    source = work.sources[2]
    finish(source, tmp_path)
    in_training, transfer = (
        work.throws[source.id][0].unit(tmp_path),
        work.throws[source.id][2].unit(tmp_path),
    )
    assert in_training["departures"] == {}
    assert transfer["departures"] == {"rope.segments": 15}
    assert (transfer["variant"], transfer["run"], transfer["train_seed"]) == (
        "rigid_cable",
        "state_rigid_cable",
        1,
    )
    shipped = work.throws["state"][0].unit(tmp_path)
    assert (shipped["variant"], shipped["train_seed"], shipped["departures"]) == ("full", None, {})


class FakeStarter:
    """A starter without processes: a task writes its files, fails, or is busy for a while, as
    configured.
    """

    def __init__(self, work, out, devices, jobs, fails=(), busy=()):
        self.work, self.out, self.devices, self.jobs = work, out, devices, jobs
        self.fails, self.busy, self.started, self.most = set(fails), list(busy), [], {}
        self.alive = []

    def start(self, task, device, minutes):
        self.started.append((task.name, device))
        self.minutes = minutes
        run = FakeRun(self, task)
        self.alive = [*(other for other in self.alive if other.status is None), run]
        kinds = [other.task.gpu for other in self.alive]
        self.most = {gpu: max(self.most.get(gpu, 0), kinds.count(gpu)) for gpu in (True, False)}
        return run


class FakeRun:
    def __init__(self, starter, task):
        self.starter, self.task, self.polls, self.status, self.stopped = (
            starter,
            task,
            0,
            None,
            False,
        )

    def poll(self):
        self.polls += 1
        if self.polls > 2 and self.status is None:
            self.status = self._finish()
        return self.status

    def _finish(self):
        starter, work = self.starter, self.starter.work
        if self.task.name in starter.busy:
            starter.busy.remove(self.task.name)
            return pool.EXIT_BUSY
        if self.task.name.split("-")[0] in starter.fails:
            return 1
        throws = {unit.id: unit for listed in work.throws.values() for unit in listed}
        for name in self.task.ids:
            if name in throws:
                throw(throws[name], starter.out)
            else:
                finish(work.source(name), starter.out)
        return 0

    def stop(self):
        self.stopped, self.status = True, pool.EXIT_STOPPED

    def kill(self):
        raise AssertionError("was asked to stop and did")


@fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(pool, "POLL", 0.001)
    monkeypatch.setattr(pool, "BUSY_PAUSE", 0.01)


def run(path, out, minutes=None, **options):
    work = load_list(path)
    starter = FakeStarter(work, out, options.pop("devices", ["a", "b"]), 3, **options)
    return starter, pool.ProcessPool(work, out, starter, lambda text: None).run(minutes)


def test_a_task_receives_how_many_minutes_are_left(path, tmp_path):
    starter, _ = run(path, tmp_path, minutes=9.0)
    assert starter.minutes == approx(9.0, abs=0.5)


def test_everything_is_done_once_and_no_more_at_once_than_fit(path, tmp_path):
    starter, outcome = run(path, tmp_path)
    assert outcome == pool.Outcome()
    names = [name for name, _ in starter.started]
    assert len(names) == len(set(names)) == 5 + 4 * 2, (
        "five policies, four of them with two batches on the reference plant"
    )
    assert starter.most[True] == 2
    assert starter.most[False] <= 3
    assert names[:2] == ["state", load_list(path).sources[1].id]
    again, outcome = run(path, tmp_path)
    assert again.started == []
    assert outcome == pool.Outcome()


def test_a_failure_stops_nothing_else_and_is_reported(path, tmp_path):
    _, outcome = run(path, tmp_path, fails=["state_rigid_cable"])
    assert len(outcome.failed) == 2
    assert all("exit status 1" in reason for reason in outcome.failed.values())
    lines, done = status(load_list(path), tmp_path)
    assert not done
    assert sum("done in" in line for line in lines) == 2
    again, outcome = run(path, tmp_path)
    assert {name.split("-")[0] for name, _ in again.started} == {"state_rigid_cable"}
    assert not outcome.failed


def test_ctrl_c_stops_what_runs_and_fails_nothing(path, tmp_path, monkeypatch):
    signals = [KeyboardInterrupt]

    def interrupt(_):
        if signals:
            raise signals.pop()

    monkeypatch.setattr(pool.time, "sleep", interrupt)
    monkeypatch.setattr(pool, "GRACE", 0.1)
    starter, outcome = run(path, tmp_path)
    assert outcome == pool.Outcome(stopped=True, interrupted=True)
    assert len(starter.alive) > 1
    assert all(task.stopped for task in starter.alive)


def test_a_unit_stops_where_the_process_that_started_it_is_gone(path, monkeypatch):
    """Stopped as by Ctrl-C, so that it writes its checkpoint, also where a shell started the sweep
    in the background, which ignores SIGINT.
    """
    monkeypatch.setattr("visthrow.paper.sweep.work.work", lambda *_: time.sleep(30.0))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin = time.monotonic()
    another = os.getpid()  # no process is its own parent
    try:
        assert run_command(f"sweep work {path} --units state --parent {another}") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - begin < 20.0


def test_what_another_process_has_is_tried_again(path, tmp_path):
    name = load_list(path).sources[1].id
    starter, outcome = run(path, tmp_path, busy=[name, name])
    assert [n for n, _ in starter.started].count(name) == 3
    assert outcome == pool.Outcome()


def test_a_lock_excludes_and_a_killed_process_does_not_hold_it(tmp_path):
    path = tmp_path / "locks" / "a.lock"
    code = (
        "import time; from pathlib import Path; from visthrow.paper.sweep.work import hold_lock\n"
    )
    code += f"with hold_lock(Path({str(path)!r})): print(1, flush=True); time.sleep(60)"
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        assert other.stdout.readline() == b"1\n"
        assert is_locked(path)
        with raises(BusyError, match=str(other.pid)), hold_lock(path):
            pass
        other.send_signal(signal.SIGKILL)
        other.wait()
        eventually(lambda: not is_locked(path))
        with hold_lock(path):
            assert is_locked(path)
        assert not is_locked(path)
    finally:
        other.kill()


def test_a_folder_in_which_nothing_is_done_makes_no_record(path, tmp_path):
    with raises(
        StorageError,
        match=r"no unit of the list .* is done; expected the results of 'visthrow sweep run",
    ):
        collect(load_list(path), tmp_path / "nothing", tmp_path / "records")
    assert not (tmp_path / "records").exists()


def test_records_join_what_two_machines_did(path, tmp_path):
    work = load_list(path)
    first, second, records = tmp_path / "here", tmp_path / "there", tmp_path / "records"
    for out, sources in ((first, work.sources[1:3]), (second, work.sources[3:])):
        for source in sources:
            finish(source, out)
            for unit in work.throws[source.id]:
                throw(unit, out)
        training, throws = collect(work, out, records)
    runs = json.loads(training.read_text())["runs"]
    assert [r["name"] for r in runs] == [
        "state-1",
        "state_rigid_cable-1",
        "state-2",
        "state_rigid_cable-2",
    ]
    assert runs[0]["curve"] == [[192, 0.75, 0.5], [384, 1.5, 0.25]]
    assert (runs[0]["seconds"], runs[0]["wall_s"], runs[0]["final"]["error_mean"]) == (
        1.5,
        3.0,
        0.02,
    )
    throws_before = results.load(throws)
    assert len(throws_before) == 4 * 4
    before = throws.read_text()
    collect(work, second, records)
    assert throws.read_text() == before
    policy = work.sources[3].policy(second)
    policy.write_bytes(
        policy.read_bytes() + b"x"
    )  # trained anew: the old throws are of another policy
    units._hash.cache_clear()
    for unit in work.throws[work.sources[3].id]:
        throw(unit, second)
    collect(work, second, records)
    again = results.load(throws)
    assert len(again) == 16
    assert {r.unit["weights"] for r in again} != {r.unit["weights"] for r in throws_before}


def test_status_and_mistakes_on_the_command_line(path, tmp_path, refused, printed):
    out = printed(f"sweep status {path} --out {tmp_path}", status=1)
    assert "state_rigid_cable-2" in out
    assert "23 units left" not in out
    assert "22 units left" in out, "4 trainings, 4 x (2 + 2) throws and 2 of the shipped policy"
    refused("sweep status papre", message="did you mean 'paper'")
    refused(f"sweep run {path} --minutes 0", message="expected more than 0")
    refused(
        f"sweep run {path} --slurm partition=gpu --devices cuda:0 --minutes 9",
        message="the number of GPUs",
    )


@mark.parametrize(
    ("outcome", "status"),
    [
        (pool.Outcome(), 0),
        (pool.Outcome(stopped=True), 0),
        (pool.Outcome({"state-1": "out of memory"}), 1),
        (pool.Outcome(stopped=True, interrupted=True), 130),
    ],
)
def test_the_status_of_a_sweep_says_how_it_ended(
    outcome, status, path, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(pool.ProcessPool, "run", lambda *_: outcome)
    assert run_command(f"sweep run {path} --out {tmp_path} --devices cpu") == status
    printed = capsys.readouterr().err
    assert ("state-1 failed: out of memory" in printed) == bool(outcome.failed)
    assert ("the same command continues" in printed) == outcome.stopped


@mark.parametrize(
    ("change", "words"),
    [
        ('runs.trained.throws=["onw"]', "did you mean 'own'"),
        ('throws.own.plant="hybird"', "did you mean 'hybrid'"),
        ("throws.own.count=0", "expected 1 or more"),
        ('runs.trained.configs=["stat"]', "did you mean 'state'"),
        ('changes=["ppo.iteration=2"]', "did you mean 'iterations'"),
    ],
)
def test_wrong_lists_are_refused(path, change, words):
    with raises(ConfigError, match=words):
        load_list(path, (change,))


def test_shipped_lists_name_what_exists():
    for name in config.available("sweep"):
        work = load_list(name)
        assert len(work.sources) == len({source.id for source in work.sources})
    paper = [source for source in load_list("paper").sources if source.config]
    ablations = ("no_aerodynamics", "no_motor_lag", "simple_controller", "rigid_cable")
    for name in ("state", "vision_ideal", *(f"state_{ablation}" for ablation in ablations)):
        assert sorted(s.seed for s in paper if s.config == name) == [1, 2, 3], name
    assert (
        sum(s.iterations * (0.142 if s.config.startswith("state") else 0.153) for s in paper)
        < 3 * 3600
    ), "hours of one H200"


def test_a_slurm_job_asks_for_what_it_needs(path, tmp_path, monkeypatch, refused):
    """A stand-in for sbatch keeps its script; without sbatch an error says so."""
    importorskip("submitit")
    from visthrow.paper.sweep.cluster import Cluster

    monkeypatch.setenv("PATH", str(tmp_path))
    command = f"sweep run {path} --out {tmp_path}/out --slurm partition=gpu --devices 2 --minutes 9"
    refused(command, message="no jobs can be submitted from here")
    keep = f"/bin/cat $1 >> {tmp_path}/script; echo Submitted batch job 7"
    for name, text in (("srun", ""), ("sbatch", keep)):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    cluster = Cluster(path, tmp_path, "slurm", 2, 1, 9.0, options={"slurm_partition": "gpu"})
    cluster.start(pool.Task("state-1", ("state-1",), gpu=True), "job 0", math.inf)
    script = (tmp_path / "script").read_text()
    for option in ("--partition=gpu", "--time=15", "--gpus-per-node=1", "--job-name=state-1"):
        assert option in script
