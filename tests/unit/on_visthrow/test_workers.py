"""Parallel work: results, errors and early ends."""

import math
import os
import time

from pytest import mark, raises

from visthrow.common.errors import VisthrowError
from visthrow.common.workers import Workers, progress, run_tasks


def squared(number: float) -> float:
    """Progress of slow work."""
    progress(0.5)
    time.sleep(0.01 * number)
    return number * number


def refused(number: int) -> int:
    raise VisthrowError(f"no {number}")


def killed(number: int) -> int:
    os._exit(7)


def endless(number: int) -> int:
    time.sleep(600.0)
    return number


def test_one_process_works_here_and_in_order():
    processes = []
    assert list(run_tasks(lambda x: processes.append(os.getpid()) or x, [3, 1, 2])) == [
        (0, 3),
        (1, 1),
        (2, 2),
    ]
    assert set(processes) == {os.getpid()}


@mark.slow
def test_processes_do_each_task_once():
    assert sorted(run_tasks(squared, [3.0, 1.0, 2.0, 5.0, 4.0], 2)) == [
        (0, 9.0),
        (1, 1.0),
        (2, 4.0),
        (3, 25.0),
        (4, 16.0),
    ]
    assert list(run_tasks(math.sqrt, [], 2)) == []


@mark.slow
@mark.parametrize(("function", "message"), [(refused, "^no [12]"), (killed, "ended with status 7")])
def test_an_error_or_a_dead_process_ends_the_work(function, message):
    with raises(VisthrowError, match=message):
        list(run_tasks(function, [1, 2], 2))


@mark.slow
def test_leaving_early_ends_the_processes():
    begin = time.monotonic()
    with Workers(endless, [1, 2], 2) as workers:
        running = list(workers._running.values())
    assert time.monotonic() - begin < 60.0
    assert not any(process.is_alive() for process in running)
