"""Training: files of a run, resuming, interruption, a full disk.

Tiny networks and batches.
"""

import errno
import json
import os
import re
import signal

import torch
from numpy.testing import assert_array_equal
from pytest import approx, fixture, mark
from torch.testing import assert_close

from tests.commands import run_command, set_words
from tests.configs import load_experiment
from visthrow import cli
from visthrow.common import storage
from visthrow.common.toml_text import tables_beside
from visthrow.onboard import observations
from visthrow.onboard.policy import Policy, find_policy
from visthrow.paper import measurements
from visthrow.task import contract_of
from visthrow.training import session, trainer
from visthrow.training.ppo.ppo_training import PPOTraining
from visthrow.training.trainer import CHECKPOINT, Trainer

SMALL = [
    "ppo.environments=32",
    "ppo.steps=8",
    "ppo.hidden=[16,16]",
    "ppo.iterations=4",
    "task.bounds.time_limit=0.4",
]


def words(folder, *extra):
    """Return the words of a training on the CPU."""
    command = f"train laptop --device cpu --out {folder} --checkpoint-every 1"
    return [command, *set_words(SMALL), *extra]


def train(folder, *extra):
    """Run the command; return its exit status."""
    return run_command(*words(folder, *extra))


def weights(folder):
    return [w.numpy() for w in Policy.load(folder / "policy.npz").weights]


def require_same_weights(one, other):
    for a, b in zip(weights(one), weights(other), strict=True):
        assert_array_equal(a, b)


@fixture(scope="module")
def whole(tmp_path_factory):
    """A run of four iterations without interruption."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert train(folder) == 0
    return folder


def test_a_training_stops_at_the_first_loss_that_is_not_finite(tmp_path, capsys):
    assert train(tmp_path / "run", "--set", "task.reward.scale=1e30") == 2
    error = capsys.readouterr().err
    assert "iteration 1: " in error
    assert "value inf" in error


def test_a_run_leaves_config_log_checkpoint_summary_and_policy(whole):
    names = {p.name for p in whole.iterdir()}
    assert {
        "config.toml",
        "provenance.json",
        "progress.csv",
        CHECKPOINT,
        "summary.json",
        "policy.npz",
    } <= names
    rows = (whole / "progress.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    experiment = load_experiment(whole / "config.toml")
    Policy.load(whole / "policy.npz").require(contract_of(experiment))


def test_networks_may_round_their_products_and_observations_may_not(whole, monkeypatch):
    rounded = {"observe": set(), "learn": set()}

    def watch(owner, name):
        work = getattr(owner, name)

        def noted(*args, **kwargs):
            rounded[name].add(torch.backends.cuda.matmul.allow_tf32)
            return work(*args, **kwargs)

        monkeypatch.setattr(owner, name, noted)

    watch(observations, "observe")
    watch(PPOTraining, "learn")
    Trainer(load_experiment(whole / "config.toml"), "cpu", 1).step()
    assert rounded == {"observe": {False}, "learn": {True}}
    assert not torch.backends.cuda.matmul.allow_tf32


def iterations_of(folder) -> list[int]:
    """First column of the log, to see that none is missing or made twice."""
    return [
        int(row.split(",")[0]) for row in (folder / "progress.csv").read_text().splitlines()[1:]
    ]


@mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_a_signal_leaves_checkpoint_and_policy_and_the_printed_command_goes_on(
    whole, tmp_path, monkeypatch, capsys, number
):
    folder = tmp_path / "run"
    step = Trainer.step

    def interrupted(self):
        if self.iteration == 1:
            os.kill(os.getpid(), number)  # in the middle of the second iteration
        return step(self)

    monkeypatch.setattr(Trainer, "step", interrupted)
    assert train(folder) == 130
    assert iterations_of(folder) == [1, 2]
    stopped = Policy.load(folder / "policy.npz")
    assert stopped.made_by["figures"]["iterations"] == 2
    assert len(json.loads((folder / "evaluation.json").read_text())["figures"]["throws"]) == 3
    assert not (folder / "summary.json").exists()
    command = capsys.readouterr().err.split("continue with: visthrow ")[1].split("\n")[0]
    monkeypatch.setattr(Trainer, "step", step)
    assert (
        cli.main([*command.split(), "--device", "cpu"]) == 0
    )  # without --set: the folder has its configuration
    assert iterations_of(folder) == [1, 2, 3, 4]
    assert (folder / "summary.json").exists()
    assert not (folder / "evaluation.json").exists()
    require_same_weights(whole, folder)


def test_minutes_leave_a_policy(tmp_path, capsys):
    folder = tmp_path / "run"
    assert train(folder, "--minutes", "1e-6") == 0, "what was asked for was done: a script goes on"
    assert iterations_of(folder) == [1]
    assert Policy.load(folder / "policy.npz").made_by["figures"]["iterations"] == 1
    printed = capsys.readouterr()
    assert "success" not in printed.out
    assert (
        "reached the time limit after iteration 1 of 4; continue with: visthrow train --resume"
        in printed.err
    )


def test_a_policy_is_taken_up_and_an_error_that_it_has_ends_the_run(tmp_path, capsys):
    """The critic alone learns at first, so the actor is the shipped one to the bit; it lands within
    a metre at once.
    """
    folder = tmp_path / "run"
    command = f"train laptop --from state --until 1.0 --evaluate-every 1 --out {folder}"
    settings = ("ppo.environments=16", "ppo.steps=4", "rope.length=0.5")
    assert run_command(f"{command} --device cpu", sets=settings) == 0
    assert iterations_of(folder) == [1]
    shipped, taken = Policy.load(find_policy("state")), Policy.load(folder / "policy.npz")
    for a, b in zip(
        [*shipped.weights, *shipped.biases], [*taken.weights, *taken.biases], strict=True
    ):
        assert_close(a, b, rtol=0, atol=0)
    assert_close(taken.mean, shipped.mean, atol=1e-4, rtol=0)
    assert_close(taken.std, shipped.std, atol=1e-4, rtol=1e-4)
    assert taken.contract["rope"]["length"] == 0.5
    assert json.loads((folder / "provenance.json").read_text())["from"]["policy"] == "state"
    assert "landed" in capsys.readouterr().out


@mark.parametrize(
    ("extra", "message"),
    [
        (["--until", "4"], "--until 4 m; throws are at 2 m"),  # centimetres
        (["--set", "vehicle.body.mass=-1"], "mass"),
        (["--set", "rope.length=-0.2"], "length"),
        (["--set", "ppo.epochs=0"], "epochs is 0; expected 1 or more"),
        (["--set", "ppo.learning_rate=-1e-3"], "learning_rate is -0.001"),
        (["--set", "ppo.minibatches=7"], "minibatches"),
        (["--resume", "--from", "state"], "--from"),
        (["--from", "vision"], "observation.layout"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_a_folder_is_made(
    tmp_path, refused, extra, message
):
    refused(*words(tmp_path / "a", *extra), message=message)
    assert not (tmp_path / "a").exists()


def test_a_killed_training_goes_on_bit_for_bit(whole, killed, tmp_path):
    """Its third iteration is in the log, its checkpoint has two."""
    folder = tmp_path / "run"
    killed(*words(folder, "--checkpoint-every", "2"))
    assert iterations_of(folder) == [1, 2, 3]
    assert train(folder, "--resume") == 0
    assert iterations_of(folder) == [1, 2, 3, 4]
    require_same_weights(whole, folder)


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
    require_same_weights(whole, folder)


@mark.parametrize(
    ("change", "message"),
    [
        (
            lambda f: (f / CHECKPOINT).write_bytes((f / CHECKPOINT).read_bytes()[:1000]),
            "not a readable checkpoint",
        ),
        (lambda f: (f / CHECKPOINT).unlink(), "no checkpoint.pt to resume from"),
        (
            lambda f: (f / "config.toml").write_text(
                (f / "config.toml").read_text().replace("clip = 0.2", "clip = 0.3")
            ),
            "lines that differ: clip = 0.2; clip = 0.3",
        ),
    ],
)
def test_broken_checkpoints_are_refused(tmp_path, refused, change, message):
    folder = tmp_path / "run"
    assert train(folder, "--iterations", "1") == 0
    change(folder)
    refused(*words(folder, "--resume"), message=message)


def test_resume_under_another_seed_or_configuration_is_refused(tmp_path, refused):
    folder = tmp_path / "run"
    assert train(folder, "--iterations", "1") == 0
    refused(*words(folder, "--resume", "--seed", "2"), message="has the seed 1")
    refused(*words(folder, "--resume", "--set", "ppo.clip=0.3"), message="not that of --set")
    refused(
        f"train vision --resume --out {folder} --device cpu",
        message="another configuration than vision",
    )


def test_the_end_says_how_sure_it_is_and_names_the_conditions(tmp_path, printed):
    changes = [
        "ppo.environments=32",
        "ppo.products=float32",
        "task.noise.observation_step=0.04",
        'flown=["task.noise.observation_step=0.0"]',
    ]
    figures = tmp_path / "figures.json"
    command = f"train state --from state --iterations 1 --device cpu --json {figures}"
    text = printed(f"{command} --out {tmp_path}/run", sets=changes)
    assert "under the faults of its training:" in text
    assert re.search(r"target 2\.0 m: error 0\.\d+ \[0\.\d+, 0\.\d+\] m", text)
    written = json.loads(figures.read_text())
    flown, trained = written["throws"][1], written["throws_under_faults"][1]
    assert flown["throws"] == 5 * trainer.EVALUATED
    assert flown["error_mean"] < 0.04 < trained["error_mean"], "four times the noise must show"


def test_ppo_trains_in_a_simulator_as_coarse_as_it_asks_for():
    experiment = load_experiment("laptop", [*SMALL, "ppo.segments=5", "ppo.substep=0.004"])
    coarse = Trainer(experiment, "cpu", 1).algorithm.env.cfg
    assert (coarse.rope.segments, coarse.sim.substep) == (5, 0.004)


def test_the_policy_of_ppo_has_the_mean_of_the_last_iterations_weights():
    experiment = load_experiment("laptop", SMALL)
    run = Trainer(experiment, "cpu", 1)
    mean = torch.zeros(())
    for iteration in range(3):
        run.step()
        last = run.algorithm.alg.actor.mlp[0].weight.detach().clone()
        mean = mean + (last - mean) * 4.0 / (iteration + 4.0)
    exported = run.algorithm.export(contract_of(experiment), {}).weights[0]
    torch.testing.assert_close(exported, mean)
    assert (exported - last).abs().max() > 1e-5


@mark.parametrize("name", ["state_box", "state_two_cables", "state_rod_gripper"])
def test_another_solver_keeps_its_rope_and_steps(name):
    experiment = load_experiment(name)
    assert experiment.ppo.segments == 5, "inherited from state_fast"
    assert trainer.coarsen(experiment) == experiment


def test_the_recorded_seeds_are_those_of_the_record():
    record = measurements.load(measurements.FOLDER / "time-to-error-state-h200.json")
    errors = [run["final"][1] for run in record["figures"]["runs"]]
    recorded = tables_beside(session.__file__, "recorded.toml")
    assert recorded == {"state_fast": approx(errors, abs=5.1e-5)}  # four digits are kept


def test_the_end_compares_the_seed_with_recorded_ones(capsys):
    session._compare("state_fast", [{"target": 2.0, "error_mean": 0.0001}])
    printed = capsys.readouterr().out
    assert re.search(r"at 2\.0 m (\d+) of \1 recorded seeds had a larger error", printed)
    session._compare("mine.toml", [{"target": 2.0, "error_mean": 0.0001}])
    assert not capsys.readouterr().out
