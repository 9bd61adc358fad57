"""One thread a product for all tests: see :mod:`visthrow.diagnose.likelihood.threads`."""

import gc
import os

from pytest import fixture, hookimpl

from visthrow.diagnose.likelihood.threads import limit_to_one_thread

limit_to_one_thread()
if worker := os.environ.get("PYTEST_XDIST_WORKER"):
    # One core for each test process: threads on several would compete for the interpreter, which
    # costs a fifth more CPU time.
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker[2:]) % len(cores)]})
gc.disable()  # collected and imported objects never become garbage


@hookimpl(tryfirst=True)
def pytest_runtestloop():
    """Collect garbage from here on, without a look at what was imported."""
    gc.freeze()
    gc.enable()


@fixture
def one_thread():
    """One thread for torch: small work; the same bits need the same number of threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@fixture
def refused(capsys):
    """Function that runs a command, which must end with status 2 and a message."""
    from tests.commands import run_command

    def run(line, *words, message, sets=()):
        assert run_command(line, *words, sets=sets) == 2
        assert message in capsys.readouterr().err

    return run


@fixture
def printed(capsys):
    """Function that runs a command, which must end with a status, and returns what it prints."""
    from tests.commands import run_command

    def run(line, *words, status=0, sets=()):
        capsys.readouterr()
        assert run_command(line, *words, sets=sets) == status
        return capsys.readouterr().out

    return run
