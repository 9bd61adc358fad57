"""Traps made of real flights: the fault is named, with the right reason, and good flights stay free
of it; a channel that is empty or in another unit is refused before anything is named.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from pytest import approx, mark, raises

from bench.diagnose.altered import change_channels
from tests.flightlogs import with_channels
from tests.places import DATA
from tests.unit.on_logs.test_check import faults
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.check.run import check, contradictions
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.readers import table_to_log

REAL = DATA / "real"
FLIGHTS = (204, 205, 206)
"""Flights along x, along y, and in place."""


@cache
def record(number: int) -> FlightLog:
    return setups.read_logs([REAL / "payload_cf_single" / f"log{number}.csv.gz"], "cf_payload")[0]


CRAZYFLIE = setups.describe_vehicle("cf_payload")
PATHS = ("pos_w", "vel_w", "payload_pos_w", "payload_vel_w", "est_pos_w")
LATE = 0.1


def change_values(log: FlightLog, names, change) -> FlightLog:
    return change_channels(log, dict.fromkeys(names, change))


def shift(log: FlightLog, *names: str, by: float = LATE) -> FlightLog:
    return with_channels(log, **{n: replace(log[n], time=log[n].time + by) for n in names})


def bad(log: FlightLog, known: KnownVehicle = CRAZYFLIE) -> str:
    return faults(log, vehicle=known)


@mark.parametrize("number", FLIGHTS)
def test_flights_as_they_are(number):
    assert bad(record(number)) == ""


@mark.parametrize("number", [204, 205])
def test_exchanged_axes_are_named_with_their_evidence(number):
    text = bad(change_values(record(number), PATHS, lambda v: v[:, [1, 0, 2]]))
    assert "fit with (y,x,z) of positions and velocities" in text
    assert float(text.split(" nats better")[0].split()[-1]) > 15.0
    assert "a mirror image" in text


def test_an_exchanged_accelerometer_is_named():
    assert "acc_b fits as (y,x,z)" in bad(
        change_values(record(204), ["acc_b"], lambda v: v[:, [1, 0, 2]])
    )


@mark.parametrize(
    ("streams", "row"),
    [
        (("quat_wb", "rate_b", "acc_b", "thrust_command"), "d(vel_w)/dt, quat_wb acc_b"),
        (("rate_b", "acc_b"), "rate of quat_wb, rate_b"),
        (("payload_pos_w",), "pos_w, payload_pos_w"),
    ],
)
def test_late_streams_are_named_with_their_offset(streams, row):
    (checked,) = check([shift(record(204), *streams)], CRAZYFLIE)
    (delay,) = [r for r in checked.rows if (r.topic, r.channel, r.verdict) == ("delay", row, "bad")]
    assert delay.figures["delay_s"] == approx(LATE, abs=0.02)
    assert contradictions([checked])


def test_thrust_of_another_flight_is_refused():
    text = bad(with_channels(record(205), thrust_command=record(204)["thrust_command"]))
    assert "the force does not follow the thrust" in text
    assert "thrust of another flight" in text


def test_early_thrust_is_named():
    assert "the stream of the thrust is about" in bad(
        shift(record(206), "thrust_command", by=-LATE)
    )


@mark.parametrize(
    ("names", "factor", "words"),
    [
        (("thrust_command",), 101.97, "times the model's 0.0419 kg: in g of thrust"),
        (
            ("rate_b",),
            57.3,
            "rate of quat_wb, rate_b: the second is 57.* times the first: one is in degrees",
        ),
        (("acc_b",), 1 / 9.80665, "not 9.81: one is in g, or in tenths, as mm taken for cm"),
        (PATHS, 1000.0, "millimetres taken for metres"),
    ],
)
def test_units_are_named_by_their_ratio(names, factor, words):
    text = bad(change_values(record(204), names, lambda v: v * factor))
    assert all(part in text for part in words.split(".*")), text


@mark.parametrize(
    ("mass", "words"),
    [(41.9, "the model's mass is in g"), (5.0, "no battery's charge does that"), (0.05, "")],
)
def test_a_mass_that_no_battery_explains_is_another_unit(mass, words):
    text = bad(record(204), replace(CRAZYFLIE, mass=mass))
    assert words in text
    assert bool(text) == bool(words)


def test_the_cable_is_held_against_the_models():
    assert "apart by +70.8 % of the model's cable of 0.3 m: another cable" in bad(
        record(204), KnownVehicle(cable_length=0.3)
    )


def test_a_scale_of_thrust_that_differs_from_flight_to_flight():
    logs = [
        *map(record, FLIGHTS),
        change_values(record(205), ["thrust_command"], lambda v: 1.3 * v),
    ]
    texts = [row.text for row in check(logs, CRAZYFLIE)[3].rows if row.verdict == "warn"]
    assert any("the thrust's scale differs from flight to flight" in text for text in texts)


@mark.parametrize(
    ("names", "factor", "words"),
    [
        (
            [f"stateEstimateZ.p{axis}" for axis in "xyz"],
            np.nan,
            "missing everywhere: payload_pos_w",
        ),
        (["ctrlLee.thrustSI"], 1e3, "times the weight"),
    ],
)
def test_spoiled_channels_are_refused(names, factor, words):
    chosen = setups.load("cf_payload")
    columns = table_to_log.read_table(REAL / "payload_cf_single" / "log206.csv.gz")
    spoiled = {name: factor * columns[name] for name in names}
    logs = [
        table_to_log.logs_of(one, chosen.table, "log206") for one in (columns, columns | spoiled)
    ]
    assert setups.model_of(chosen, logs[0]).stretches  # as it is, it can be looked at
    with raises(LogError, match=words):
        setups.model_of(chosen, logs[1])
