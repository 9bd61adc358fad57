"""The statistics of ledgers, on worlds made up so that the answer is known."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from bench.diagnose import ledger, sealed
from bench.diagnose.sealed import NOT_WAITED
from bench.worlds.world import ALL_FLOORS, FLOORS, ONE_SIDED, dust_of, world_of
from visthrow.paper import measurements

TRUTH = math.exp((math.log(9.0) + 6.0) / 3.5)
"""Size of the made-up curve at 90 %."""


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


def test_wilson_by_the_textbook():
    """8 of 10: Newcombe 1998 and others give 0.490 to 0.943."""
    assert ledger.wilson(8, 10) == pytest.approx((0.8, 0.4902, 0.9433), abs=1e-4)
    assert ledger.wilson(0, 150)[2] == pytest.approx(0.0250, abs=1e-4)


def drawn_curve(rng, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of 3 to 30 floors, named by a curve that is at 90 % at :data:`TRUTH`."""
    size = np.exp(rng.uniform(np.log(3), np.log(30), count))
    return size, rng.random(count) < 1.0 / (1.0 + np.exp(-(-6.0 + 3.5 * np.log(size))))


def test_hidden_effects_that_look_alike_count_once_each():
    """Thrust and mass, hidden together: each name stands for its own, a class for one, and no name
    for two.
    """
    both = {"thrust_gain", "mass_quad"}
    assert sealed.matched([{"mass_quad"}, {"thrust_gain"}], both) == ["mass_quad", "thrust_gain"]
    assert sealed.matched([{"thrust_gain", "mass_quad"}, {"mass_quad"}], both) == [
        "thrust_gain",
        "mass_quad",
    ]
    assert sealed.matched([{"air_density"}], both) == ["mass_quad"]
    assert sealed.matched([{"thrust_gain"}, {"air_density"}, {"wind_x"}], {"thrust_gain"}) == [
        "thrust_gain",
        "",
        "",
    ]
    assert ledger.names(world(dict.fromkeys(both, 0.01), [["mass_quad"], ["thrust_gain"]])) == (
        2,
        2,
        2,
        2,
    )


def test_a_completeness_curve_is_found_again():
    curve = ledger.curve(*drawn_curve(np.random.default_rng(3), 600))
    value, low, high = curve.size(0.9)
    assert low < TRUTH < high
    assert value == pytest.approx(TRUTH, rel=0.15)
    assert high / low < 1.5
    assert curve.size(0.5)[0] == pytest.approx(math.exp(6.0 / 3.5), rel=0.15)
    mean, least, most = curve.chance(np.array([TRUTH]))[:, 0]
    assert least < 0.9 < most
    assert mean == pytest.approx(0.9, abs=0.04)


def test_intervals_of_limits_hold_the_truth_with_few_worlds():
    rng = np.random.default_rng(0)
    found = [ledger.curve(*drawn_curve(rng, 12)).size(0.9) for _ in range(200)]
    assert sum(low <= TRUTH <= high for _, low, high in found) >= 180


def test_sizes_that_were_all_named_leave_the_limit_open_below_and_few_worlds_leave_it_open():
    size = np.geomspace(3.0, 30.0, 8)
    value, low, high = ledger.curve(size, np.ones(8, dtype=bool)).size(0.9)
    assert low < 3.0 < high
    assert ledger.within((value, low, high), size).endswith("]")
    assert ledger.within((1.0, 0.5, 40.0), size) == "<3 [<3, >30]"
    assert ledger.met((5.0, 4.0, 6.0), 8.0) == "yes"
    assert ledger.met((9.0, 8.5, 12.0), 8.0) == "no"
    assert ledger.met((7.0, 5.0, 12.0), 8.0) == "not resolved"
    none = ledger.curve(size, np.zeros(8, dtype=bool)).size(0.9)
    assert none[1] > 20.0


def test_limits_stand_in_the_unit_in_which_they_are_asked_for_and_worlds_with_a_camera_apart(
    tmp_path,
):
    floors = np.geomspace(1.0, 15.0, 12)
    sizes = {"camera_tilt_x": 1.0, "marker_rot_x": 1.0, "payload_drag": 2.0}
    worlds = []
    for name, scale in sizes.items():
        for f in floors:
            one = world({name: float(scale * f * ALL_FLOORS[name])}, [[name]] if f > 4.0 else [])
            one["recipe"]["camera"] = name != "payload_drag"
            worlds.append(one)
    rows = {
        line.split(" | ")[0].strip("| "): line.split(" | ")
        for line in ledger.completeness(worlds)[2:]
    }
    tilt = rows["camera_tilt_x"]
    assert tilt[4] == "deg"
    assert float(tilt[6].split()[0].strip("<>")) == pytest.approx(
        math.degrees(4.0 * ALL_FLOORS["camera_tilt_x"]), rel=0.4
    )
    assert tilt[7] == "0.2"
    assert rows["payload_drag"][7] == "0.3"
    assert float(rows["payload_drag"][2].split()[0]) == pytest.approx(
        2e-4 * 0.51 / 1.04e-3, rel=0.02
    )
    assert "marker_rot_x, camera" in rows
    assert rows["marker_rot_x"][1] == "0"
    assert rows["rope_length"][-1].startswith("too few worlds")
    ledger.draw(worlds, tmp_path / "completeness.png")
    assert (tmp_path / "completeness.png").stat().st_size > 10_000


LEDGERS = Path(ledger.__file__).parent
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


def test_names_are_counted_up_to_class_and_alone():
    pair = {"rope_length": 0.01, "wind_x": 0.3}
    assert ledger.names(world(pair, [["payload_offset", "rope_length"], ["wind_x"]])) == (
        2,
        2,
        1,
        2,
    )
    assert ledger.names(world(pair, [["payload_offset"], ["com_x"]])) == (2, 1, 0, 1)
    assert ledger.names(world(pair, [["rope_length"], ["payload_offset"]])) == (
        2,
        1,
        1,
        1,
    )  # a cause counts once
    assert ledger.names(world({"law_ball_swirl": 0.02}, [["wind_x"]])) == (1, 0, 0, 0)


def test_a_failure_counts_as_a_miss_and_a_world_not_waited_for_as_nothing():
    effect = {"wind_x": 0.3}
    worlds = [
        world(effect, [["wind_x"]]),
        world(effect, [], error="it broke"),
        world(effect, [], error=NOT_WAITED),
    ]
    row = next(line for line in ledger.accuracy(worlds) if line.startswith("| 1x10"))
    assert row.startswith("| 1x10 | 2 | 1 | 1 | 1/2 = 50 %")
    text = ledger.summary(worlds)
    assert "it broke" in text
    assert NOT_WAITED not in text


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


def test_worlds_with_some_of_every_effect_hide_what_was_drawn_besides():
    plain, dusty = sealed.drawn("1x10", 3), sealed.drawn("1x10+dust", 3)
    assert dusty.effects == plain.effects
    assert dust_of(plain) == {}
    sizes = {name: size / ALL_FLOORS[name] for name, size in dust_of(dusty).items()}
    assert not set(sizes) & set(dusty.effects)
    assert len(sizes) == len(FLOORS) - 1
    assert all(sizes[name] >= 0.0 for name in ONE_SIDED if name in sizes)
    assert np.std(list(sizes.values())) == pytest.approx(sealed.DUST, rel=0.4)
    assert world_of(dusty).mass != world_of(plain).mass
    assert dusty.digest() != plain.digest()


def test_worlds_with_some_of_every_effect_are_counted_apart():
    error = {"name": "wind_x", "truth": 0.3, "named": True, "sd": 0.1}
    held = world(
        {"wind_x": 0.3}, [["wind_x"]], errors=[error | {"estimate": 0.3, "low": 0.2, "high": 0.4}]
    )
    missed = world(
        {"wind_x": 0.3}, [["wind_x"]], errors=[error | {"estimate": 0.9, "low": 0.8, "high": 1.0}]
    )
    missed["recipe"] |= {"dust": 0.5}
    lines = "\n".join(ledger.intervals([held, missed]))
    assert (
        lines.index("nothing else")
        < lines.index("95 % intervals hold the truth: 1/1")
        < lines.index("some of every other")
    )
    assert "95 % intervals hold the truth: 0/1" in lines
    assert sum(map(len, (size for size, _ in ledger.singles([held, missed]).values()))) == 1


def test_gain_is_a_share_of_the_oracles_and_harm_is_told():
    assert ledger.gain_ratio({"before": 100.0, "after": 10.0, "oracle": 0.0}) == pytest.approx(0.9)
    assert math.isnan(ledger.gain_ratio({"before": 2.0, "after": 0.0, "oracle": 0.0}))
    assert math.isnan(
        ledger.gain_ratio({"before": 100.0, "after": 10.0})
    )  # a law: nobody knows the truth's size
    held = (
        {"before": 50.0, "after": 5.0, "oracle": 0.0},
        {"before": 50.0, "after": 60.0, "oracle": 0.0},
    )
    worlds = [world({"wind_x": 0.3}, [["wind_x"]], held=h | {"samples": 10000}) for h in held]
    row = ledger.gains(worlds)[-1]
    assert "1/2 = 50 %" in row.split("|")[6]  # by 3 nats
    assert "0/2 = 0 %" in row.split("|")[7]  # a thousandth of the error


def test_worlds_about_a_limit_hide_an_effect_that_there_is():
    assert list(sealed.drawn("limit:wind_x", 3).effects) == ["wind_x"]
    with pytest.raises(ValueError, match=r"no effect or noise 'wnid_x'; there are .*wind_x"):
        sealed.drawn("limit:wnid_x", 3)
