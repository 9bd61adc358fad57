"""``visthrow diagnose simulate``: its flights hold what the simulated world hides."""

from pytest import approx

from tests.commands import run_command
from tests.unit.on_diagnose.test_explain import explained
from visthrow import cli
from visthrow.logs.flightlog import FlightLog

WORLD = ("--set", "rope.segments=1", "--device", "cpu")


def test_the_diagnosis_finds_what_a_simulated_world_hides(tmp_path):
    """A centre of mass 3 mm forward, found in a hover and a swing."""
    hidden = ("--set", "vehicle.body.com=[0.003, 0.0, 0.0]")
    names = ("hover", "swing and decay")
    simulated = tmp_path / "simulated"
    command = ["diagnose", "simulate", *names, *WORLD, *hidden, "--seed", "3"]
    assert cli.main([*command, "--out", str(simulated)]) == 0
    logs = [FlightLog.load(simulated / f"{n}-3.npz") for n in ("hover", "swing_and_decay")]
    _, found = explained(logs, tmp_path)
    assert found["theta"] == {"com_x": approx(3e-3, abs=3e-4)}


def test_a_manoeuvre_that_the_vehicle_cannot_fly_is_refused(tmp_path, capsys):
    """A storm carries the vehicle off."""
    storm = "--set air.wind_w=[30.0,0.0,0.0] --set rope.segments=1 --device cpu"
    assert run_command(f"diagnose simulate hover {storm} --out {tmp_path}") == 2
    assert "manoeuvre 'hover': this vehicle leaves its path" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.npz"))


def test_an_unknown_manoeuvre_is_refused(tmp_path, capsys):
    assert run_command(f"diagnose simulate hoover --out {tmp_path}") == 2
    assert "did you mean 'hover'" in capsys.readouterr().err
