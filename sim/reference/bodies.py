"""MuJoCo's bodies behind the seam (:class:`sim.seam.Bodies`): the rope with a ball, a box on the
rope, a box on two cables.

MuJoCo C, batched by ``mujoco.batch``; integrator RK4. Other payloads are other models: a
``vehicle`` on a free joint with the six actuators of :mod:`sim.reference.model`, and a site
``payload``.

MuJoCo Warp 4.0 takes the same models and ends the hard throw where C does (RK4, 0.5 ms: 0.14 mm of
the ball and 0.19 mm of the vehicle from the fused chain); on a CPU core it compiles for 80 s and
makes 26 steps a second (`tests/oracle/test_seam.py`, slow)."""

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from sim.params import BodyParams, RopeParams
from sim.reference.model import add_chain, add_vehicle, new_spec
from sim.reference.state import Root

ROPE_STEP = 5e-4
"""Step at which the hard throw has converged [s]: half of it moves nothing by a micrometre; at 1 ms
RK4 is 34 mm off, at 2 ms unstable.
"""

CABLE_STEP = 2.5e-4
"""Step of boxes on cables that may go slack [s]: the limits of their lengths are stiff springs."""


class MujocoBodies:
    """E copies of a model.

    Args:
        model: With a body ``vehicle`` on a free joint and a site ``payload``.
        count: E.
        step: Integration step [s].
    """

    def __init__(self, model: "mujoco.MjModel", count: int = 1, step: float = ROPE_STEP) -> None:
        model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_RK4
        self.model, self.count, self.step = model, count, step
        self.total_mass = float(model.body_mass.sum())
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "payload")
        self._batch = Batch(model, count, nthread=1)
        self._sites = self._batch.bind("site_xpos")
        self.tendon_length = (
            self._batch.bind("ten_length") if model.ntendon else np.zeros((count, 0))
        )
        self._batch.forward()

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Set MuJoCo's own coordinates, shapes (E, nq) and (E, nv), or of one for all."""
        self._batch.qpos[:], self._batch.qvel[:] = qpos, qvel
        self._batch.forward()

    def root(self) -> Root:
        q, v = self._batch.qpos, self._batch.qvel
        return Root(
            q[:, :3].copy(), np.roll(q[:, 3:7], -1, axis=1), v[:, :3].copy(), v[:, 3:6].copy()
        )

    def payload_w(self) -> np.ndarray:
        return np.array(self._sites).reshape(self.count, -1, 3)[:, self._site]

    def advance(self, force_b: np.ndarray, torque_b: np.ndarray, duration: float) -> None:
        """See `Bodies`. Raises ValueError: a duration that is no whole number of steps."""
        steps = round(duration / self.step)
        if abs(steps * self.step - duration) > 1e-9:
            raise ValueError(f"{duration} s is no whole number of steps of {self.step} s")
        self._batch.ctrl[:, :3], self._batch.ctrl[:, 3:6] = force_b, torque_b
        self._batch.step(nstep=steps, stage=int(mujoco.mjtStage.mjSTAGE_POS))


def rope_and_ball(body: BodyParams, rope: RopeParams) -> "mujoco.MjModel":
    """The batched simulator's own payload: a chain of rods with a ball at its end."""
    spec = new_spec()
    add_chain(
        spec,
        rope,
        add_vehicle(spec, body),
        list(rope.mount),
        "universal",
        0.0,
        None,
        free_root=False,
    )
    return spec.compile()


def rope_and_box(body: BodyParams, rope: RopeParams, sides: Sequence[float]) -> "mujoco.MjModel":
    """A box at the end of the chain, which swings about its upper face by a universal joint.

    Args:
        body: Mass and inertia of the vehicle.
        rope: Masses and lengths; the payload's mass is the box's, its inertia and offset follow
            from the sides.
        sides: Of the box, homogeneous [m], shape (3,).
    """
    spec = new_spec()
    last = add_chain(
        spec,
        rope,
        add_vehicle(spec, body),
        list(rope.mount),
        "universal",
        0.0,
        None,
        free_root=False,
        load=False,
    )
    box = last.add_body(name="box", pos=[0.0, 0.0, -rope.segment_length])
    for name, axis in (("box_y", [0, 1, 0]), ("box_x", [1, 0, 0])):
        box.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis).damping[0] = (
            rope.joint_damping
        )
    _as_box(box, rope.payload_mass, sides, -0.5 * sides[2])
    return spec.compile()


def two_cables(
    body: BodyParams, rope: RopeParams, sides: Sequence[float], apart: float, length: float
) -> "mujoco.MjModel":
    """A box on two cables without mass, side by side along the vehicle's x axis; a cable pulls or
    is slack.

    Args:
        body: Mass and inertia of the vehicle.
        rope: Of it mount and the payload's mass.
        sides: Of the box, homogeneous [m], shape (3,).
        apart: Distance of the cables, on the vehicle and on the box [m].
        length: Of each cable [m].
    """
    spec = new_spec(constraints=True)
    vehicle, (x, y, z) = add_vehicle(spec, body), rope.mount
    box = spec.worldbody.add_body(name="box", pos=[x, y, z - length - 0.5 * sides[2]])
    box.add_freejoint(name="box")
    _as_box(box, rope.payload_mass, sides, 0.0)
    for name, side in (("front", 0.5), ("rear", -0.5)):
        vehicle.add_site(name=f"{name}_above", pos=[x + side * apart, y, z])
        box.add_site(name=f"{name}_below", pos=[side * apart, 0.0, 0.5 * sides[2]])
        cable = spec.add_tendon(
            name=name, limited=True, range=[0.0, length], solref_limit=[0.002, 1.0]
        )
        cable.wrap_site(f"{name}_above")
        cable.wrap_site(f"{name}_below")
    return spec.compile()


def _as_box(body: "mujoco.MjsBody", mass: float, sides: Sequence[float], centre_z: float) -> None:
    """Give a body a homogeneous box's inertia about a centre on its z axis, and the site
    ``payload`` there.
    """
    a, b, c = (side * side for side in sides)
    body.mass, body.ipos, body.explicitinertial = mass, [0.0, 0.0, centre_z], True
    body.inertia = [mass / 12.0 * (b + c), mass / 12.0 * (a + c), mass / 12.0 * (a + b)]
    body.add_site(name="payload", pos=[0.0, 0.0, centre_z])
