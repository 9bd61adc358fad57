"""Hidden effects must be found: the tool passes the suite of :mod:`bench.diagnose.finding`, and
four spoilt tools do not.
"""

import os
from collections import Counter
from dataclasses import replace

from numpy.random import default_rng
from pytest import fixture, mark, raises

from bench.diagnose import finding
from visthrow.config.effects import catalogue

SPOILT = {
    "always NO EFFECT": lambda kinds, real: finding.blind,
    "always the most common name": lambda kinds, real: finding.always(most_common(kinds)),
    "reads file names": lambda kinds, real: finding.reader_of_file_names,
    "takes two effects for each other": lambda kinds, real: finding.exchange_effects(
        kinds[0].hidden[0], next(x for x in finding.SINGLE if x != kinds[0].hidden[0]), real
    ),
}
"""Fault of a spoilt tool -> the tool, made for these kinds of worlds and from the real one."""


def most_common(kinds) -> str:
    """The effect that most of these worlds hide."""
    return Counter(name for kind in kinds for name in kind.hidden).most_common(1)[0][0]


@fixture(scope="module")
def suite():
    """Kinds of worlds and the first seed, drawn by the system and printed."""
    seed = int.from_bytes(os.urandom(4), "little")
    print(f"seed {seed}")
    return finding.draw_few(default_rng(seed)), seed


@fixture(scope="module")
def real():
    """The tool itself, which diagnoses the same logs only once."""
    return finding.cache_answers(finding.explain)


def test_what_is_hidden_is_found(suite, real):
    finding.require(real, *suite)


@mark.parametrize("name", list(SPOILT))
def test_a_spoilt_tool_is_caught(name, suite, real):
    kinds, seed = suite
    with raises(AssertionError, match="seed"):
        finding.require(SPOILT[name](kinds, real), kinds, seed)


@mark.slow
def test_effects_exchanged_in_the_catalogue_are_noticed(monkeypatch):
    """Worlds with independent equations detect it; the simulator's equations would not."""
    known = catalogue()
    one, other = known["com_x"], known["com_y"]
    monkeypatch.setitem(known, "com_x", replace(one, changes=other.changes))
    monkeypatch.setitem(known, "com_y", replace(other, changes=one.changes))
    with raises(AssertionError, match="seed"):
        finding.require(finding.explain, [finding.Kind(("com_x",), "rod")], 4)
