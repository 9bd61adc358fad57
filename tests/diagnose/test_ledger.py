"""The statistics of ledgers, on worlds made up so that the answer is known."""

import json
from pathlib import Path

import numpy as np
from pytest import mark

from bench.diagnose import ledger, sealed
from visthrow.paper import measurements

LINES = (Path(ledger.__file__).parent / "ledger.jsonl").read_text().splitlines()
WORLDS = ledger.answered([json.loads(line) for line in LINES])
RECORD = measurements.load(measurements.PAGES / "diagnosis-trust-page.json")
"""The figures of the ledger, as `visthrow bench records` prints them."""
HIDDEN = [table for table in RECORD["tables"] if table["title"].startswith("Hidden worlds")]
ROWS = [row for table in HIDDEN for row in table["rows"]]
KINDS = {
    "nothing; noise": "null",
    "one effect, 15": "1x15",
    "one effect, 10 floors |": "1x10",
    "one effect, 6": "1x6",
    "one effect, 3": "curve",
    "a delay": "limit:cmd_delay",
    "thrust, off": "limit:thrust_gain",
    "two effects": "2x12",
    "three effects": "3x12",
    "a law": "law",
    "1 to 15 floors": "sight",
    "nothing, and some": "null+dust",
    "one effect, 10 floors, and": "1x10+dust",
}


@mark.parametrize(("begins", "kind"), KINDS.items())
def test_the_record_says_what_the_shipped_ledger_says(begins, kind):
    """Worlds, found, names up to class, exact, more names than causes: cell by cell; none is left
    out of any row.
    """
    group = [w for w in WORLDS if w["kind"] == kind]
    ((_, *cells),) = [row for row in ROWS if f"{row[0]} |".startswith(begins)]
    given, right, exact, found = np.sum([ledger.names(w) for w in group], axis=0)
    hidden = sum(len(ledger.truth_of(w)) for w in group)
    more = sum(ledger.names(w)[0] > len(ledger.truth_of(w)) for w in group)
    quiet = sum(w["overall"] == "NO EFFECT" for w in group)
    if kind == "law":
        terms = [sealed.TERMS[next(iter(w["recipe"]["effects"]))] for w in group]
        first = sum(w["laws"][:1] == [term] for w, term in zip(group, terms))
        among = sum(term in w["laws"][:3] for w, term in zip(group, terms))
        ranked = f"true term first in {first}, among three in {among}"
        expected = [f"UNKNOWN in {len(group)}", ranked, "-", "wrong names beside it in one [0, 5]"]
        assert [w.get("unknown") for w in group] == [True] * len(group)
        assert more == 1
    elif hidden:
        total = f" of {hidden}" if kind in ("2x12", "3x12") else ""
        expected = [f"{found}{total}", f"{right} of {given}", str(exact), str(more)]
    else:
        expected = ["-", f"NO EFFECT in {quiet}", "-", str(more)]
    assert cells[0] == str(len(group))
    assert [cell.replace(" [99, 100]", "") for cell in cells[1:]] == expected
