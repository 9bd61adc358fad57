"""Audit of an autopilot's parameters when it connects. A mismatch with the back-end's rules
prevents the flight; parameters are written only if the operator requests it.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from hil.links.facts import values
from hil.links.roster import Announce
from visthrow.common.toml_text import tables_beside

ASK_AGAIN = 0.2  # between two requests for a missing value [s]
# after a write, during which outdated answers may still arrive; then the value is read back [s]
SETTLE = 0.5
GIVE_UP = 5.0  # time after which a value counts as missing [s]
GIVE_UP_OPTIONAL = 1.0  # likewise for a value that not all firmware has [s]
NO_SUCH_PARAMETER = 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST
ROUNDING = 1e-6  # tolerance of values
RULES = tables_beside(__file__, "rules.toml")
MOST_NAMED = 4  # parameters named in a fault; the table has all


@dataclass(frozen=True)
class Rule:
    """The requirements on the value of one parameter; all of them must hold."""

    name: str
    why: str
    values: tuple[float, ...] = ()  # one of these
    tolerance: float = 0.0  # of these values; 0: rounding only
    mask: int = 0  # bits that must be set
    above: float = -math.inf
    below: float = math.inf
    minimum: float = -math.inf
    maximum: float = math.inf
    expected: str = ""  # text for the table; "": the value, or the bits
    # whether the bits, the first of the values, or the maximum may be written on the operator's
    # request
    write: bool = False
    optional: bool = False  # whether firmware may lack the parameter
    warns: bool = False  # whether a mismatch is only reported

    def good(self, value: float) -> bool:
        """Return whether a value meets the requirements."""
        equal = not self.values or any(
            abs(value - x) <= (self.tolerance or ROUNDING * max(1.0, abs(x))) for x in self.values
        )
        in_range = self.above < value < self.below
        in_range &= self.minimum - ROUNDING <= value <= self.maximum + ROUNDING
        return equal and in_range and (not self.mask or int(value) & self.mask == self.mask)

    def correct(self, value: float) -> float:
        """Return the correct value to write in place of a wrong one."""
        return int(value) | self.mask if self.mask else (*self.values, self.maximum)[0]

    @property
    def words(self) -> str:
        """Text of the expected value."""
        exact = f"{self.values[0]:g}" if self.values else f"with the bits of {self.mask} set"
        return self.expected or exact


def rules_of(firmware: str, params: Any, **further: Any) -> list[Rule]:
    """Return a firmware's rules from ``rules.toml``, filled in from its facts, the vehicle's
    configuration and further values.
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
    """Return an entry of a row with the values of the terms that it names."""
    if isinstance(entry, list):
        return tuple(_fill(key, value, terms) for value in entry)
    if isinstance(entry, str):
        return entry.format(**terms) if key in ("name", "why", "expected") else terms[entry]
    return entry


class Audit:
    """Reads an autopilot's parameters and checks them against rules.

    Attributes:
        found: values by name. refused: by name, why a value was not delivered. written: names of
            changed parameters.
        problems: texts of the mismatches, once the audit is done.
    """

    def __init__(
        self,
        rules: Iterable[Rule] = (),
        ask: Callable[[str], None] = lambda name: None,
        write: Callable[[str, float], None] | None = None,
        tell: Announce = None,
    ):
        """Start before the first request; without rules the audit is done at once.

        ``ask`` requests a parameter, ``write`` sends a new value (None: never write), ``tell`` is
        called once with the table."""
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
        """Process an error in place of a value: a MAV_PARAM_ERROR."""
        if not self.done and name in self.rules:
            self.refused[name] = (
                "no such parameter" if error == NO_SUCH_PARAMETER else f"refused with error {error}"
            )

    def feed(self, name: str, value: float) -> None:
        """Process an answer; a wrong value that may be written is corrected."""
        rule = self.rules.get(name)
        if self.done or rule is None or self._is_settling(name):
            return
        self.found[name] = value
        writes = self._write is not None and rule.write and name not in self.written
        if writes and not rule.good(value):
            self.written.append(name)
            self._written_at[name] = self._now
            del self.found[name]  # counts only once it is read back
            self._write(name, rule.correct(value))

    def _is_settling(self, name: str) -> bool:
        return self._now - self._written_at.get(name, -1e9) < SETTLE

    def service(self, host_time: float) -> None:
        """Request missing values; finish when all have arrived or the time is over."""
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
        """Return a short text of the fault that ends the run; the table has all mismatches."""
        if not self.problems:
            return None
        names = [rule.name for rule in self._wrong() if not rule.warns]
        rest_of_names = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return (
            f"parameter audit: {', '.join(names[:MOST_NAMED])}{rest_of_names} wrong, see the table"
        )

    def table(self) -> str:
        """Return the table of all parameters: judgement, name, value found, value expected,
        reason.
        """
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
