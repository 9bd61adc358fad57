"""The baseline beside the policies: units, rows of compare."""

import json

from pytest import importorskip

from tests.commands import run_command
from visthrow.cli import compare
from visthrow.paper.baseline import thrower

importorskip("piqp")


def test_compare_shows_the_baseline_under_each_condition(tmp_path, capsys, one_start):
    out = tmp_path / "rows.json"
    command = "compare state baseline --throws 1 --targets 1.5 --device cpu"
    assert run_command(f"{command} --out {tmp_path} --json {out}") == 0
    rows = json.loads(out.read_text())["rows"]
    title = thrower.title_of(thrower.IDEAL, "none")
    assert [row["policy"] for row in rows] == [
        "state",
        title,
        *(thrower.title_of("hybrid", c) for c in thrower.COMPENSATIONS),
    ]
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if title in line]
    assert "0.127 ± 0.019" in line, "the paper's TO+MPC stands beside the baseline's row"
    assert sum("0.127 ± 0.019" in line for line in printed.splitlines()) == 1, "and beside no other"
    assert next(row for row in rows if row["policy"] == title)["error_mean"] < 0.05
    assert (tmp_path / "compare-hybrid.csv").read_text().count("TO+MPC") == 4
    assert compare.rows_of([compare.Entry("a", "state", [])]) == []
