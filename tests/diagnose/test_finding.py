"""What is hidden must be found: the tool passes the suite of :mod:`tests.diagnose.finding`, and four spoilt tools do not."""

import os
from collections import Counter

import numpy as np
import pytest

from tests.diagnose import finding

SPOILT = {
    "always NO EFFECT": lambda kinds: finding.blind,
    "always the most common name": lambda kinds: finding.always(most_common(kinds)),
    "reads file names": lambda kinds: finding.reader_of_file_names,
    "takes two effects for each other": lambda kinds: finding.exchanged(kinds[1].hidden[0], kinds[2].hidden[0]),
}
"""What is wrong with a tool -> it, made for these kinds of worlds."""


def most_common(kinds) -> str:
    """The effect that most of these worlds hide."""
    return Counter(name for kind in kinds for name in kind.hidden).most_common(1)[0][0]


@pytest.fixture(scope="module")
def suite():
    """Kinds of worlds and the first seed, drawn by the system and printed."""
    seed = int.from_bytes(os.urandom(4), "little")
    print(f"seed {seed}")
    return finding.kinds(np.random.default_rng(seed)), seed


def test_what_is_hidden_is_found(suite):
    finding.require(finding.explain, *suite)


@pytest.mark.parametrize("name", list(SPOILT))
def test_a_spoilt_tool_is_caught(name, suite):
    kinds, seed = suite
    with pytest.raises(AssertionError, match="seed"):
        finding.require(SPOILT[name](kinds), kinds, seed)
