"""The statistics of ledgers, on worlds made up so that the answer is known."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.diagnose import ledger, sealed
from bench.worlds.world import ALL_FLOORS
from visthrow.paper import measurements


def world(effects: dict, named: list, kind: str = "1x10", **more) -> dict:
    """A line of a ledger."""
    recipe = {"effects": effects, "plant": "rod", "seed": 1}
    overall = "KNOWN" if named else "NO EFFECT"
    return {
        "kind": kind,
        "recipe": recipe,
        "named": named,
        "overall": overall,
        "explain_s": 1.0,
    } | more


def told(overall: str, recipe: dict, named=(), **more) -> bool:
    made = world(recipe.pop("effects", {}), list(named), **more)
    return ledger.right(
        made
        | {
            "overall": overall,
            "unknown": overall == "UNKNOWN",
            "recipe": made["recipe"] | recipe,
        }
    )


@pytest.mark.parametrize(
    ("recipe", "right", "more", "wrong"),
    [
        ({}, "NO EFFECT", {}, "KNOWN"),
        ({"effects": {"law_ball_swirl": 0.02}}, "UNKNOWN", {}, "NO EFFECT"),
        ({"lost": 0.1}, "KNOWN", {"varies": ["dropped_commands"]}, "UNKNOWN"),
        ({"varies": {"cmd_delay": 0.01}}, "KNOWN", {"varies": ["cmd_jitter"]}, "UNKNOWN"),
        (
            {"varies": {"mass_payload": 0.01}},
            "KNOWN",
            {"varies": ["mass_payload_by_flight"]},
            "NO EFFECT",
        ),
        (
            {"varies": {"cmd_delay": 0.01}, "days": 4},
            "KNOWN",
            {"varies": ["cmd_jitter"], "drifts": [["cmd_delay"]]},
            "UNKNOWN",
        ),
        ({"effects": {"com_x": 0.01}}, "KNOWN", {"class": True}, "UNKNOWN"),
    ],
)
def test_what_is_told_as_what_it_is(recipe, right, more, wrong):
    assert told(right, dict(recipe), **more)
    assert not told(wrong, dict(recipe), **more)
    if not recipe.get("effects", {}).keys() & {"com_x"}:
        assert not told(right, dict(recipe), [["com_x"]], **more)
    if more:
        assert not told(right, dict(recipe))


SHIPPED = {
    name: [
        json.loads(line) for line in (Path(ledger.__file__).parent / name).read_text().splitlines()
    ]
    for name in ("ledger.jsonl", "ledger-earlier.jsonl")
}
RECORD = measurements.load(measurements.PAGES / "diagnosis-trust-page.json")
"""The figures of the ledgers, as `visthrow bench records` prints them."""
HIDDEN = [table for table in RECORD["tables"] if table["title"].startswith("Hidden worlds")]
ROWS = ["| " + " | ".join(row) + " |" for table in HIDDEN for row in table["rows"]]
TRUST = "\n".join([*ROWS, *(table["title"] for table in HIDDEN), *RECORD["notes"]])
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


@pytest.mark.parametrize(("begins", "kind"), KINDS.items())
def test_the_record_says_what_the_shipped_ledger_says(begins, kind):
    """Worlds, found, names up to class, exact, more names than causes: cell by cell; none is left
    out of any row.
    """
    group = [w for w in ledger.answered(SHIPPED["ledger.jsonl"]) if w["kind"] == kind]
    (row,) = [line for line in TRUST.splitlines() if line.startswith(f"| {begins}")]
    cells = [cell.strip() for cell in row.strip("|").split("|")][1:]
    given, right, exact, found = np.sum([ledger.names(w) for w in group], axis=0)
    hidden = sum(len(ledger.truth_of(w)) for w in group)
    more = sum(ledger.names(w)[0] > len(ledger.truth_of(w)) for w in group)
    quiet = sum(w["overall"] == "NO EFFECT" for w in group)
    if kind == "law":
        ranks = [(w["laws"] + [None])[:3] for w in group]
        terms = [sealed.TERMS[next(iter(w["recipe"]["effects"]))] for w in group]
        first, among = (
            sum(r[0] == t for r, t in zip(ranks, terms)),
            sum(t in r for r, t in zip(ranks, terms)),
        )
        expected = [
            f"UNKNOWN in {len(group)}",
            f"true term first in {first}, among three in {among}",
            "-",
        ]
        expected += ["wrong names beside it in one [0, 5]"]
        assert [w.get("unknown") for w in group] == [True] * len(group)
        assert more == 1
    elif hidden:
        total = f" of {hidden}" if kind in ("2x12", "3x12") else ""
        expected = [f"{found}{total}", f"{right} of {given}", str(exact), str(more)]
    else:
        expected = ["-", f"NO EFFECT in {quiet}", "-", str(more)]
    assert cells[0] == str(len(group))
    assert [cell.replace(" [99, 100]", "") for cell in cells[1:]] == expected


def test_the_record_says_what_the_ledgers_intervals_hold_and_whose_worlds_are_counted():
    kept = SHIPPED["ledger.jsonl"]
    for group in ([w for w in kept if not ledger.dusty(w)], [w for w in kept if ledger.dusty(w)]):
        (line,) = [line for line in ledger.coverage(group) if line.startswith("- 95")]
        assert line.split(": ")[1].replace("/", " of ") in TRUST
    before = [w for w in SHIPPED["ledger-earlier.jsonl"] if w["commit"] == "88f7402"]
    counts = {
        name: len(size)
        for name, (size, _) in ledger.singles(ledger.answered(kept + before)).items()
    }
    assert f"over {sum(counts.values())} worlds with one effect" in TRUST
    assert f"| rope length | 1.6 mm | {counts['rope_length']} |" in TRUST
    assert f"| thrust | 0.99 % [0.94, 1.1] | {counts['thrust_gain']} |" in TRUST


def test_coverage_counts_what_the_intervals_hold():
    """Errors of a normal distribution of the stated deviation: each level must come out
    as itself.
    """
    rng, floor = np.random.default_rng(0), ALL_FLOORS["wind_x"]
    rows = []
    for z in rng.standard_normal(2000):
        e = {
            "name": "wind_x",
            "truth": 0.3,
            "estimate": 0.3 + z * floor,
            "sd": floor,
            "named": True,
        }
        rows.append(
            world(
                {"wind_x": 0.3},
                [["wind_x"]],
                errors=[
                    e | {"low": e["estimate"] - 1.96 * floor, "high": e["estimate"] + 1.96 * floor}
                ],
            )
        )
    shares = [float(line.split("= ")[1].split(" %")[0]) for line in ledger.coverage(rows)[:3]]
    assert shares == pytest.approx([50, 80, 95], abs=3)
    assert "median 0.6" in ledger.coverage(rows)[3]  # 0.674 deviations
