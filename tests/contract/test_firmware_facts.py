"""A constant that stands for a firmware's behaviour comes from the table of facts.

In modules that speak for a firmware no number stands outside of module constants and defaults, but
those of arithmetic; parameter names are rows of the table. What a module constant may hold is ours:
:data:`CHOICES` names each.
"""

import ast
import re
from pathlib import Path

import pytest

from hil.links.facts import values

ROOT = Path(__file__).resolve().parents[2]

PLAIN = {0, 1, 2, 3, 4, 0.5, 10, 100, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 0.01, 255, 65535}
"""Numbers of arithmetic: ends of ranges, units, axes, numbers of a command, bytes."""

CHOICES = {
    "hil/links/backends/crazyflie.py": {"ASK", "ARM_PERIOD", "HOLDS", "DESCENT", "SHORTEST"},
    "hil/links/backends/betaflight.py": {
        "EXPIRES",
        "FEWEST_AUX",
        "LONGEST_DELAY",
        "NEAR",
        "KEEP_ALIVE",
        "OPEN_TIME",
        "ARM_LOW",
        "POLLS",
        "READ_BACK",
    },
    "hil/links/crtp.py": set(),
    "tests/fakes/fake_crazyflie.py": set(),
}
"""Module -> constants that are a choice of ours, not a firmware's behaviour."""

PARAMETER = re.compile(r"^(flightmode|stabilizer|motorPowerSet|MSP)[._]\w+$")
"""Names that a firmware gave."""


def names(target: ast.expr) -> set[str]:
    """Return the names that an assignment binds."""
    return {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}


def offences(text: str, choices: set[str]) -> list[str]:
    """Return numbers and parameter names of a module that have no source, with their line."""
    tree = ast.parse(text)
    free: set[int] = set()  # literals of ours, and of annotations' bounds
    for node in ast.walk(tree):
        ours = isinstance(node, ast.Assign) and set().union(*map(names, node.targets)) & choices
        bounds = isinstance(node, ast.AnnAssign)
        if ours or bounds:
            free |= {id(part) for part in ast.walk(node)}
    rows = set(values("crazyflie")) | set(values("betaflight"))
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or id(node) in free or isinstance(node.value, bool):
            continue
        number = isinstance(node.value, int | float) and abs(node.value) not in PLAIN
        named = isinstance(node.value, str) and PARAMETER.match(node.value)
        if number or (named and node.value not in rows):
            found.append(f"{node.lineno}: {node.value!r}")
    return found


@pytest.mark.parametrize("path", CHOICES)
def test_no_constant_of_a_firmware_without_a_source(path):
    assert offences((ROOT / path).read_text(encoding="utf-8"), CHOICES[path]) == []


@pytest.mark.parametrize("path", CHOICES)
def test_each_choice_is_still_there(path):
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    bound = {
        name
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        for name in names(target)
    }
    assert CHOICES[path] - bound == set()


def test_a_constant_without_a_source_is_found():
    assert offences("LEVELS_AFTER = 0.36\n", set()) == ["1: 0.36"]
    assert offences("ASK = 0.36\n", {"ASK"}) == []
    assert offences("def f():\n    return set('flightmode.other', 42)\n", set()) == [
        "2: 'flightmode.other'",
        "2: 42",
    ]
