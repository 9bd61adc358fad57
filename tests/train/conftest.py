"""Fixtures of the training tests."""

import os
import signal

from pytest import fixture

from tests.commands import run_python
from visthrow.training import trainer


@fixture(autouse=True)
def same_bits(one_thread):
    """The same bits need the same number of threads."""


@fixture(autouse=True)
def few_throws(monkeypatch):
    """An evaluation has 4 throws for 200: its files and output do not depend on the number."""
    monkeypatch.setattr(trainer, "EVALUATED", 4)


KILLED = """
import os, signal, sys
from visthrow import cli
from visthrow.training.ppo.ppo_training import PPOTraining
learn = PPOTraining.learn
PPOTraining.learn = lambda self, done: (
    os.kill(os.getpid(), signal.SIGKILL) if done == 3 / 4 else learn(self, done)
)
cli.main(sys.argv[1:])
"""


@fixture
def killed():
    """Function that runs a command's training of four iterations in a process that is killed in the
    last one.
    """

    def run(*words):
        process = run_python("-c", KILLED, *words, env={**os.environ, "OMP_NUM_THREADS": "1"})
        assert process.returncode == -signal.SIGKILL, process.stderr

    return run
