"""Refused inputs of the simulators; the message names what came, what was expected and where."""

from dataclasses import MISSING, fields, replace

import numpy as np
from pytest import mark, raises

from sim.hybrid import HybridSim, tether_lengths
from sim.kernels.structs import EXTENSIONS, types
from sim.params import AirParams, PlantParams, ReleaseParams, RopeParams, change_values
from tests.plants import paper_plant
from tests.simulators import bare_quadrotor
from visthrow.task import load_experiment


def change_plant(path: str, value) -> PlantParams:
    """The paper's plant with one field, dotted, changed."""
    return change_values(paper_plant(), {path: value})


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
        HybridSim(change_plant(path, value), 1)


PLANT = paper_plant()
EXCHANGED = change_plant("sim.solver", "exchanged_chain")
AERO_LESS = [PLANT.vehicle, change_plant("vehicle.aero.kind", "none").vehicle]
SHORT = replace(PLANT.rope, segments=3)
THREE = np.zeros((3, 3))
REFUSED = {
    "integrator": (
        lambda: bare_quadrotor(PLANT.vehicle, integrator="rk5"),
        r"'rk5'; expected one of \('euler', 'rk4'\)",
    ),
    "push": (lambda: HybridSim(PLANT, 1).set_wrench(THREE[:1], THREE[:1]), "extension 'push'"),
    "engine": (
        lambda: HybridSim(EXCHANGED, 1, without_rope="rk4"),
        r"without a rope in sim\.solver 'exchanged_chain'",
    ),
    "count": (lambda: HybridSim(PLANT, 0), "0 environments; expected 1 or more"),
    "blocks": (
        lambda: HybridSim(PLANT, 2, vehicles=AERO_LESS),
        r"'none'.*expected the same blocks",
    ),
    "blocks without a rope": (
        lambda: bare_quadrotor(PLANT.vehicle, 2, vehicles=AERO_LESS),
        r"'none'.*expected the same blocks",
    ),
    "segments": (
        lambda: HybridSim(PLANT, 2, ropes=[PLANT.rope, SHORT]),
        r"\[3, 15\] segments in one batch of 15",
    ),
    "cable": (
        lambda: HybridSim(PLANT, 3).place(THREE, cable_dir_w=np.zeros((3, 14, 3))),
        r"cable_dir_w of shape \(3, 14, 3\); expected \(3, 15, 3\)",
    ),
    "release": (
        lambda: HybridSim(PLANT, 3).set_command(np.zeros((3, 4)), np.zeros(2)),
        r"release of shape \(2,\); expected \(3,\)",
    ),
    "wrench": (
        lambda: bare_quadrotor(PLANT.vehicle, 3).set_wrench(np.zeros(3), THREE),
        r"force_w of shape \(3,\); expected \(3, 3\)",
    ),
    "precision": (lambda: types("double"), "expected 'float32' or 'float64'"),
}
"""The message of a refused call."""


@mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused(name):
    call, message = REFUSED[name]
    with raises(ValueError, match=message):
        call()


def test_no_tethers():
    z = load_experiment("state").task.start
    with raises(ValueError, match="tether_variants 0"):
        tether_lengths(paper_plant().rope, replace(z, tether_variants=0))


@mark.parametrize(
    ("call", "message"),
    [
        (lambda sim: sim.place(np.zeros((2, 3))), r"pos_w of shape \(2, 3\); expected \(3, 3\)"),
        (lambda sim: sim.place(THREE, THREE), r"quat_wb of shape \(3, 3\); expected \(3, 4\)"),
        (lambda sim: sim.place(THREE, rate_b=np.zeros(3)), r"rate_b of shape \(3,\)"),
        (
            lambda sim: sim.set_command(np.zeros((4, 3))),  # twelve numbers, but not of three
            r"command of shape \(4, 3\); expected \(3, 4\)",
        ),
        (lambda sim: sim.get("position"), r"no array 'position'; there are .*pos_w"),
    ],
)
def test_shapes_and_names_are_reported_with_a_rope_and_without(call, message):
    for sim in (HybridSim(PLANT, 3), bare_quadrotor(PLANT.vehicle, 3)):
        with raises(ValueError, match=message):
            call(sim)


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
    plant = change_plant("rope.gripper_mass", 0.01)
    with raises(ValueError, match="gripper_mass"):
        HybridSim(plant, 1)


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
    motor = change_values(paper_plant().vehicle, vehicle).motor
    assert (motor.kind, motor.time_constant_down) == ("asymmetric", 0.05)
    short = replace(paper_plant().rope, segments=3)
    rope = change_values(paper_plant(), {"rope.length": 0.5, "rope": short}).rope
    assert (rope.segments, rope.length) == (3, 0.5)
    with raises(TypeError, match="no_such"):
        change_values(paper_plant(), {"rope.no_such": 1.0})
