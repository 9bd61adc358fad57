"""MuJoCo models of quadrotor, rope and payload, built with ``MjSpec``.

Body frames: a rod's frame has its origin at the rod's upper end. Its z axis is opposite to the
rod's direction, so that all relative rotations of a level quadrotor with a hanging rope are the
identity.

Joints:

- ``universal``: two perpendicular hinges for each segment, first about the frame's y axis, then
  about its x axis. The first has no limit, so that a rope may fold back on itself in the pitch
  plane, the plane of throws. The pair is singular only if the second is at +-90 deg, that is if a
  segment points along +-y of its parent.
- ``ball``: a ball joint for each segment, without singularity. Axial spin is an additional
  coordinate that no force drives.

The damping of a universal joint acts on its relative rate, which is in the plane of its two axes.
Ball joints have no damping here: ``sim.reference.rope`` applies it as a couple."""

from typing import Literal

import mujoco

from sim.params import GRAVITY, BodyParams, RopeParams

# inertia of a rod about its axis [kg m^2]: negligible, because universal joints transmit twist
AXIAL_INERTIA = 1e-12


def set_inertial(
    body: "mujoco.MjsBody", mass: float, centre_z: float, inertia: tuple[float, float, float]
) -> None:
    """Give a body its mass [kg], centre [m] and inertia [kg m^2]."""
    body.mass = mass
    body.ipos = [0.0, 0.0, centre_z]
    body.inertia = list(inertia)
    body.explicitinertial = True


def add_joints(body: "mujoco.MjsBody", index: int, joints: str, damping: float) -> None:
    """Connect a body to the body above by the joints of rod ``index``."""
    if joints == "ball":
        body.add_joint(name=f"ball{index}", type=mujoco.mjtJoint.mjJNT_BALL)
        return
    for name, axis in (("y", [0, 1, 0]), ("x", [1, 0, 0])):
        joint = body.add_joint(name=f"{name}{index}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        joint.damping[0] = damping


def new_spec(constraints: bool = False) -> "mujoco.MjSpec":
    """Return an empty model without contacts, and by default without other constraints."""
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if not constraints:
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return spec


def add_vehicle(spec: "mujoco.MjSpec", body: BodyParams) -> "mujoco.MjsBody":
    """Add the quadrotor on a free joint, with actuators for force and torque in its body frame."""
    vehicle = spec.worldbody.add_body(name="vehicle")
    vehicle.add_freejoint(name="root")
    set_inertial(vehicle, body.mass, 0.0, body.inertia)
    vehicle.add_site(name="centre")
    # Actuators on a site rotate with the body in every stage of RK4; an applied force would be
    # constant in the world frame over the step.
    add_pushes(spec, "centre", ("fx", "fy", "fz", "tx", "ty", "tz"))
    return vehicle


def add_pushes(spec: "mujoco.MjSpec", site: str, names: tuple[str, ...]) -> None:
    """Add actuators for force components, then torque components, in a site's frame."""
    for i, name in enumerate(names):
        gear = [0.0] * 6
        gear[i] = 1.0
        spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_SITE, target=site, gear=gear)


def build_attached(
    body: BodyParams,
    rope: RopeParams,
    joints: Literal["universal", "ball"] = "universal",
    stretch: tuple[float, float] | None = None,
) -> "mujoco.MjModel":
    """Build the quadrotor with its rope.

    Args:
        body: mass and inertia of the quadrotor.
        rope: masses and lengths.
        joints: kind of the rope's joints.
        stretch: stiffness [N/m] and damping [N s/m] of a slide joint along the rope between last
            segment and payload.

    Returns:
        Compiled model with the bodies ``vehicle``, ``rod0``, ... and, with ``stretch``,
        ``payload``.
    """
    spec = new_spec()
    add_chain(rope, add_vehicle(spec, body), joints, stretch)
    return spec.compile()


def build_free(rope: RopeParams, stretch: tuple[float, float] | None = None) -> "mujoco.MjModel":
    """Build rope and payload without a vehicle: the first rod on a free joint, then ball joints."""
    spec = new_spec()
    add_chain(rope, spec.worldbody, "ball", stretch=stretch, free_root=True)
    return spec.compile()


def add_chain(
    rope: RopeParams,
    parent: "mujoco.MjsBody",
    joints: str,
    stretch: tuple[float, float] | None = None,
    free_root: bool = False,
    load: bool = True,
) -> "mujoco.MjsBody":
    """Add rods at the mount of a body, or with ``free_root`` at the world's origin; the last one
    includes the payload if ``load`` is true. Returns the last body.

    See :func:`build_attached`.
    """
    anchor = [0.0, 0.0, 0.0] if free_root else list(rope.mount)
    for i in range(rope.segments):
        rod = parent.add_body(name=f"rod{i}", pos=anchor)
        mass, centre, transverse = rope.rod(i == rope.segments - 1 and load and stretch is None)
        # Ball joints without twist do not depend on the axial inertia; this value keeps the mass
        # matrix well conditioned.
        axial = transverse if joints == "ball" else AXIAL_INERTIA
        set_inertial(rod, mass, -centre, (transverse, transverse, axial))
        if i == 0 and free_root:
            rod.add_freejoint(name="root")
        else:
            add_joints(rod, i, joints, rope.joint_damping)
        parent = rod
        anchor = [0.0, 0.0, -rope.segment_length]
    below = [0.0, 0.0, -rope.segment_length - rope.payload_offset]
    if stretch is not None:
        payload = parent.add_body(name="payload", pos=below)
        set_inertial(payload, rope.payload_mass, 0.0, (rope.payload_inertia,) * 3)
        slide = payload.add_joint(name="stretch", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, -1])
        slide.stiffness[0], slide.damping[0] = stretch
        return payload
    if load:
        parent.add_site(name="payload", pos=below)
    return parent
