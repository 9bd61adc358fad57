"""Verdicts on published recorded data.

The reasons stand in docs/explanation/diagnosis_trust.md and the record recorded-data-page.

With the environment variable VISTHROW_REAL_DATA naming a folder of the full data sets, all of their
files are looked at."""

import os
from pathlib import Path

import numpy as np
from pytest import approx, mark

from tests.places import DATA
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.select.diagnose_flights import explain
from visthrow.diagnose.select.result import (
    CANDIDATE,
    NAMED,
    NO_EFFECT,
    UNKNOWN,
)
from visthrow.logs import read_all
from visthrow.logs.check.run import check, contradictions

REAL = DATA / "real"
FULL = Path(os.environ.get("VISTHROW_REAL_DATA", REAL))
SETUPS = {
    "crazypad_faults": "crazypad",
    "jugglebot_throws": "jugglebot",
    "motor_prop_stand": "motor_stand",
    "nanobench_cf21": "nanobench_cf21",
    "payload_cf_single": "cf_payload",
    "payload_cf_two_drones": "cf_payload_pair",
    "pendulum_single": "pendulum_encoder",
    "slungload_camera": "slungload_camera",
}


def explain_logs(setup: str, *paths: str | Path):
    logs = setups.read_logs(paths, setup)
    model = setups.model_of(setups.load(setup), logs)
    diagnosis = explain(model, seed=0)
    named = {f.name for f in diagnosis.findings if f.verdict in NAMED}

    def rms(theta, channel=0):
        masks = [s.channel == channel for s in model.stretches]
        return float(
            np.sqrt(
                np.mean(np.concatenate([r[o] for r, o in zip(model.residuals(theta), masks)]) ** 2)
            )
        )

    return diagnosis, named, rms


@mark.parametrize("folder", list(SETUPS))
def test_every_file_gets_a_verdict(folder):
    root = FULL / folder if (FULL / folder).is_dir() else DATA / folder
    files = sorted(p for p in root.iterdir() if p.name.endswith(".csv.gz"))
    assert files
    for path in files:
        for checked in check(setups.read_logs([path], SETUPS[folder])):
            assert checked.verdict in ("ok", "warn", "bad")
            assert not [
                reason
                for reason in contradictions([checked])
                if "idle" not in reason
                and "place" not in reason
                and "no sign of flight" not in reason
            ]


def test_the_raw_blackbox_never_flew():
    first, second = check(read_all([REAL / "betaflight_bbl" / "btfl_001_start.bbl"]))
    assert any("no sign of flight" in row.text for row in second.rows)
    assert first.verdict == second.verdict == "bad"


def test_two_drones_run_on_two_clocks():
    folder = REAL / "payload_cf_two_drones"
    rows = check(setups.read_logs(sorted(folder.glob("*.gz")), "cf_payload_pair"))[1].rows
    (row,) = [row for row in rows if "rms_m" in row.figures]
    assert row.figures["delay_s"] == approx(0.0054, abs=0.002)
    assert row.figures["rms_m"] < 1e-3


@mark.slow
def test_cable_is_ten_millimetres_longer_and_thrust_stronger():
    flights = [REAL / "payload_cf_single" / f"log{number}.csv.gz" for number in (204, 205, 206)]
    diagnosis, named, rms = explain_logs("cf_payload", *flights)
    assert named & {"rope_length", "marker_z"}
    assert named & {"thrust_gain", "mass_quad"}
    length = next(
        f
        for f in diagnosis.findings
        if f.name in ("rope_length", "marker_z") and f.verdict in NAMED
    )
    assert length.estimate == approx(0.010, abs=2e-3)
    assert rms(diagnosis.theta, 1) < 0.5 * rms({}, 1)


@mark.slow
def test_thrust_map_drag_and_battery_of_nanobench():
    diagnosis, named, rms = explain_logs(
        "nanobench_cf21", REAL / "nanobench_cf21" / "B3_figure8_fast_rep1.csv.gz"
    )
    assert named & {"thrust_gain", "mass_quad"}
    assert named & {"rotor_drag_xy", "parasitic"}
    assert rms(diagnosis.theta) < 0.2 * rms({})


@mark.slow
def test_a_motor_idles_and_a_hundred_motors_are_not_one():
    table = REAL / "motor_prop_stand" / "all_tests.csv.gz"
    for pair in ("a1", "c1", "g1"):  # one motor, one propeller, two supplies
        diagnosis, named, _ = explain_logs("motor_stand", f"{table}:{pair}_*")
        assert diagnosis.overall == UNKNOWN  # two tests, one left out in turn, confirm nothing
        assert diagnosis["idle_power"].verdict == CANDIDATE
        assert 1.0 < diagnosis["idle_power"].estimate < 5.0
    diagnosis, named, _ = explain_logs("motor_stand", table)
    assert diagnosis.overall != NO_EFFECT
    assert "thrust_voltage" not in named
