"""Simulate the bodies of a team with MuJoCo in float64, as an independent engine for policies that
were trained on the tree of rods.

Every vehicle has a free joint and its cable below it. An equality constraint attaches the cable's
end to the load until separation; afterwards the cable stays with the vehicle."""

import mujoco
import numpy as np
import warp as wp

from sim.params import RopeParams
from sim.reference.model import add_chain, add_vehicle, new_spec
from sim.solvers import World
from sim.solvers.rods import build_place

STEP = 5e-4  # step of RK4 [s]; an exchange consists of a whole number of steps
STIFF = (2.0 * STEP, 1.0)  # time constant [s] and damping ratio of the constraint


class MujocoTeam:
    """A solver with the interface of :class:`visthrow.cooperative.tree.TreeSolver`, on a CPU."""

    capturable = False

    def __init__(self, world: World, team: int):
        """Compile one model for each world."""
        count = world.count
        self.world = world
        self.team = team
        self.worlds = count // team
        pairs, kinds = world.models()
        members = [pairs[kinds[row]] for row in range(count)]
        teams = [members[first : first + team] for first in range(0, count, team)]
        self._nominal = [_compile(members) for members in teams]
        self._data = [mujoco.MjData(model) for model in self._nominal]
        self._repeats = max(round(world.substep / STEP), 1)
        hinges = 2 * world.params.rope.segments
        shapes = [(count, width) for width in (7, 6, hinges, hinges)]
        self._arrays = [wp.zeros(shape, dtype=wp.float32) for shape in shapes]
        self._rows = wp.array(np.arange(count), dtype=wp.int32)
        self._kernel = build_place(world, hinges=True)
        self.load_pos_w = wp.zeros(self.worlds, dtype=world.types.vec3)
        self.load_vel_w = wp.zeros_like(self.load_pos_w)

    def place(self, mask) -> None:
        w = self.world
        state = self.world.state
        wp.launch(self._kernel, w.count, [state, mask, self._rows, *self._arrays])
        pose, velocity, angles, rates = (array.numpy() for array in self._arrays)
        scale = state.mass_scale.numpy()
        load = w.bodies.payload_pos_w.numpy()
        load_vel = w.bodies.payload_vel_w.numpy()
        placed = (mask.numpy() != 0).reshape(self.worlds, self.team).any(1)
        for world in np.flatnonzero(placed):
            data = self._data[world]
            model = self._nominal[world]
            mujoco.mj_resetData(model, data)
            rows = range(world * self.team, (world + 1) * self.team)
            for k, row in enumerate(rows):
                body = model.body(f"{k}_vehicle").id
                model.body_mass[body] = w.vehicles[row % len(w.vehicles)].body.mass * scale[row]
            data.qpos[:3] = load[rows[0]]
            data.qvel[:3] = load_vel[rows[0]]
            data.qpos[3:] = np.hstack((pose[rows], angles[rows])).flat
            data.qvel[3:] = np.hstack((velocity[rows], rates[rows])).flat
            self._show(world)

    def advance(self, duration: float) -> None:
        wrench = self.world.wrench
        attached = self.world.state.attached.numpy()
        force = wrench.force_b.numpy()
        torque = wrench.torque_b.numpy()
        for world, data in enumerate(self._data):
            first = world * self.team
            for k in range(self.team):
                data.eq_active[k] = attached[first + k]
                data.ctrl[6 * k : 6 * k + 6] = [*force[first + k], *torque[first + k]]
            mujoco.mj_step(self._nominal[world], data, self._repeats)
            self._show(world)

    def _show(self, world: int) -> None:
        """Copy a world's bodies into the arrays of the exchange."""
        team = self.team
        model = self._nominal[world]
        data = self._data[world]
        bodies = self.world.bodies
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        self.load_pos_w.numpy()[world] = data.qpos[:3]
        self.load_vel_w.numpy()[world] = data.qvel[:3]
        places = data.qpos[3:].reshape(team, -1)
        speeds = data.qvel[3:].reshape(team, -1)
        rows = slice(world * team, (world + 1) * team)
        bodies.pos_w.numpy()[rows] = places[:, :3]
        bodies.quat_wb.numpy()[rows] = np.roll(places[:, 3:7], -1, axis=1)
        bodies.vel_w.numpy()[rows] = speeds[:, :3]
        bodies.rate_b.numpy()[rows] = speeds[:, 3:6]
        bodies.payload_pos_w.numpy()[rows] = data.qpos[:3]
        bodies.payload_vel_w.numpy()[rows] = data.qvel[:3]
        for k in range(team):
            first = model.body(f"{k}_rod0").id
            rods = slice(first, first + self.world.params.rope.segments)
            directions = -data.xmat[rods].reshape(-1, 3, 3)[:, :, 2]
            row = rows.start + k
            bodies.cable_dir_w.numpy()[:, row] = directions
            bodies.cable_vel_w.numpy()[:, row] = np.cross(data.cvel[rods, :3], directions)


def _compile(members: list[tuple]) -> "mujoco.MjModel":
    """Return the model of a world from the bodies and ropes of its vehicles."""
    spec = new_spec(constraints=True)
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    load = spec.worldbody.add_body(name="load")
    load.mass = sum(rope.payload_mass for _, rope in members)
    load.inertia = [1e-6] * 3
    load.explicitinertial = True
    load.add_site(name="load")
    for axis in np.eye(3):
        load.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    for k, (vehicle, rope) in enumerate(members):
        frame = spec.worldbody.add_frame()
        spec.attach(_vehicle(vehicle.body, rope), prefix=f"{k}_", frame=frame)
        hold = spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, name1=f"{k}_end", name2="load")
        hold.objtype = mujoco.mjtObj.mjOBJ_SITE
        hold.solref = list(STIFF)
        hold.solimp = [0.9999, 0.9999, 0.001, 0.5, 2.0]
    return spec.compile()


def _vehicle(body, rope: RopeParams) -> "mujoco.MjSpec":
    """Return a vehicle with its cable and the site ``end`` at the cable's lower end."""
    spec = new_spec(constraints=True)
    vehicle = add_vehicle(spec, body)
    last = add_chain(rope, vehicle, "universal", load=False)
    last.add_site(name="end", pos=[0.0, 0.0, -rope.segment_length])
    return spec
