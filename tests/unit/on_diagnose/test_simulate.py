"""``visthrow diagnose simulate``: its flights hold what the simulated world hides."""

import numpy as np
from pytest import approx

from tests.commands import run_command
from visthrow.logs.flightlog import FlightLog


def hovered(folder, hidden: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the vehicle's and the payload's measured places [m] in a hover of a world."""
    world = f"--set {hidden} --set rope.segments=1 --device cpu"
    assert run_command(f"diagnose simulate hover {world} --seed 3 --out {folder}") == 0
    channels = FlightLog.load(folder / "hover-3.npz").channels
    vehicle, payload = (channels[name].values for name in ("pos_w", "payload_pos_w"))
    return vehicle.mean(axis=0), payload.mean(axis=0)


def test_flights_hold_what_the_world_hides(tmp_path):
    """A payload hangs as far below as the rope is longer, and below the frame's origin, which
    motion capture sees, wherever the centre of mass lies.
    """
    vehicle, payload = hovered(tmp_path, "rope.length=0.33")
    plain = payload - vehicle
    vehicle, payload = hovered(tmp_path, "rope.length=0.43")
    assert payload - vehicle - plain == approx([0.0, 0.0, -0.1], abs=2e-3)
    vehicle, payload = hovered(tmp_path, "vehicle.body.com=[0.02,0.0,0.0]")
    assert payload - vehicle - plain == approx([0.0, 0.0, 0.0], abs=5e-3)


def test_a_manoeuvre_that_the_vehicle_cannot_fly_is_refused(tmp_path, capsys):
    """A gale carries the vehicle off where no payload steadies it; then no log is written."""
    gale = "--set air.wind_w=[7.7,0.0,0.0] --set rope.segments=1 --device cpu"
    flown = "hover", "hover without payload"
    assert run_command(f"diagnose simulate {gale} --out {tmp_path}", *flown) == 2
    assert "'hover without payload': this vehicle leaves its path" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.npz"))


def test_an_unknown_manoeuvre_is_refused(tmp_path, capsys):
    assert run_command(f"diagnose simulate hoover --out {tmp_path}") == 2
    assert "did you mean 'hover'" in capsys.readouterr().err
