"""Grouping of a foreign table's columns by their names, and units in the names."""

import re
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from visthrow.common.toml_text import tables_beside
from visthrow.logs.readers.table_to_log import Table
from visthrow.logs.readers.text_table import unit_of
from visthrow.logs.unit_names import UNITS

NAMES = tables_beside(__file__, "column_names.toml")
PATTERNS = {name: re.compile(text, re.IGNORECASE) for name, text in NAMES["patterns"].items()}
HINTS = {kind: re.compile(text, re.IGNORECASE) for kind, text in NAMES["hints"].items()}
WHOLE = ("012345678", "0123", "1234", "xyzw", "xyz")
"""Components of complete groups: a matrix, motors or a quaternion, and a vector."""

_SPLIT = re.compile(r"[^A-Za-z0-9]+|(?<=[a-z])(?=[A-Z])|(?<=\D)(?=\d)|(?<=\d)(?=\D)")
_BRACKETS = re.compile(r"^(.+?)\s*[\[(]\s*([^\d\[\]()][^\[\]()]*|)\s*[\])]$")
_NUMBERED = re.compile(r"^(.*?)[._\[]?([0-8])\]?$")


@dataclass(eq=False)
class Group:
    """Columns that belong together, such as the components of a vector."""

    stem: str  # common part of their names
    columns: tuple[str, ...]
    values: ndarray  # shape (T, number of columns)
    unit: str = ""  # stated by their names; "" if none is

    @property
    def listed(self) -> str:
        """Return the columns as text for messages."""
        return ", ".join(self.columns)

    @property
    def middle(self) -> float:
        """Return the median of the values."""
        return float(np.nanmedian(self.values))

    @property
    def reach(self) -> float:
        """Return the 99th percentile of the absolute values."""
        return float(np.nanpercentile(np.abs(self.values), 99))

    def matches(self, pattern: str) -> bool:
        """Return whether the stem matches a pattern of ``column_names.toml``."""
        return bool(PATTERNS[pattern].search(self.stem))

    def hints_at(self, kind: str) -> bool:
        """Return whether the stem hints at this kind, and at no other one but a position."""
        kinds = {name for name, pattern in HINTS.items() if pattern.search(self.stem)}
        return kind in kinds and kinds <= {kind, "position"}


def groups_of(numbers: Table) -> list[Group]:
    """Group columns by their names into matrices, quaternions, sets of motors and vectors; the rest
    are groups of one.
    """
    families = defaultdict(dict)
    for name in numbers:
        base, unit = split_unit(name)
        if motor := PATTERNS["motor"].match(base):
            kind = motor[1] + (motor[3] or "")
            families[0, "motor", kind, unit][motor[2]] = name
        if numbered := _NUMBERED.match(base):
            families[1, numbered[1], "", unit][numbered[2]] = name
        if part := PATTERNS["component"].match(base):
            ending = part[2].lower()
            unit = unit or NAMES["units"].get((part[3] or "").lower(), "")
            stem = part[1] + NAMES["families"].get(ending, "")
            families[2, stem, "", unit].setdefault(NAMES["components"][ending], name)
        if part := PATTERNS["leading_component"].match(base):
            letter = part[1].lower()
            stem = _stem_behind(letter, part[2])
            behind = unit or _last_unit(part[2])
            families[3, stem, "", behind].setdefault(NAMES["components"][letter], name)
    listed = []
    for (_, stem, _, unit), places in sorted(families.items(), key=lambda item: item[0][0]):
        if stem == "motor" and len(places) > 4:  # outputs without a motor are constant
            places = {
                place: name for place, name in places.items() if moves(numbers[name][:, None])
            }
        for whole in WHOLE:
            if places.keys() == set(whole):
                listed.append((stem, unit, [places[place] for place in whole]))
    listed += [("", "", names) for names in _neighbours(numbers)]
    listed += [(name, unit_by_name(name), [name]) for name in numbers]
    groups = []
    used = set()
    for stem, unit, names in listed:
        if used.isdisjoint(names):
            values = np.column_stack([numbers[name] for name in names])
            groups.append(Group(stem, tuple(names), values, unit))
            used.update(names)
    return groups


def _stem_behind(letter: str, words: str) -> str:
    """Return the stem of a name that begins with a component: its other words, and the family of
    the component unless the words already hint at a kind.
    """
    stem = f"{words}_"
    hinted = {kind for kind, pattern in HINTS.items() if pattern.search(stem)} - {"position"}
    return stem if hinted else stem + NAMES["families"].get(letter, "")


def _last_unit(words: str) -> str:
    """Return the unit that the last of several words states, or ""."""
    *before, last = re.split(r"[._ ]+", words.lower())
    return NAMES["units"].get(last, "") if before else ""


def moves(values: ndarray) -> bool:
    """Return whether rows of numbers, shape (T, columns), change."""
    whole = values[np.all(np.isfinite(values), axis=1)]
    return len(whole) > 0 and bool(np.any(np.ptp(whole, axis=0) > 0.0))


def rises(cells: ndarray) -> bool:
    """Return whether a column rises like a clock."""
    steps = np.diff(cells[np.isfinite(cells)])
    return len(steps) > 10 and bool(np.all(steps >= 0.0)) and np.mean(steps > 0.0) > 0.3


def _neighbours(numbers: Table) -> list[list[str]]:
    """Group adjacent columns of a table without header: four with norm 1 as a quaternion, others
    in threes, without counters.
    """
    names = [
        name
        for name, cells in numbers.items()
        if not (rises(cells) and np.array_equal(cells, np.round(cells)))
    ]
    groups = []
    run = []
    while names and all(name.startswith("column ") for name in names):
        four = np.column_stack([numbers[name] for name in names[:4]])
        if four.shape[1] == 4 and np.nanmax(np.abs(np.linalg.norm(four, axis=1) - 1.0)) < 0.05:
            groups.append(names[:4])
            del names[:4], run[:]
            continue
        run.append(names.pop(0))
        if len(run) == 3:
            groups.append(run)
            run = []
    return groups


def split_unit(name: str) -> tuple[str, str]:
    """Return a name without the unit in brackets at its end, and that unit, or ""."""
    match = _BRACKETS.match(name)
    if match is None:
        return name, ""
    unit = unit_of(match[2])
    spellings = (match[2], unit or "", NAMES["units"].get(unit or "", ""))
    known = next((spelling for spelling in spellings if spelling in UNITS), "")
    return (match[1], known) if known or unit is not None else (name, "")


def unit_by_name(name: str) -> str:
    """Return the unit that a name states in brackets or by its last word, or ""."""
    unit = split_unit(name)[1]
    last = re.split(r"[^A-Za-z0-9]+", name.rstrip(")]} "))[-1].lower()
    words = [word.lower() for word in _SPLIT.split(name) if word] or [last]
    return unit or NAMES["units"].get(last) or NAMES["units"].get(words[-1], "")
