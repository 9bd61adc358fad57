"""What the tests of training share."""

import os

from pytest import fixture

from visthrow import cli
from visthrow.training import trainer


@fixture(autouse=True)
def same_bits(one_thread):
    """The same bits need the same number of threads."""


@fixture(autouse=True)
def few_throws(monkeypatch):
    """An evaluation throws 4 times for 200: that it is made, written and printed does not hang on
    how many.
    """
    monkeypatch.setattr(trainer, "EVALUATED", 4)


@fixture
def signalled(monkeypatch):
    """Function that runs a command's training of four iterations, sends a signal in the second, and
    resumes it.
    """

    def run(algorithm, words, number):
        learn = algorithm.learn

        def interrupted(self, done):
            figures = learn(self, done)
            if done == 1 / 4:
                os.kill(os.getpid(), number)
            return figures

        monkeypatch.setattr(algorithm, "learn", interrupted)
        assert cli.main(words) == 130
        monkeypatch.setattr(algorithm, "learn", learn)
        assert cli.main([*words, "--resume"]) == 0

    return run
