"""The bridge to a firmware, without one: packets, its command line, what is read of its
channels.
"""

import socket

from pytest import fixture, raises

from bench.processes import free_port
from hil.errors import RunError
from hil.rehearsal.bridges import betaflight_firmware as firmware
from hil.rehearsal.bridges import packets
from hil.rehearsal.bridges.betaflight_firmware import Firmware, list_settings
from tests.configs import load_run


@fixture
def params():
    return load_run("betaflight_sitl").betaflight


def test_samples_are_forward_right_down_and_the_force_turned_round():
    """The firmware's own wrapper: rates FRD, acceleration the negative of FLU, attitude w first."""
    values = packets.FDM.unpack(
        packets.sample(1.0, (0.1, 0.2, 0.3), (1.0, 2.0, 9.8), (0.0, 0.1, 0.2, 0.9))
    )
    assert values[1:4] == (0.1, -0.2, -0.3)
    assert values[4:7] == (-1.0, -2.0, -9.8)
    assert values[7:11] == (0.9, 0.0, 0.1, 0.2)
    assert len(values) == 18


def test_a_missing_program_is_named(tmp_path):
    with raises(RunError, match=r"no firmware at .*nothing"):
        Firmware(tmp_path / "nothing", tmp_path)


def test_a_program_that_ends_at_once_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(
        firmware, "PORTS", (free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM))
    )
    with raises(RunError, match="does not listen"):
        Firmware("/bin/false", tmp_path).start()


def test_settings_follow_the_runs_configuration(params):
    settings = list_settings(params)
    assert settings["roll_srate"] == "60"
    assert settings["yaw_srate"] == "30"
    assert settings["aux 0"] == "0 0 1700 2100 0 0"
    assert "aux 1" not in settings
    override = load_run("betaflight_sitl", ["betaflight.arm_channel=0"]).betaflight
    assert list_settings(override)["msp_override_channels_mask"] == "143"  # sticks and AUX 4
    assert list_settings(override)["aux 1"].startswith("50 ")
