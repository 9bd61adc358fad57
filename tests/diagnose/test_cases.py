"""Symmetries, degenerate pairs and spoiled logs of sealed worlds; the default run tests their
parts.
"""

import argparse
import os
from itertools import pairwise

import numpy as np
from pytest import fixture, mark

from bench.diagnose import cases
from bench.diagnose.bad import BAD
from bench.diagnose.degenerate import PAIRS
from bench.worlds.world import Recipe
from visthrow.diagnose.throw.cutting import ATTACHED, Cut, thin
from visthrow.logs.flightlog import FlightLog

SMALL = dict(free=1, free_seconds=1.0, throws=2)


@fixture(scope="module")
def logs() -> list[FlightLog]:
    return cases.logs_of(Recipe(11, "rod", {"com_y": 1e-3}, **SMALL))


def test_logs_hold_what_was_measured_and_nothing_of_the_truth(logs):
    """A seed, a size or an unmeasured quantity in the logs would give the answer away."""
    for log in logs:
        assert not log.meta
        assert set(log.channels) == {
            "pos_w",
            "quat_wb",
            "payload_pos_w",
            "command",
            "release_command",
            "battery_voltage",
        }


def test_what_the_configuration_knows_of_the_sensors_is_read(monkeypatch):
    """A frame's tilt that was found and applied must not be found again."""
    from visthrow.diagnose.inputs import model_arguments as opening
    from visthrow.diagnose.throw import throw_model

    monkeypatch.setattr(
        throw_model, "ThrowModel", lambda logs, plant, **options: argparse.Namespace(**options)
    )
    args = argparse.Namespace(
        plant="state", overrides=["sensing.frame_tilt=[0.01, 0.0, 0.0]"], only=None, device="cpu"
    )
    assert opening.throw_model(args, [])[0].sensing.frame_tilt == (0.01, 0.0, 0.0)


def test_of_hours_of_flight_all_throws_and_the_liveliest_windows_are_looked_at():
    hover = [Cut(0, "hover", float(i), i + 1.0, ATTACHED) for i in range(7200)]
    throws = [Cut(1, "throw", float(i), i + 1.0, ATTACHED) for i in range(30)]
    time = np.arange(0.0, 7200.0, 0.1)
    lively = (time % 60.0 >= 30.0) & (time % 60.0 < 31.0)  # a second of each minute
    command = np.outer(np.sin(7.0 * time) * (0.01 + lively), np.ones(4))
    flight = argparse.Namespace(command_time=time, command=command)
    kept = thin([*hover, *throws], [flight, flight])
    assert len(kept) == 100
    assert [c for c in kept if c.flight == 1] == throws
    assert max(b.start - a.start for a, b in pairwise(kept[:70])) < 250.0
    assert all(c.start % 60.0 == 30.0 for c in kept[:70])
    assert thin(throws, [flight, flight]) == throws


def explain_failure(line: dict) -> str:
    """Explain why a case failed."""
    return (
        f"{line['kind']} {line['recipe']}: {line.get('said')} {line.get('error', '')}"
        f" {line.get('output', '')}"
    )


@mark.slow
@mark.parametrize("kind", [*cases.KINDS, *PAIRS, *BAD])
def test_a_case_passes(kind):
    """Symmetries hold, the plan separates the members of a class, and bad logs get no name; in a
    freshly drawn world.
    """
    seed = int.from_bytes(os.urandom(4))
    line = cases.run_case(cases.Task(kind, cases.draw(kind, seed), np.inf))
    assert line["passed"], f"{explain_failure(line)}; done: {line.get('done')}"
