"""Training: what a run leaves behind, resuming, interruption, a full disk. Tiny networks and batches."""

import errno
import os
import signal

import numpy as np
import pytest
import torch

from visthrow import cli, config
from visthrow.common import storage
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, contract_of
from visthrow.training.trainer import CHECKPOINT, Trainer

SMALL = ["ppo.environments=32", "ppo.steps=8", "ppo.hidden=[16,16]", "ppo.iterations=4", "task.bounds.time_limit=0.4"]


def train(folder, *extra):
    """Run the command on the CPU; return its exit status."""
    words = ["train", "laptop", "--device", "cpu", "--out", str(folder), "--checkpoint-every", "1"]
    for item in SMALL:
        words += ["--set", item]
    return cli.main(words + list(extra))


def weights(folder):
    return [w.numpy() for w in Policy.load(folder / "policy.npz").weights]


@pytest.fixture(autouse=True)
def one_thread():
    """The same bits need the same number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of four iterations without interruption."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert train(folder) == 0
    return folder


def test_a_run_leaves_config_log_checkpoint_summary_and_policy(whole):
    names = {p.name for p in whole.iterdir()}
    assert {"config.toml", "provenance.json", "progress.csv", CHECKPOINT, "summary.json", "policy.npz"} <= names
    rows = (whole / "progress.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    experiment = config.load(Experiment, whole / "config.toml")
    Policy.load(whole / "policy.npz").require(contract_of(experiment))


def test_exported_policy_equals_the_network(whole):
    experiment = config.load(Experiment, whole / "config.toml")
    trainer = Trainer(experiment, "cpu", 1)
    trainer.load(whole / CHECKPOINT)
    obs = torch.randn(64, trainer.algorithm.env.layout.dimension)
    with torch.inference_mode():
        difference = (trainer.algorithm.act(obs) - Policy.load(whole / "policy.npz").act(obs)).abs().max()
    assert difference < 1e-6


def test_resume_goes_on_bit_for_bit(whole, tmp_path):
    folder = tmp_path / "run"
    assert train(folder, "--iterations", "2") == 0
    assert train(folder, "--resume") == 0
    for a, b in zip(weights(whole), weights(folder), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (folder / "progress.csv").read_text().count("\n") == 1 + 4


def test_ctrl_c_keeps_what_was_done(whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    learn = Trainer.step

    def interrupted(self):
        if self.iteration == 1:
            os.kill(os.getpid(), signal.SIGINT)  # in the middle of the second iteration
        return learn(self)

    monkeypatch.setattr(Trainer, "step", interrupted)
    assert train(folder) == 130
    assert "--resume" in capsys.readouterr().err
    assert (folder / "progress.csv").read_text().count("\n") == 1 + 2
    monkeypatch.setattr(Trainer, "step", learn)
    assert train(folder, "--resume") == 0
    for a, b in zip(weights(whole), weights(folder), strict=True):
        np.testing.assert_array_equal(a, b)


def test_full_disk_says_so_and_loses_nothing(whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    fsync, calls = os.fsync, []

    def full(handle):
        calls.append(handle)
        if len(calls) > 5:  # config, provenance, log, two checkpoints fit
            raise OSError(errno.ENOSPC, "No space left on device")
        return fsync(handle)

    monkeypatch.setattr(storage.os, "fsync", full)
    assert train(folder) == 2
    message = capsys.readouterr().err
    assert "No space left" in message
    assert "iteration 2 is whole" in message
    assert not [p for p in folder.iterdir() if p.name.endswith(".tmp")]
    monkeypatch.setattr(storage.os, "fsync", fsync)
    assert train(folder, "--resume") == 0
    for a, b in zip(weights(whole), weights(folder), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: (f / CHECKPOINT).write_bytes((f / CHECKPOINT).read_bytes()[:1000]), "not a readable checkpoint"),
        (lambda f: (f / CHECKPOINT).unlink(), "no checkpoint.pt to resume from"),
    ],
)
def test_broken_checkpoints_are_refused(tmp_path, capsys, change, words):
    folder = tmp_path / "run"
    assert train(folder, "--iterations", "1") == 0
    change(folder)
    assert train(folder, "--resume") == 2
    assert words in capsys.readouterr().err


def test_resume_under_another_seed_is_refused(tmp_path, capsys):
    folder = tmp_path / "run"
    assert train(folder, "--iterations", "1") == 0
    assert train(folder, "--resume", "--seed", "2") == 2
    assert "another configuration or seed" in capsys.readouterr().err


def test_unknown_names_and_indivisible_batches_are_refused(tmp_path, capsys):
    assert cli.main(["train", "stat", "--out", str(tmp_path / "a")]) == 2
    assert "state" in capsys.readouterr().err
    assert train(tmp_path / "b", "--set", "ppo.minibatches=7") == 2
    assert "minibatches" in capsys.readouterr().err


def test_further_ranks_resume_with_data_of_their_own(whole):
    """A checkpoint holds the first rank's environments; copied to all, several GPUs would collect the same batch."""
    experiment = config.load(Experiment, whole / "config.toml")
    first, second = (Trainer(experiment, "cpu", 1) for _ in range(2))
    second.ranks = {"global_rank": 1, "local_rank": 1, "world_size": 2}
    first.load(whole / CHECKPOINT)
    second.load(whole / CHECKPOINT)
    assert first.iteration == second.iteration == 4
    weight = next(first.algorithm.alg.actor.parameters()), next(second.algorithm.alg.actor.parameters())
    torch.testing.assert_close(*weight, rtol=0, atol=0)
    assert not torch.equal(first.algorithm.env.views.state["pos_w"], second.algorithm.env.views.state["pos_w"])
