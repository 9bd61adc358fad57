"""MuJoCo models of vehicles with other payloads than the rope and ball of
:mod:`sim.reference.model`.

A ball or a box on the rope; a box on two cables; a gripper at the end of the rope."""

import mujoco

from sim.params import BodyParams, RopeParams
from sim.reference.model import (
    add_chain,
    add_joints,
    add_pushes,
    add_vehicle,
    new_spec,
    set_inertial,
)


def compile_model(body: BodyParams, rope: RopeParams) -> "mujoco.MjModel":
    """Compile a vehicle on a free joint with the rope and payload of the rope's parameters.

    Six actuators apply force and torque to the vehicle in its frame. Three more apply a force to
    the payload at the site ``payload``, in the payload's frame.
    """
    spec = new_spec(constraints=rope.cables_apart > 0.0)
    vehicle = add_vehicle(spec, body)
    if rope.cables_apart > 0.0:
        _add_two_cables(spec, vehicle, rope)
    else:
        ball = not any(rope.payload_sides)
        last = add_chain(rope, vehicle, "universal", load=ball)
        end = [0.0, 0.0, -rope.segment_length]
        if not ball:
            box = last.add_body(name="box", pos=end)
            add_joints(box, rope.segments, "universal", rope.joint_damping)
            _set_box_inertia(box, rope, -rope.payload_offset)
        if rope.gripper_mass > 0.0:
            gripper = last.add_body(name="gripper", pos=end)
            set_inertial(gripper, rope.gripper_mass, 0.0, (GRIPPER_INERTIA,) * 3)
    add_pushes(spec, "payload", ("px", "py", "pz"))
    return spec.compile()


GRIPPER_INERTIA = 1e-8
"""Inertia of a gripper about its centre [kg m^2], so small that it is a point mass."""


def _add_two_cables(spec: "mujoco.MjSpec", vehicle: "mujoco.MjsBody", rope: RopeParams) -> None:
    """Add a box on two massless cables side by side along the vehicle's x axis. The cables are
    inextensible and may be slack.
    """
    x, y, z = rope.mount
    box = spec.worldbody.add_body(name="box", pos=[x, y, z - rope.length - rope.payload_offset])
    box.add_freejoint(name="box")
    _set_box_inertia(box, rope, 0.0)
    for name, side in (("front", 0.5), ("rear", -0.5)):
        offset = side * rope.cables_apart
        vehicle.add_site(name=f"{name}_above", pos=[x + offset, y, z])
        box.add_site(name=f"{name}_below", pos=[offset, 0.0, rope.payload_offset])
        cable = spec.add_tendon(
            name=name, limited=True, range=[0.0, rope.length], solref_limit=[0.002, 1.0]
        )
        cable.wrap_site(f"{name}_above")
        cable.wrap_site(f"{name}_below")


def _set_box_inertia(body: "mujoco.MjsBody", rope: RopeParams, centre_z: float) -> None:
    """Give a body the inertia of a homogeneous box with its centre on the z axis, and add the site
    ``payload`` at this centre.
    """
    a, b, c = (side * side for side in rope.payload_sides)
    twelfth = rope.payload_mass / 12.0
    inertia = (twelfth * (b + c), twelfth * (a + c), twelfth * (a + b))
    set_inertial(body, rope.payload_mass, centre_z, inertia)
    body.add_site(name="payload", pos=[0.0, 0.0, centre_z])
