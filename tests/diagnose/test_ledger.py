"""The statistics of ledgers, on worlds made up so that the answer is known."""

import math

import numpy as np
import pytest

from tests.diagnose import ledger
from tests.diagnose.sealed import NOT_WAITED
from tests.worlds.world import FLOORS


def world(effects: dict, named: list, kind: str = "1x10", **more) -> dict:
    """A line of a ledger."""
    recipe = {"effects": effects, "plant": "rod", "seed": 1}
    overall = "KNOWN" if named else "NO EFFECT"
    return {"kind": kind, "recipe": recipe, "named": named, "overall": overall, "explain_s": 1.0} | more


def test_wilson_by_the_textbook():
    """8 of 10: Newcombe 1998 and others give 0.490 to 0.943."""
    assert ledger.wilson(8, 10) == pytest.approx((0.8, 0.4902, 0.9433), abs=1e-4)
    assert ledger.wilson(0, 150)[2] == pytest.approx(0.0250, abs=1e-4)


def test_a_completeness_curve_is_found_again():
    rng = np.random.default_rng(3)
    size = np.exp(rng.uniform(np.log(3), np.log(30), 600))
    named = rng.random(600) < 1.0 / (1.0 + np.exp(-(-6.0 + 3.5 * np.log(size))))
    truth = math.exp((math.log(9.0) + 6.0) / 3.5)
    value, low, high = ledger.rho90(size, named, rng)
    assert low < truth < high
    assert value == pytest.approx(truth, rel=0.15)
    assert high / low < 1.5


def test_names_are_counted_up_to_class_and_alone():
    pair = {"rope_length": 0.01, "wind_x": 0.3}
    assert ledger.names(world(pair, [["payload_offset", "rope_length"], ["wind_x"]])) == (2, 2, 1, 2)
    assert ledger.names(world(pair, [["payload_offset"], ["com_x"]])) == (2, 1, 0, 1)
    assert ledger.names(world(pair, [["rope_length"], ["payload_offset"]])) == (2, 1, 1, 1)  # a cause counts once
    assert ledger.names(world({"law_ball_swirl": 0.02}, [["wind_x"]])) == (1, 0, 0, 0)


def test_a_failure_counts_as_a_miss_and_a_world_not_waited_for_as_nothing():
    effect = {"wind_x": 0.3}
    worlds = [world(effect, [["wind_x"]]), world(effect, [], error="it broke"), world(effect, [], error=NOT_WAITED)]
    row = next(line for line in ledger.accuracy(worlds) if line.startswith("| 1x10"))
    assert row.startswith("| 1x10 | 2 | 1 | 1 | 1/2 = 50 %")
    text = ledger.summary(worlds)
    assert "it broke" in text
    assert NOT_WAITED not in text


def test_coverage_counts_what_the_intervals_hold():
    """Errors of a normal distribution of the stated deviation: each level must come out as itself."""
    rng, floor = np.random.default_rng(0), FLOORS["wind_x"]
    rows = []
    for z in rng.standard_normal(2000):
        e = {"name": "wind_x", "truth": 0.3, "estimate": 0.3 + z * floor, "sd": floor, "named": True}
        rows.append(world({"wind_x": 0.3}, [["wind_x"]], errors=[e | {"low": e["estimate"] - 1.96 * floor,
                                                                     "high": e["estimate"] + 1.96 * floor}]))  # fmt: skip
    shares = [float(line.split("= ")[1].split(" %")[0]) for line in ledger.intervals(rows)[:3]]
    assert shares == pytest.approx([50, 80, 95], abs=3)
    assert "median 0.6" in ledger.intervals(rows)[3]  # 0.674 deviations


def test_gain_is_a_share_of_the_oracles_and_harm_is_told():
    assert ledger.gain_ratio({"before": 100.0, "after": 10.0, "oracle": 0.0}) == pytest.approx(0.9)
    assert math.isnan(ledger.gain_ratio({"before": 2.0, "after": 0.0, "oracle": 0.0}))
    assert math.isnan(ledger.gain_ratio({"before": 100.0, "after": 10.0}))  # a law: nobody knows the truth's size
    held = ({"before": 50.0, "after": 5.0, "oracle": 0.0}, {"before": 50.0, "after": 60.0, "oracle": 0.0})
    worlds = [world({"wind_x": 0.3}, [["wind_x"]], held=h | {"samples": 10000}) for h in held]
    row = ledger.gains(worlds)[-1]
    assert "1/2 = 50 %" in row.split("|")[6]  # by 3 nats
    assert "0/2 = 0 %" in row.split("|")[7]  # a thousandth of the error
