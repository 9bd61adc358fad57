"""The start of an episode: every range and distribution of the paper's randomisation, recovered
from the states.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.testing import assert_allclose
from pytest import mark
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from sim.hybrid import HybridSim, tether_lengths
from tests.plants import paper_plant
from visthrow.task import load_experiment

COUNT = 6000
SIGNIFICANCE = 1e-4
"""Of a Kolmogorov-Smirnov test; the seed is fixed, so the outcome is too."""
EDGE = 1e-5
"""Round-off of float32 at a bound."""


@lru_cache
def spreads():
    """The paper's, as the tasks load them."""
    return load_experiment("state").task.start


@lru_cache
def started(**changes: float) -> HybridSim:
    plant, start = paper_plant(), replace(spreads(), **changes)
    sim = HybridSim(plant, COUNT, seed=5, ropes=tether_lengths(plant.rope, start))
    sim.randomize(start)
    return sim


def assert_uniform(values: np.ndarray, low: float, high: float) -> None:
    """Within the bounds, close to both, and uniform between them."""
    span = high - low
    assert values.min() >= low - EDGE * span
    assert values.max() <= high + EDGE * span
    assert np.ptp(values) > 0.99 * span
    assert kstest((values - low) / span, "uniform").pvalue > SIGNIFICANCE


def test_the_file_holds_the_numbers_of_the_paper():
    """Sec. III-C, [m], [m/s], [deg], [deg/s]; six cables over 6 %."""
    z = spreads()
    assert z.position == z.velocity == (0.5, 0.5, 0.3)
    assert (z.attitude_deg, z.rate_deg) == ((20.0,) * 3, (30.0,) * 3)
    assert (z.mass, z.tether_variants, z.tether_spread) == (0.05, 6, 0.06)
    assert (z.cable_angle_deg, z.cable_rate_deg, z.goal_radius) == (15.0, 15.0, 2.0)


@mark.parametrize("axis", range(3))
def test_position_velocity_and_rates(axis):
    sim, z = started(), spreads()
    home = np.array([0.0, 0.0, z.spawn_height])[axis]
    assert_uniform(
        sim.get("pos_w")[:, axis].astype(float) - home, -z.position[axis], z.position[axis]
    )
    assert_uniform(sim.get("vel_w")[:, axis].astype(float), -z.velocity[axis], z.velocity[axis])
    assert_uniform(
        np.degrees(sim.get("rate_b")[:, axis].astype(float)), -z.rate_deg[axis], z.rate_deg[axis]
    )


def test_attitude():
    """Roll, pitch and yaw of the rotation Rz(yaw) Ry(pitch) Rx(roll)."""
    quat = started().get("quat_wb").astype(float)
    assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-6)
    angles = Rotation.from_quat(quat).as_euler("ZYX", degrees=True).T
    for angle, bound in zip(reversed(angles), spreads().attitude_deg):
        assert_uniform(angle, -bound, bound)


def cable_angles(**changes: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return azimuth and tilt [rad] of the cable in the body frame, its direction, and its velocity
    [1/s] beyond the body's turn there.
    """
    sim = started(**changes)
    back = Rotation.from_quat(sim.get("quat_wb")).inv()
    down = back.apply(sim.get("cable_dir_w")[:, 0])
    swing = back.apply(sim.get("cable_vel_w")[:, 0]) - np.cross(sim.get("rate_b"), down)
    azimuth = np.arctan2(-down[:, 0], down[:, 1])
    azimuth = np.where(np.cos(azimuth) < 0.0, azimuth + np.pi, azimuth)
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    tilt = np.arctan2(-down[:, 0] * np.sin(azimuth) + down[:, 1] * np.cos(azimuth), -down[:, 2])
    return azimuth, tilt, down, swing


def test_cable_hangs_yawed_then_rolled():
    """``Rz(azimuth) Rx(tilt) (0, 0, -1)``; an azimuth can be read off where there is a tilt."""
    azimuth, tilt, down, _ = cable_angles()
    bound = spreads().cable_angle_deg
    rebuilt = np.stack(
        (-np.sin(azimuth) * np.sin(tilt), np.cos(azimuth) * np.sin(tilt), -np.cos(tilt)), -1
    )
    assert_allclose(rebuilt, down, atol=1e-6)
    assert_uniform(np.degrees(tilt), -bound, bound)
    assert_uniform(np.degrees(azimuth[np.abs(tilt) > 0.01]), -bound, bound)


def test_a_cable_of_any_yaw_swings_fore_and_aft_as_far_as_sideways():
    down = cable_angles(cable_yaw_deg=180.0)[2]
    fore, side = np.abs(down[:, :2]).mean(0)
    assert_allclose(fore, side, rtol=0.1)
    narrow = np.abs(cable_angles()[2][:, :2]).mean(0)
    assert narrow[0] < 0.2 * narrow[1]


def test_cable_rates_come_on_top_of_the_bodys():
    azimuth, tilt, down, swing = cable_angles()
    bound = spreads().cable_rate_deg
    by_azimuth = np.cross([0.0, 0.0, 1.0], down)
    axis = np.stack((np.cos(azimuth), np.sin(azimuth), np.zeros(COUNT)), -1)
    by_tilt = np.cross(axis, down)
    tilt_rate = np.sum(swing * by_tilt, -1)  # unit vectors, perpendicular to each other's
    assert_uniform(np.degrees(tilt_rate), -bound, bound)
    tilted = np.abs(tilt) > 0.05
    azimuth_rate = np.sum(swing * by_azimuth, -1) / np.maximum(np.sum(by_azimuth**2, -1), 1e-12)
    assert_uniform(np.degrees(azimuth_rate[tilted]), -bound, bound)


def test_every_segment_starts_alike():
    sim = started()
    assert np.all(sim.get("cable_dir_w") == sim.get("cable_dir_w")[:, :1])
    assert np.all(sim.get("cable_vel_w") == sim.get("cable_vel_w")[:, :1])


def test_mass_and_battery():
    sim, z = started(), spreads()
    assert_uniform(sim.get("mass_scale").astype(float), 1.0 - z.mass, 1.0 + z.mass)
    assert_uniform(sim.get("charge_used").astype(float), 0.0, z.battery_used)


def test_goals_fill_the_disk_evenly():
    """Uniform on a disk: the squared radius and the angle are uniform and independent."""
    goal = started().goal_w.numpy().astype(float)
    radius, angle = np.hypot(goal[:, 0], goal[:, 1]), np.arctan2(goal[:, 1], goal[:, 0])
    assert_uniform(radius**2, 0.0, spreads().goal_radius ** 2)
    assert_uniform(angle, -np.pi, np.pi)
    assert abs(np.corrcoef(radius, np.cos(angle))[0, 1]) < 0.05
    assert np.all(goal[:, 2] == 0.0)


def test_draws_are_independent():
    sim = started()
    columns = np.column_stack(
        [
            sim.get(k).reshape(COUNT, -1)[:, :3]
            for k in ("pos_w", "vel_w", "rate_b", "mass_scale", "charge_used")
        ]
        + [sim.goal_w.numpy()[:, :2]]
    )
    apart = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(apart).max() < 5.0 / np.sqrt(COUNT)


def test_every_reset_draws_anew():
    plant = paper_plant()
    sim = HybridSim(plant, 4, seed=1)
    positions = []
    for _ in range(5):
        sim.randomize(spreads())
        positions.append(sim.get("pos_w"))
    assert len(np.unique(np.array(positions)[..., 0])) == 20
