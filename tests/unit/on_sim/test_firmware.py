"""Betaflight's settings as numbers of the rate controller's block."""

import math
from dataclasses import replace

from pytest import approx, raises

from sim.effects.firmware import calibrated_voltage, controller_of, missing_features
from tests.plants import paper_plant

SETTINGS = {
    "rollPID": "11,20,8",
    "pitchPID": "22,20,8",
    "yawPID": "45,80,0",
    "ff_weight": "0,0,0",
    "iterm_relax_cutoff": "15",
    "motor_idle": "550",
    "pidsum_limit": "500",
    "iterm_windup": "80",
    "gyro_lpf1_static_hz": "250",
    "gyro_lpf2_static_hz": "500",
    "dterm_lpf2_static_hz": "150",
    "d_max": "8,8,0",
}


def test_a_gain_is_the_torque_that_the_motors_make_of_it():
    """1 deg/s of error, by hand:

    P 11 puts 0.352319 of 1000 on each motor, beyond idle; two rise and two fall.
    """
    vehicle = paper_plant().vehicle
    c = controller_of(vehicle, SETTINGS, 0.66, vehicle.battery.reference_voltage)
    hover, step = math.sqrt(0.66 / 3.5), 0.352319e-3 * 0.945
    rise = 3.5 * ((hover + step) ** 2 - (hover - step) ** 2)
    assert c.p_gain[0] * math.radians(1.0) == approx(2.0 * rise * vehicle.rotors.y[0], rel=1e-6)
    assert c.p_gain[1] == approx(2.0 * c.p_gain[0], rel=1e-12)
    assert c.p_gain[2] * math.radians(1.0) == approx(
        2.0 * 45.0 / 11.0 * rise * vehicle.thrust.torque_ratio, rel=1e-6
    )
    # pid_init.c: an I of 1 is 0.244381 of 1000 a degree, about yaw 2.5 times that; P of 1 is
    # 0.032029 a degree a second.
    assert c.i_gain[0] / c.p_gain[0] == approx(0.244381 * 20 / (0.032029 * 11))
    assert c.i_gain[2] / c.p_gain[2] == approx(2.5 * 0.244381 * 80 / (0.032029 * 45))
    assert c.gyro_time_constant == approx((1 / 250 + 1 / 500 + 1 / 150) / (2 * math.pi))
    assert c.min_thrust == approx(3.5 * 0.055**2)
    assert c.gyro_share == approx([(1 / 250 + 1 / 500) / (1 / 250 + 1 / 500 + 1 / 150)] * 3)
    c = controller_of(vehicle, SETTINGS | {"yaw_lowpass_hz": "300"}, 0.66, 11.1)
    both = 1 / 250 + 1 / 500 + 1 / 300
    assert c.gyro_share[2] == approx(both / (1 / 250 + 1 / 500 + 1 / 150))


def test_the_voltage_of_a_hover():
    vehicle = paper_plant().vehicle
    voltage = calibrated_voltage(vehicle, SETTINGS, 0.66, 0.36)
    thrust = 3.5 * ((0.055 + 0.945 * 0.36) * voltage / vehicle.battery.reference_voltage) ** 2
    assert thrust == approx(0.66)


def test_what_the_block_has_no_number_for_is_reported():
    missing = missing_features(SETTINGS | {"tpa_rate": "65", "d_max": "10,12,0"})
    assert [text.split()[0] for text in missing] == ["tpa_rate", "d_max"]
    assert missing_features(SETTINGS | {"d_max": "0,0,0"}) == []


def test_settings_that_are_missing_are_named():
    with raises(ValueError, match="iterm_relax_cutoff"):
        controller_of(paper_plant().vehicle, {"rollPID": "1,2,3"}, 0.66, 15.0)


def test_the_switch_keeps_the_hover():
    """The block that mixes motor commands has the gains of the one that mixes thrusts, at the
    thrust of the hover.
    """
    from sim.effects.blocks import SWITCHES
    from sim.effects.setting import Setting

    plant = paper_plant()
    switched = SWITCHES["motor mixing"](Setting(plant)).plant.vehicle.controller
    assert switched.p_gain == plant.vehicle.controller.p_gain
    assert switched.mix_thrust == approx(plant.total_mass * 9.81 / 4)
    assert replace(switched, kind="betaflight").max_thrust == plant.vehicle.controller.max_thrust
