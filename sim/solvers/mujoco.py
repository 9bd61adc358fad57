"""MuJoCo as a solver: MuJoCo Warp on a GPU, and MuJoCo's C library with the same models on a CPU.

The integrator is RK4 for substeps up to 0.5 ms, at which it has converged for the paper's rope, and
implicitfast for larger ones, at which RK4 is unstable."""

from collections.abc import Callable

import mujoco
import numpy as np
import warp as wp
from numpy import ndarray

from sim.kernels.runtime import unique_kernel
from sim.solvers import World
from sim.solvers.payloads import compile_model
from sim.solvers.rods import Ints, Table, build_place, quat, read, vec3, write

RK4_STEP = 5e-4
"""Largest substep of RK4 [s]. Half of it changes the end of a hard throw by less than 1 um."""

MODEL_ARRAYS = (
    "body_pos",
    "body_ipos",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "dof_damping",
    "dof_invweight0",
    "site_pos",
    "tendon_range",
    "tendon_invweight0",
    "tendon_length0",
)
"""Fields of a model that may differ between the vehicles and ropes of a batch."""

CONSTRAINTS = 8
"""Largest number of constraints (taut cables) in a world."""


class MujocoSolver:
    """A MuJoCo model for each vehicle."""

    capturable = False  # on a GPU a step is a captured graph of its own

    def __init__(self, world: World):
        self.world = world
        device = world.device
        count = world.count
        pairs, model_of = world.models()
        models = [compile_model(vehicle.body, rope) for vehicle, rope in pairs]
        for model in models:
            model.opt.timestep = world.substep
            rk4 = world.substep <= RK4_STEP * (1.0 + 1e-9)
            kind = mujoco.mjtIntegrator
            model.opt.integrator = kind.mjINT_RK4 if rk4 else kind.mjINT_IMPLICITFAST
        arrays = {
            name: np.stack([getattr(model, name) for model in models])[model_of]
            for name in MODEL_ARRAYS
        }
        wide = {
            name: value
            for name, value in arrays.items()
            if value.size and (name == "body_mass" or (value != value[0]).any())
        }
        make = _make_on_cpu if device == "cpu" else _make_on_gpu
        self.qpos, self.qvel, self.ctrl, self._masses, self._step, self._placed = make(
            models[0], wide, count, device
        )
        self._vehicle = mujoco.mj_name2id(models[0], mujoco.mjtObj.mjOBJ_BODY, "vehicle")
        self._nominal = wp.array(arrays["body_mass"][:, self._vehicle], dtype=float, device=device)
        self._rows = wp.array(np.arange(count), dtype=wp.int32, device=device)
        self._payload_quat = wp.zeros(count, dtype=quat, device=device)
        self._kernels = _kernels(world)

    def place(self, mask) -> None:
        w = self.world
        end = 2 * w.params.rope.segments
        root = [self.qpos[:, :7], self.qvel[:, :6]]
        rope = [self.qpos[:, 7 : 7 + end], self.qvel[:, 6 : 6 + end]]
        place = [w.state, mask, self._rows, *root, *rope]
        w.launch(self._kernels["place"], place)
        masses = [self._nominal, self._vehicle, self._masses]
        pack = [w.plants.ropes, w.state, mask, *masses, self.qpos, self.qvel]
        w.launch(self._kernels["pack"], pack)
        self._placed(mask)
        self._show()

    def advance(self, duration: float) -> None:
        w = self.world
        w.launch(self._kernels["push"], [w.wrench, self._payload_quat, self.ctrl])
        self._step()
        self._show()

    def _show(self) -> None:
        w = self.world
        outputs = [w.plants.ropes, self.qpos, self.qvel, w.bodies, self._payload_quat]
        w.launch(self._kernels["show"], outputs)


def _make_on_cpu(model, wide: dict[str, ndarray], count: int, device: str) -> tuple:
    """Make a batch of MuJoCo's C library.

    Returns arrays of coordinates, velocities, controls and masses, a function that steps, and one
    that applies newly placed coordinates where a mask is not 0."""
    from sim.reference.batch import Batch

    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # NaN must remain visible
    batch = Batch(model, count, nthread=1)
    for name, value in wide.items():
        batch.expand(name)[:] = value
    shapes = ((count, model.nq), (count, model.nv), (count, model.nu), (count, model.nbody))
    qpos, qvel, ctrl, masses = (wp.zeros(shape, dtype=wp.float32) for shape in shapes)
    masses.assign(wide["body_mass"].astype(np.float32))

    def step() -> None:
        batch.ctrl[:] = ctrl.numpy()
        batch.step()
        qpos.numpy()[:] = batch.qpos
        qvel.numpy()[:] = batch.qvel

    def placed(mask) -> None:
        rows = mask.numpy() != 0
        batch.expand("body_mass")[rows] = masses.numpy()[rows]
        batch.qpos[rows] = qpos.numpy()[rows]
        batch.qvel[rows] = qvel.numpy()[rows]
        batch.bind("qacc_warmstart")[rows] = 0.0

    return qpos, qvel, ctrl, masses, step, placed


def _make_on_gpu(model, wide: dict[str, ndarray], count: int, device: str) -> tuple:
    """Make MuJoCo Warp's worlds; see :func:`_make_on_cpu`."""
    import mujoco_warp

    with wp.ScopedDevice(device), wp.ScopedStream(wp.Stream(device)):
        model_on_device = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(wide, count))
        for name, value in wide.items():
            getattr(model_on_device, name).assign(value.astype(np.float32))
        data = mujoco_warp.make_data(model, nworld=count, njmax=CONSTRAINTS, naconmax=1)
        mujoco_warp.step(model_on_device, data)  # loads modules, which a capture cannot
        with wp.ScopedCapture(device=device, force_module_load=False) as captured:
            mujoco_warp.step(model_on_device, data)
        wp.synchronize_device(device)

    # the default argument keeps these alive as long as the graph, which reads them
    def step(_read=(model_on_device, data)) -> None:
        wp.capture_launch(captured.graph, stream=wp.get_stream(device))

    def placed(mask) -> None:
        wp.launch(_clear, data.qacc_warmstart.shape, [mask, data.qacc_warmstart], device=device)

    return data.qpos, data.qvel, data.ctrl, model_on_device.body_mass, step, placed


@wp.kernel(enable_backward=False)
def _clear(
    # In:
    mask: Ints,
    # Out:
    values: Table,
):
    env, i = wp.tid()
    if mask[env] != 0:
        values[env, i] = 0.0


def _kernels(world: World) -> dict[str, Callable]:
    """Build the kernels that convert between the exchange's arrays and MuJoCo's coordinates."""
    t = world.types
    rope = world.params.rope
    L = rope.segments
    cables = rope.cables_apart > 0.0
    box = any(rope.payload_sides)
    N = L + 1 if box else L  # the box has joints like one more rod
    Rope = t.Rope
    State = world.kernels.State
    Wrench = world.kernels.Wrench
    Bodies = world.kernels.Bodies

    @unique_kernel
    def pack(
        # Params:
        ropes: wp.array(dtype=Rope),
        # In:
        state: State,
        mask: Ints,
        nominal: wp.array(dtype=float),
        vehicle: int,
        # Out:
        masses: Table,
        qpos: Table,
        qvel: Table,
    ):
        """Write what the rods' angles do not say: masses, and the box."""
        env = wp.tid()
        if mask[env] == 0:
            return
        masses[env, vehicle] = nominal[env] * state.mass_scale[env]
        if wp.static(cables):  # both taut: the box hangs level with the vehicle
            rope = ropes[env % ropes.shape[0]]
            q = state.quat_wb[env]
            w = wp.quat_rotate(q, state.rate_b[env])
            arm = wp.quat_rotate(q, rope.mount - vec3(0.0, 0.0, rope.payload_offset))
            pos = state.pos_w[env] + arm + rope.segment_length * state.cable_dir_w[0, env]
            vel = state.vel_w[env] + wp.cross(w, arm)
            vel += rope.segment_length * state.cable_vel_w[0, env]
            write(qpos, env, 7, pos)
            write(qvel, env, 6, vel)
            write(qvel, env, 9, state.rate_b[env])
            for k in range(4):
                qpos[env, 10 + k] = qpos[env, 3 + k]
        elif wp.static(box):
            for i in range(2 * L, 2 * N):
                qpos[env, 7 + i] = 0.0
                qvel[env, 6 + i] = 0.0

    @unique_kernel
    def push(
        # In:
        wrench: Wrench,
        payload_quat: wp.array(dtype=quat),
        # Out:
        ctrl: Table,
    ):
        env = wp.tid()
        load = wp.quat_rotate_inv(payload_quat[env], wrench.load_w[env])
        write(ctrl, env, 0, wrench.force_b[env])
        write(ctrl, env, 3, wrench.torque_b[env])
        write(ctrl, env, 6, load)

    @unique_kernel
    def show(
        # Params:
        ropes: wp.array(dtype=Rope),
        # In:
        qpos: Table,
        qvel: Table,
        # Out:
        bodies: Bodies,
        payload_quat: wp.array(dtype=quat),
    ):
        env = wp.tid()
        rope = ropes[env % ropes.shape[0]]
        q = quat(qpos[env, 4], qpos[env, 5], qpos[env, 6], qpos[env, 3])
        rate = read(qvel, env, 3)
        w = wp.quat_rotate(q, rate)
        arm = wp.quat_rotate(q, rope.mount)
        pos = read(qpos, env, 0)
        vel = read(qvel, env, 0)
        bodies.pos_w[env] = pos
        bodies.quat_wb[env] = q
        bodies.vel_w[env] = vel
        bodies.rate_b[env] = rate
        pos += arm
        vel += wp.cross(w, arm)
        if wp.static(cables):
            turn = quat(qpos[env, 11], qpos[env, 12], qpos[env, 13], qpos[env, 10])
            spin = wp.quat_rotate(turn, read(qvel, env, 9))
            box = read(qpos, env, 7)
            box_vel = read(qvel, env, 6)
            top = wp.quat_rotate(turn, vec3(0.0, 0.0, rope.payload_offset))
            gap = box + top - pos
            n = wp.normalize(gap)
            u = (box_vel + wp.cross(spin, top) - vel) / wp.length(gap)
            bodies.cable_dir_w[0, env] = n
            bodies.cable_vel_w[0, env] = u - n * wp.dot(n, u)
            bodies.payload_pos_w[env] = box
            bodies.payload_vel_w[env] = box_vel
            payload_quat[env] = turn
        else:
            n = vec3()
            u = vec3()
            for i in range(N):
                a = qpos[env, 7 + 2 * i]
                b = qpos[env, 8 + 2 * i]
                turn = wp.quat_from_axis_angle(vec3(0.0, 1.0, 0.0), a)
                q = q * turn * wp.quat_from_axis_angle(vec3(1.0, 0.0, 0.0), b)
                about_y = qvel[env, 6 + 2 * i]
                about_x = qvel[env, 7 + 2 * i]
                spin = vec3(about_x, about_y * wp.cos(b), -about_y * wp.sin(b))
                w += wp.quat_rotate(q, spin)
                n = wp.quat_rotate(q, vec3(0.0, 0.0, -1.0))
                u = wp.cross(w, n)
                if i < L:
                    bodies.cable_dir_w[i, env] = n
                    bodies.cable_vel_w[i, env] = u
                    pos += rope.segment_length * n
                    vel += rope.segment_length * u
            bodies.payload_pos_w[env] = pos + rope.payload_offset * n
            bodies.payload_vel_w[env] = vel + rope.payload_offset * u
            payload_quat[env] = q

    place = build_place(world, hinges=True)
    return {"place": place, "pack": pack, "push": push, "show": show}
