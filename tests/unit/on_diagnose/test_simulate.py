"""``visthrow diagnose simulate``: its flights hold the simulated world's hidden effects."""

from dataclasses import replace

import numpy as np
from pytest import approx, mark, raises

from tests.commands import run_command
from visthrow.common.free_fall import GRAVITY
from visthrow.config.effects import catalogue, random_effects
from visthrow.diagnose.inputs.setup import load
from visthrow.diagnose.models.catalogue import effects_of
from visthrow.diagnose.planning import manoeuvres
from visthrow.logs.check import physics, thrust_checks
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.flightlog import FlightLog

BESIDE_THE_PLAN = {
    "IMU or rotor speeds in the log",
    "a fresh pack, an empty one, a fresh one",
    "a log of ten minutes",
    "a long hover",
    "a tape",
    "add a bar of known inertia",
    "attitude from several markers",
    "cut the rope",
    "fresh and empty pack, A-B-A",
    "gyro in the log",
    "hang the payload",
    "hang two loads",
    "hang: the geometry",
    "hover at the beginning and at the end of a pack",
    "hover at two places",
    "hover with and without a weighed load",
    "hover with the fans off",
    "hover with the payload far off the centre",
    "log battery_voltage",
    "mark the ball and film its spin",
    "none: replay with finer steps",
    "put the payload down on the target",
    "read a barometer",
    "repeat identical throws",
    "stand still before the flight",
    "throws in two directions",
    "vary distance and direction of the target",
    "weigh",
}
"""What separates effects and is no manoeuvre of a plan: work on the ground, or other equipment."""


def hover(folder, hidden: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the vehicle's and the payload's measured places [m] in a hover of a world."""
    world = f"--set {hidden} --device cpu"
    assert run_command(f"diagnose simulate hover {world} --seed 3 --out {folder}") == 0
    channels = FlightLog.load(folder / "hover-3.npz").channels
    vehicle, payload = (channels[name].values for name in ("pos_w", "payload_pos_w"))
    return vehicle.mean(0), payload.mean(0)


def test_flights_hold_what_the_world_hides(tmp_path):
    """A payload hangs as far below as the rope is longer, and below the frame's origin, which
    motion capture sees, wherever the centre of mass lies.
    """
    vehicle, payload = hover(tmp_path, "rope.length=0.33")
    plain = payload - vehicle
    vehicle, payload = hover(tmp_path, "rope.length=0.43")
    assert payload - vehicle - plain == approx([0.0, 0.0, -0.1], abs=2e-3)
    vehicle, payload = hover(tmp_path, "vehicle.body.com=[0.02,0.0,0.0]")
    assert payload - vehicle - plain == approx([0.0, 0.0, 0.0], abs=5e-3)


def test_a_thrown_payload_falls_and_stays_where_it_lands(tmp_path):
    """It used to hang in the air where it had left the rope, which no cause explains."""
    thrown = f"diagnose simulate --device cpu --out {tmp_path}"
    assert run_command(thrown, "throw at 3 m/s") == 0
    payload = FlightLog.load(tmp_path / "throw_at_3_m_s-0.npz")["payload_pos_w"]
    height = payload.values[:, 2]
    down = np.flatnonzero(height < 0.1)
    falling = slice(down[0] - 40, down[0] - 5)
    fit = np.polyfit(payload.time[falling], height[falling], 2)
    assert 2.0 * fit[0] == approx(-GRAVITY, rel=0.05)
    assert np.ptp(payload.values[down[20] :], axis=0).max() < 0.01


@mark.parametrize("speed", [2, 3])
def test_the_force_follows_the_thrust_past_a_release(tmp_path, speed):
    """The thrust of a throw falls with the mass, the force does not; the thrust of another time is
    refused all the same.
    """
    thrown = f"diagnose simulate --device cpu --out {tmp_path}"
    assert run_command(thrown, f"throw at {speed} m/s") == 0
    log = FlightLog.load(tmp_path / f"throw_at_{speed}_m_s-0.npz")
    command = log["command"]
    late = replace(command, values=np.roll(command.values, 40, axis=0))
    of_another_time = FlightLog({**log.channels, "command": late}, log.meta)
    rows, refused = (list(thrust_checks.look(each)) for each in (log, of_another_time))
    assert {row.verdict for row in rows} == {"ok"}, rows[0].text
    assert "the force follows the thrust" in rows[-1].text
    assert refused[-1].verdict == "bad"


@mark.parametrize("length", [0.33, 0.73])
def test_a_thrown_payload_says_how_long_its_cable_was(tmp_path, length):
    """Its way down and the floor are no part of the cable; a cable of another length is one."""
    thrown = f"diagnose simulate --device cpu --set rope.length={length} --out {tmp_path}"
    assert run_command(thrown, "throw at 2 m/s") == 0
    log = FlightLog.load(tmp_path / "throw_at_2_m_s-0.npz")
    rows = physics.look(log, KnownVehicle(cable_length=0.363))
    (cable,) = [row for row in rows if row.topic == "cable"]
    assert (cable.verdict == "bad") == (length == 0.73), cable.text


def test_a_manoeuvre_that_the_vehicle_cannot_fly_is_refused(tmp_path, capsys):
    """A gale carries the vehicle off where no payload steadies it; then no log is written."""
    gale = "--set air.wind_w=[7.7,0.0,0.0] --device cpu"
    flown = "hover", "hover without payload"
    assert run_command(f"diagnose simulate {gale} --out {tmp_path}", *flown) == 2
    assert "'hover without payload': this vehicle leaves its path" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.npz"))


def test_an_unknown_manoeuvre_is_refused(tmp_path, capsys):
    assert run_command(f"diagnose simulate hoover --out {tmp_path}") == 2
    assert "did you mean 'hover'" in capsys.readouterr().err


def test_the_help_lists_what_can_be_flown(capsys):
    with raises(SystemExit):
        run_command("diagnose simulate --help")
    _, _, listed = capsys.readouterr().out.partition("manoeuvres: ")
    names = [name.strip(" '") for name in listed.partition("\n\n")[0].replace("\n", "").split(",")]
    assert names == [manoeuvre.name for manoeuvre in manoeuvres.catalogue()]


def test_effects_name_manoeuvres_as_the_plan_does():
    """``plan --manoeuvres`` and ``simulate`` accept a report's "rate doublets"."""
    flyer = load("nanobench_cf21").flyer
    effects = [*catalogue().values(), *random_effects(), *effects_of("flyer", flyer)]
    named = {manoeuvre for effect in effects for manoeuvre in effect.manoeuvres}
    flown = {manoeuvre.name for manoeuvre in manoeuvres.catalogue()}
    assert named - flown == BESIDE_THE_PLAN
    assert len(named & flown) > 10
