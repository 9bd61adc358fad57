"""What the simulators refuse, and that the message names what came, what was expected and where."""

from dataclasses import MISSING, fields, replace

import numpy as np
from pytest import mark, raises

from sim.hybrid import HybridSim, tether_lengths
from sim.kernels.structs import EXTENSIONS, types
from sim.params import AirParams, PlantParams, ReleaseParams, RopeParams, changed
from tests.plants import paper_plant
from tests.simulators import bare_quadrotor
from visthrow import config
from visthrow.task import TaskParams


def plant_with(path: str, value) -> PlantParams:
    """The paper's plant with one field, dotted, changed."""
    return changed(paper_plant(), {path: value})


PLANTS = [
    ("vehicle.controller.min_thrust", 4.0, "less than max_thrust"),
    ("vehicle.rotors.x", (0.0, 0.0, 0.0, 0.0), "spread along x and y"),
    ("vehicle.rotors.spin", (1.0, 1.0, 1.0, -1.0), "two turning each way"),
    ("rope.segments", 0, "0 segments; expected 1 to 64"),
    ("rope.segments", 65, "65 segments; expected 1 to 64"),
    ("release.clearance_samples", 1, "clearance_samples is 1"),
    ("sim.precision", "float16", "'float16'; expected 'float32' or 'float64'"),
]
"""Bounds of single numbers are held by `tests/unit/on_visthrow/test_every_bound.py`."""


@mark.parametrize(("path", "value", "message"), PLANTS)
def test_bad_plants_are_refused(path, value, message):
    with raises(ValueError, match=message):
        HybridSim(plant_with(path, value), 1)


def test_an_unknown_integrator_of_the_quadrotor():
    with raises(ValueError, match=r"'rk5'; expected one of \('euler', 'rk4'\)"):
        bare_quadrotor(paper_plant().vehicle, integrator="rk5")


def test_wrenches_and_engines_that_do_not_fit():
    plant = paper_plant()
    with raises(ValueError, match="extension 'push'"):
        HybridSim(plant, 1).set_wrench(np.zeros((1, 3)), np.zeros((1, 3)))
    exchanged = plant_with("sim.solver", "exchanged_chain")
    with raises(ValueError, match=r"without a rope in sim\.solver 'exchanged_chain'"):
        HybridSim(exchanged, 1, without_rope="rk4")


def test_a_batch_of_no_environments():
    with raises(ValueError, match="0 environments; expected 1 or more"):
        HybridSim(paper_plant(), 0)


def test_other_kinds_of_blocks_in_one_batch():
    """A kernel is built for one choice of blocks; a vehicle of another would silently fly with the
    wrong ones.
    """
    other = plant_with("vehicle.aero.kind", "none").vehicle
    plant = paper_plant()
    with raises(ValueError, match=r"'none'.*expected the same blocks"):
        HybridSim(plant, 2, vehicles=[plant.vehicle, other])
    with raises(ValueError, match=r"'none'.*expected the same blocks"):
        bare_quadrotor(plant.vehicle, 2, vehicles=[plant.vehicle, other])


def test_every_optional_number_reaches_the_kernel():
    """A number that needs an extension and is not in its row would be ignored in silence."""
    optional = {
        f.name
        for part in (RopeParams, AirParams, ReleaseParams)
        for f in fields(part)
        if f.default is not MISSING
    }
    of_extensions = set(" ".join(EXTENSIONS.values()).split())
    in_every_kernel = {"wind_w", "kick_w", "kick_along"}
    refused = {"payload_sides", "cables_apart", "gripper_mass"}
    assert optional == of_extensions | in_every_kernel | refused
    plant = plant_with("rope.gripper_mass", 0.01)
    with raises(ValueError, match="gripper_mass"):
        HybridSim(plant, 1)


def test_ropes_of_different_segments_in_one_batch():
    plant = paper_plant()
    short = replace(plant.rope, segments=3)
    with raises(ValueError, match=r"\[3, 15\] segments in one batch of 15"):
        HybridSim(plant, 2, ropes=[plant.rope, short])


def test_no_tethers():
    z = config.load(TaskParams, config.find("task", "state")).start
    with raises(ValueError, match="tether_variants 0"):
        tether_lengths(paper_plant().rope, replace(z, tether_variants=0))


@mark.parametrize(
    ("arguments", "message"),
    [
        ({"pos_w": np.zeros((2, 3))}, r"pos_w of shape \(2, 3\); expected \(3, 3\)"),
        (
            {"pos_w": np.zeros((3, 3)), "quat_wb": np.zeros((3, 3))},
            r"quat_wb of shape \(3, 3\); expected \(3, 4\)",
        ),
        ({"pos_w": np.zeros((3, 3)), "rate_b": np.zeros(3)}, r"rate_b of shape \(3,\)"),
    ],
)
def test_shapes_of_poses(arguments, message):
    for sim in (HybridSim(paper_plant(), 3), bare_quadrotor(paper_plant().vehicle, 3)):
        with raises(ValueError, match=message):
            sim.place(**arguments)


def test_shape_of_the_cable():
    with raises(ValueError, match=r"cable_dir_w of shape \(3, 14, 3\); expected \(3, 15, 3\)"):
        HybridSim(paper_plant(), 3).place(np.zeros((3, 3)), cable_dir_w=np.zeros((3, 14, 3)))


def test_shapes_of_commands():
    """Twelve numbers are no command of three environments just because they fit."""
    sim, quad = HybridSim(paper_plant(), 3), bare_quadrotor(paper_plant().vehicle, 3)
    for target in (sim, quad):
        with raises(ValueError, match=r"command of shape \(4, 3\); expected \(3, 4\)"):
            target.set_command(np.zeros((4, 3)))
    with raises(ValueError, match=r"release of shape \(2,\); expected \(3,\)"):
        sim.set_command(np.zeros((3, 4)), np.zeros(2))
    with raises(ValueError, match=r"force_w of shape \(3,\); expected \(3, 3\)"):
        quad.set_wrench(np.zeros(3), np.zeros((3, 3)))


def test_unknown_names():
    for sim in (HybridSim(paper_plant(), 1), bare_quadrotor(paper_plant().vehicle, 1)):
        with raises(ValueError, match=r"no array 'position'; there are .*pos_w"):
            sim.get("position")
    with raises(ValueError, match="expected 'float32' or 'float64'"):
        types("double")


def test_get_is_a_copy():
    """On the CPU an array's NumPy view is live memory: what was got must not change with the next
    step.
    """
    hybrid, quad = HybridSim(paper_plant(), 2), bare_quadrotor(paper_plant().vehicle, 2)
    for sim, names in (
        (hybrid, ("pos_w", "queue", "cable_dir_w", "payload_pos_w")),
        (quad, ("pos_w", "queue")),
    ):
        sim.set_command(np.tile([12.0, 3.0, -3.0, 1.0], (2, 1)))
        got = {name: sim.get(name) for name in names}
        kept = {name: value.copy() for name, value in got.items()}
        for _ in range(3):
            sim.step()
        for name in names:
            np.testing.assert_array_equal(got[name], kept[name])
            assert np.any(sim.get(name) != kept[name]), name


def test_fields_that_fit_only_together_change_together():
    vehicle = {"motor.kind": "asymmetric", "motor.time_constant_down": 0.05}
    motor = changed(paper_plant().vehicle, vehicle).motor
    assert (motor.kind, motor.time_constant_down) == ("asymmetric", 0.05)
    short = replace(paper_plant().rope, segments=3)
    rope = changed(paper_plant(), {"rope.length": 0.5, "rope": short}).rope
    assert (rope.segments, rope.length) == (3, 0.5)
    with raises(TypeError, match="no_such"):
        changed(paper_plant(), {"rope.no_such": 1.0})
