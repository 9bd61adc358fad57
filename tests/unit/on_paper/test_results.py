"""Units of work: keys, files and records."""

import numpy as np
from pytest import approx, mark, raises

from visthrow.common.errors import StorageError
from visthrow.paper import results


def unit(number: int = 0) -> dict:
    return results.policy_unit("state", "ab", "state", "hybrid", 2.0, 3, number)


def columns(number: int = 0) -> dict:
    return {
        "success": np.array([True, True, False]),
        "landing_w": np.array([[2.1, 0.0], [1.9, 0.2], [np.nan, np.nan]]),
        "error": np.array([0.1, number + 0.1234567, np.nan]),
    }


def test_key_depends_on_every_entry_and_not_on_their_order():
    base = unit()
    assert results.key_of(dict(reversed(base.items()))) == results.key_of(base)
    changed = {name: {**base, name: "other"} for name in base}
    assert (
        len({results.key_of(u) for u in changed.values()} | {results.key_of(base)}) == len(base) + 1
    )


def test_result_survives_its_file(tmp_path):
    path = results.save(tmp_path, results.Result(unit(), columns(), {"commit": "c"}, {"n": 1}))
    assert "NaN" not in path.read_text()
    (again,) = results.load(path)
    assert again.unit == unit()
    assert again.extra == {"n": 1}
    assert again.good.tolist() == [True, True, False]
    assert np.isnan(again.columns["error"][2])
    assert again.of("error") == approx([0.1, 0.1235])
    assert again.miss == approx(np.array([[0.1, 0.0], [-0.1, 0.2]]))


def test_batches_are_joined_in_order_and_moving_goals_count():
    made = [results.Result({**unit(), "batch": b}, columns(b)) for b in (1, 0)]
    made.append(
        results.Result(
            unit(5), {**columns(), "goal_w": np.array([[2.1, 0.1], [2.0, 0.2], [np.nan, np.nan]])}
        )
    )
    made.append(results.Result({**unit(), "batch": 1, "throws": 2}, columns(9)))
    moving, whole = results.join(made)
    assert whole.unit == {**unit(), "throws": 6}
    assert whole.columns["error"][[1, 4]] == approx([0.1234567, 1.1234567])
    assert moving.miss == approx(np.array([[0.0, -0.1], [-0.1, 0.0]]))


def test_packed_record_does_not_depend_on_the_order(tmp_path):
    made = [results.Result(unit(n), columns(n)) for n in range(3)]
    results.pack(made, tmp_path / "a" / "x.json")
    results.pack(reversed(made), tmp_path / "b" / "x.json")
    assert (tmp_path / "a/x.json").read_bytes() == (tmp_path / "b/x.json").read_bytes()
    assert set(results.load_all([tmp_path / "a"])) == {r.key for r in made}


@mark.parametrize("text", ["", "[1]", '{"results": [{"unit": 1}]}', '{"unit": {}}'])
def test_a_file_that_is_no_record_is_named(tmp_path, text):
    path = tmp_path / "x.json"
    path.write_text(text)
    with raises(StorageError, match=r"x\.json; expected throws"):
        results.load(path)


def test_work_does_only_what_is_missing(tmp_path):
    calls = []

    def function(u):
        calls.append(u["seed"])
        return columns(u["seed"]), {}

    results.work([unit(0)], tmp_path, function)
    known = {results.key_of(unit(1)): results.Result(unit(1), columns(1))}
    units = results.work([unit(0), unit(1), unit(2), unit(2)], tmp_path, function, known)
    assert calls == [0, 2]
    assert [units[results.key_of(unit(n))].of("error")[1] for n in range(3)] == approx(
        [0.1235, 1.1235, 2.1235], abs=1e-4
    )
