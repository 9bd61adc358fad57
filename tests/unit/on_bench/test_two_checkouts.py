"""The comparison of two checkouts on a bank of worlds."""

import json

from bench.diagnose.two_checkouts import compare, varies_right, worlds_of

ANSWER = {"named": [], "overall": "NO EFFECT", "seconds": 2.0, "error": "", "errors": []}


def test_an_answer_that_is_an_error_is_no_right_null(tmp_path, capsys):
    world = {"bank": "sealed", "kind": "null", "recipe": {"effects": {}}}
    failed = ANSWER | {"overall": "ERROR", "error": "TypeError: f() takes 3 arguments"}
    ledger = tmp_path / "two.jsonl"
    ledger.write_text(json.dumps(world | {"old": ANSWER, "new": failed}))
    compare(type("Arguments", (), {"ledgers": [ledger], "list": False}))
    lines = capsys.readouterr().out.splitlines()
    old, new = (line for line in lines if line.startswith("nulls without a name"))
    assert "1 of    1" in old
    assert "0 of    1" in new


def test_the_order_of_worlds_is_fixed_by_the_seeds():
    arguments = ["bench/diagnose/bank-window.txt"], ["bench/diagnose/bank-foreign-window.txt"]
    worlds = worlds_of(*arguments)
    assert worlds == worlds_of(*arguments)
    assert [world[0] for world in worlds[:30]].count("foreign") > 0


def test_the_catalogues_random_effect_is_the_right_answer_of_what_differs():
    world = {"kind": "varies:release_lag", "old": ANSWER | {"varies": ["lag_jitter"]}}
    assert varies_right(world, "old")
    assert not varies_right(world | {"kind": "varies:cmd_delay"}, "old")
