"""The table of firmware facts: each row names its source."""

import re

from pytest import mark, raises

from hil.links.facts import FOLDER, Fact, facts, values
from visthrow.common.errors import ConfigError

FIRMWARES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def incomplete(fact: Fact) -> bool:
    """Whether a row lacks the source of its value."""
    words = (fact.text, fact.means, fact.version, fact.repository)
    return not re.fullmatch(r"[\w./-]+:[1-9]\d*", fact.at) or not all(map(str.strip, words))


@mark.parametrize("firmware", FIRMWARES)
def test_each_fact_names_its_source(firmware):
    assert [name for name, fact in facts(firmware).items() if incomplete(fact)] == []


def test_a_row_without_a_line_is_found():
    assert incomplete(Fact(1, "supervisor.c", "WDT", "silence", "2026.08", "a/b"))
    assert incomplete(Fact(1, "supervisor.c:58", " ", "silence", "2026.08", "a/b"))


def test_values_are_those_of_the_rows():
    assert values("crazyflie")["levels_after"] == facts("crazyflie")["levels_after"].value == 0.5
    with raises(ConfigError, match=r"no facts of firmware 'crazyfly'; .*crazyflie"):
        facts("crazyfly")
