"""The record of the trust page agrees with the shipped ledger."""

import json
from pathlib import Path

import numpy as np

from bench.diagnose import ledger, sealed
from visthrow.paper import measurements

KINDS = (
    *("null", "1x15", "1x10", "1x6", "curve", "limit:cmd_delay", "limit:thrust_gain"),
    *("2x12", "3x12", "law", "sight", "null+dust", "1x10+dust"),
)
"""Of worlds, as the record's rows list them."""


def cells(kind, group):
    """Return a row's cells: found, names right up to class, exact, more names than causes."""
    given, right, exact, hits = np.sum([ledger.names(w) for w in group], axis=0)
    hidden = sum(len(ledger.truth_of(w)) for w in group)
    more = sum(ledger.names(w)[0] > len(ledger.truth_of(w)) for w in group)
    if kind == "law":
        assert all(w["unknown"] for w in group)
        terms = [sealed.TERMS[next(iter(w["recipe"]["effects"]))] for w in group]
        first, among = (
            sum(term in w["laws"][:count] for w, term in zip(group, terms)) for count in (1, 3)
        )
        counts = f"UNKNOWN in {len(group)}", f"true term first in {first}, among three in {among}"
        return [*counts, "-", f"wrong names beside it in {('none', 'one')[more]}"]
    if not hidden:
        return ["-", f"NO EFFECT in {sum(w['overall'] == 'NO EFFECT' for w in group)}", "-", more]
    total = f" of {hidden}" if kind in ("2x12", "3x12") else ""
    return [f"{hits}{total}", f"{right} of {given}", exact, more]


def test_the_record_says_what_the_shipped_ledger_says():
    lines = (Path(ledger.__file__).parent / "ledgers/catalogue.jsonl").read_text().splitlines()
    worlds = ledger.select_answered([json.loads(line) for line in lines])
    tables = measurements.load(measurements.PAGES / "diagnosis-trust-page.json")["tables"]
    rows = next(t["rows"] for t in tables if t["title"].startswith("Hidden worlds"))
    for kind, (_, *shown) in zip(KINDS, rows, strict=True):
        group = [w for w in worlds if w["kind"] == kind]
        expected = [str(cell) for cell in (len(group), *cells(kind, group))]
        assert [cell.split(" [")[0] for cell in shown] == expected, kind
