"""Fixtures of the training tests."""

import multiprocessing
import signal

from pytest import fixture

from visthrow.training import trainer

PROCESSES = multiprocessing.get_context("forkserver")
"""Makes processes that have imported the trainer: once for all."""
PROCESSES.set_forkserver_preload(["visthrow.training.trainer"])


@fixture(autouse=True)
def same_bits(one_thread):
    """The same bits need the same number of threads."""


@fixture(autouse=True)
def few_throws(monkeypatch):
    """An evaluation has 4 throws for 200: its files and output do not depend on the number."""
    monkeypatch.setattr(trainer, "EVALUATED", 4)


KILLED = """
import os, signal, torch
from tests.commands import run_command
from visthrow.training.ppo.ppo_training import PPOTraining
torch.set_num_threads(1)
learn = PPOTraining.learn
PPOTraining.learn = lambda self, done: (
    os.kill(os.getpid(), signal.SIGKILL) if done == 3 / 4 else learn(self, done)
)
run_command(*words)
"""


@fixture
def killed():
    """Function that runs a command's training of four iterations in a process that is killed in the
    last one.
    """

    def run(*words):
        process = PROCESSES.Process(target=exec, args=(KILLED, {"words": words}))
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL

    return run
