"""Recorded data of others: what is said of each, and what is not.

The reasons stand in docs/explanation/diagnosis_trust.md and the record recorded-data-page.

With the environment variable VISTHROW_REAL_DATA naming a folder of the full data sets, all of their
files are looked at."""

import os
import re
from pathlib import Path

import numpy as np
from pytest import approx, mark

from tests.commands import run_command
from tests.places import DATA
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.select.diagnose_flights import explain
from visthrow.diagnose.select.result import (
    CANDIDATE,
    FOUND,
    IN_PART,
    KNOWN,
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


def explained(setup: str, *paths: str | Path):
    logs = setups.read_logs(paths, setup)
    model = setups.model_of(setups.load(setup), logs)
    diagnosis = explain(model, seed=0)
    named = {f.name for f in diagnosis.findings if f.verdict in NAMED}

    def rms(theta, channel=0):
        own = [s.channel == channel for s in model.stretches]
        return float(
            np.sqrt(
                np.mean(np.concatenate([r[o] for r, o in zip(model.residuals(theta), own)]) ** 2)
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
def test_pendulum_has_three_frictions():
    diagnosis, named, rms = explained(
        "pendulum_encoder", REAL / "pendulum_single" / "single_pendulum_id.csv.gz"
    )
    assert diagnosis.overall == IN_PART  # what is left is a hundred times the encoder's noise
    assert {"pendulum_length", "coulomb_friction", "quadratic_drag"} <= named
    assert diagnosis["pendulum_length"].estimate == approx(-0.0167, abs=3e-4)
    assert diagnosis["encoder_scale"].verdict != FOUND  # a spring at the joint does the same
    assert rms(diagnosis.theta) < 0.1 * rms({})


def test_a_cut_propeller_is_found_and_tape_is_not():
    folder = REAL / "crazypad_faults"
    diagnosis, named, _ = explained(
        "crazypad", folder / "cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00.csv.gz"
    )
    assert diagnosis.overall == KNOWN
    assert "motor_rl" in named
    assert diagnosis["motor_rl"].estimate == approx(-0.15, abs=0.04)
    assert set(diagnosis.theta) <= {"motor_rl", "added_rl"}
    diagnosis, named, _ = explained("crazypad", folder / "tape_on_propeller_M3__E8_log00.csv.gz")
    assert diagnosis.overall == NO_EFFECT
    assert not named


@mark.slow
def test_means_are_held_out_and_have_a_page(tmp_path, capsys):
    """Windows of one sample without a state at their start: the motor that is named predicts the
    parts that were left out.
    """
    flight = REAL / "crazypad_faults" / "cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00.csv.gz"
    code = run_command(f"diagnose explain {flight} --config crazypad --no-blind --out {tmp_path}")
    assert code == 0
    said = capsys.readouterr().out
    assert re.search(r"held-out error of motor_wanted: 0.066\d? -> 0.02\d+, [56]\d % less", said)
    assert "nan" not in said
    assert (tmp_path / "report.html").is_file()


@mark.slow
def test_cable_is_ten_millimetres_longer_and_thrust_stronger():
    flights = [REAL / "payload_cf_single" / f"log{number}.csv.gz" for number in (204, 205, 206)]
    diagnosis, named, rms = explained("cf_payload", *flights)
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
    diagnosis, named, rms = explained(
        "nanobench_cf21", REAL / "nanobench_cf21" / "B3_figure8_fast_rep1.csv.gz"
    )
    assert named & {"thrust_gain", "mass_quad"}
    assert named & {"rotor_drag_xy", "parasitic"}
    assert rms(diagnosis.theta) < 0.2 * rms({})


@mark.slow
def test_a_motor_idles_and_a_hundred_motors_are_not_one():
    table = REAL / "motor_prop_stand" / "all_tests.csv.gz"
    for pair in ("a1", "c1", "g1"):  # one motor, one propeller, two supplies
        diagnosis, named, _ = explained("motor_stand", f"{table}:{pair}_*")
        assert diagnosis.overall == UNKNOWN  # two tests, one left out in turn, confirm nothing
        assert diagnosis["idle_power"].verdict == CANDIDATE
        assert 1.0 < diagnosis["idle_power"].estimate < 5.0
    diagnosis, named, _ = explained("motor_stand", table)
    assert diagnosis.overall != NO_EFFECT
    assert "thrust_voltage" not in named


def test_the_camera_sees_the_load_nearer_the_axis():
    diagnosis, named, rms = explained(
        "slungload_camera", *sorted((DATA / "slungload_camera").glob("*.gz"))
    )
    assert "focal_scale" in named
    assert diagnosis["focal_scale"].estimate == approx(
        -0.12, abs=0.025
    )  # -0.11 in these pieces, -0.13 in the whole bags
    assert named & {"camera_tilt_x", "marker_rot_y"}
    assert named & {"camera_tilt_y", "marker_rot_x"}
    assert rms(diagnosis.theta) < 0.6 * rms({})
