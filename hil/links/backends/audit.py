"""Audit of an autopilot's parameters at connect, whose rules each back-end holds; a mismatch
refuses to fly, and nothing is written unless the operator said so.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from hil.links.facts import values
from hil.links.roster import Announce
from visthrow.common.toml_text import tables_beside

ASK_AGAIN = 0.2  # between two questions for a value that has not come [s]
# after a value was written, answers may still be on their way that were given before; then it is
# read back [s]
SETTLE = 0.5
GIVE_UP = 5.0  # a value that has not come within this time is missing [s]
GIVE_UP_OPTIONAL = 1.0  # likewise one that not all firmware has [s]
NO_SUCH_PARAMETER = 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST
ROUNDING = 1e-6  # tolerance of values
RULES = tables_beside(__file__, "rules.toml")
MOST_NAMED = 4  # parameters that a fault names; the table has all


@dataclass(frozen=True)
class Rule:
    """The required value of one parameter; all that is stated must hold."""

    name: str
    why: str
    values: tuple[float, ...] = ()  # one of these
    tolerance: float = 0.0  # of them; 0: rounding
    mask: int = 0  # bits that must be set
    above: float = -math.inf
    below: float = math.inf
    minimum: float = -math.inf
    maximum: float = math.inf
    expected: str = ""  # in words; "": the value, or the bits
    # write the bits, the first of the values, or the maximum, where the operator asked for it
    write: bool = False
    optional: bool = False  # firmware without it is right as well
    warns: bool = False  # a mismatch is reported, and flown with

    def good(self, value: float) -> bool:
        """Return whether a value is as required."""
        equal = not self.values or any(
            abs(value - x) <= (self.tolerance or ROUNDING * max(1.0, abs(x))) for x in self.values
        )
        in_range = self.above < value < self.below
        in_range &= self.minimum - ROUNDING <= value <= self.maximum + ROUNDING
        return equal and in_range and (not self.mask or int(value) & self.mask == self.mask)

    def correct(self, value: float) -> float:
        """Return what is written in place of a value."""
        return int(value) | self.mask if self.mask else (*self.values, self.maximum)[0]

    @property
    def words(self) -> str:
        """The expected value in words."""
        exact = f"{self.values[0]:g}" if self.values else f"with the bits of {self.mask} set"
        return self.expected or exact


def rules_of(firmware: str, params: Any, **further: Any) -> list[Rule]:
    """Return the rules of ``rules.toml`` for a firmware by its facts, the vehicle's configuration
    and further values.
    """
    terms = values(firmware) | vars(params) | further
    rules = []
    for row in RULES[firmware]:
        conditions = row.get("when", {})
        if all(required in (terms[k], bool(terms[k])) for k, required in conditions.items()):
            fields = {key: _fill(key, entry, terms) for key, entry in row.items()}
            fields.pop("when", None)
            rules.append(Rule(**fields))
    return rules


def _fill(key: str, entry: Any, terms: dict[str, Any]) -> Any:
    """Return an entry of a row with the terms that it names."""
    if isinstance(entry, list):
        return tuple(_fill(key, value, terms) for value in entry)
    if isinstance(entry, str):
        return entry.format(**terms) if key in ("name", "why", "expected") else terms[entry]
    return entry


class Audit:
    """Asks for parameters one by one and judges them.

    Attributes:
        found: values by name. refused: why a value did not come, by name. written: names that were
            changed.
        problems: mismatches in words, once the audit is done.
    """

    def __init__(
        self,
        rules: Iterable[Rule] = (),
        ask: Callable[[str], None] = lambda name: None,
        write: Callable[[str, float], None] | None = None,
        tell: Announce = None,
    ):
        """Begin with nothing asked; without rules the audit is done.

        ``ask`` sends a question for a parameter, ``write`` a new value (None: nothing is ever
        written), ``tell`` is handed the table, once."""
        self.rules = {rule.name: rule for rule in rules}
        self._ask = ask
        self._write = write
        self._tell = tell
        self.found: dict[str, float] = {}
        self.refused: dict[str, str] = {}
        self.written: list[str] = []
        self._asked: dict[str, float] = {}
        self._written_at: dict[str, float] = {}
        self._now = 0.0
        self._begun: float | None = None
        self.done = not self.rules
        self.problems: list[str] = []

    def refuse(self, name: str, error: int) -> None:
        """Take an answer that there is no value: a MAV_PARAM_ERROR."""
        if not self.done and name in self.rules:
            self.refused[name] = (
                "no such parameter" if error == NO_SUCH_PARAMETER else f"refused with error {error}"
            )

    def feed(self, name: str, value: float) -> None:
        """Take an answer."""
        rule = self.rules.get(name)
        if self.done or rule is None or self._is_settling(name):
            return
        self.found[name] = value
        writes = self._write is not None and rule.write and name not in self.written
        if writes and not rule.good(value):
            self.written.append(name)
            self._written_at[name] = self._now
            del self.found[name]  # it counts when it was read back
            self._write(name, rule.correct(value))

    def _is_settling(self, name: str) -> bool:
        return self._now - self._written_at.get(name, -1e9) < SETTLE

    def service(self, host_time: float) -> None:
        """Ask for what is missing."""
        self._now = host_time
        if self.done:
            return
        self._begun = host_time if self._begun is None else self._begun
        waited = host_time - self._begun
        answered = self.found.keys() | self.refused.keys()
        missing = [
            r.name
            for r in self.rules.values()
            if r.name not in answered and not (r.optional and waited > GIVE_UP_OPTIONAL)
        ]
        if not missing or waited > GIVE_UP:
            self.done = True
            answers = {name: f": {why}" for name, why in self.refused.items()}
            answers |= {name: f" is {x:g}" for name, x in self.found.items()}
            self.problems = [
                f"{r.name}{answers.get(r.name, ' did not come')}; expected {r.words}"
                for r in self._wrong()
                if not r.warns
            ]
            if self._tell is not None:
                self._tell(self.table())
            return
        for name in missing:
            if host_time - self._asked.get(name, -1e9) >= ASK_AGAIN and not self._is_settling(name):
                self._asked[name] = host_time
                self._ask(name)

    def _wrong(self) -> list[Rule]:
        return [
            r
            for r in self.rules.values()
            if not (r.good(self.found[r.name]) if r.name in self.found else r.optional)
        ]

    def fault(self) -> str | None:
        """Return what ends the run, in short; the table has it in full."""
        if not self.problems:
            return None
        names = [rule.name for rule in self._wrong() if not rule.warns]
        rest_of_names = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return (
            f"parameter audit: {', '.join(names[:MOST_NAMED])}{rest_of_names} wrong, see the table"
        )

    def table(self) -> str:
        """Return parameter, found, expected, why, a line each."""
        rows = [("", "parameter", "found", "expected", "why")]
        wrong = self._wrong()
        for name, rule in self.rules.items():
            text = self.refused.get(name, "no answer")
            if name in self.found:
                text = f"{self.found[name]:g}"
            text += " (written)" if name in self.written else ""
            judged = ("WARN" if rule.warns else "WRONG") if rule in wrong else "ok"
            rows.append((judged, name, text, rule.words, rule.why))
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        lines = [
            "  ".join([*(cell.ljust(w) for cell, w in zip(row, widths)), row[4]]).rstrip()
            for row in rows
        ]
        if self.problems:
            lines.append(
                "The runner does not fly with these; set them, or let it write them with"
                " --write-parameters."
            )
        return "\n".join(lines)
