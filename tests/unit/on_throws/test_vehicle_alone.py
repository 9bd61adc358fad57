"""The vehicle without a rope."""

from numpy.linalg import norm

from tests.commands import run_command
from visthrow.logs.flightlog import FlightLog


def test_the_vehicle_alone_flies_to_its_point_by_either_integrator(tmp_path):
    ends = {}
    for name in ("rk4", "euler"):
        command = f"fly --no-rope {name} --target 1 0.5 --policy state --device cpu"
        assert run_command(f"{command} --out {tmp_path}/{name}") == 0
        log = FlightLog.load(tmp_path / name / "flight.npz")
        assert "payload_pos_w" not in log
        ends[name] = log["pos_w"].values
        assert norm(ends[name][-1, :2] - (1.0, 0.5)) < 0.03
    apart = norm(ends["rk4"] - ends["euler"], axis=1)
    assert 0.0 < apart.max() < 0.02


def test_it_takes_no_option_of_a_throw(tmp_path, refused):
    refused(f"fly --no-rope --save {tmp_path}/a.npz --out {tmp_path}", message="--no-rope")
