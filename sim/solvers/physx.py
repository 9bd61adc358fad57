"""PhysX, the paper's engine, as a solver: ovphysx on a CPU or a GPU.

Each vehicle is an articulation of the body and rods on joints with two angles, without colliders.
docs/explanation/physx.md explains the settings."""

import tempfile
import weakref
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from sim.kernels.rope.payload import LOADS
from sim.kernels.runtime import unique_kernel
from sim.kernels.structs import extensions_of
from sim.params import RopeParams, VehicleParams
from sim.solvers import World
from sim.solvers.rods import AXIAL_INERTIA, Ints, build_place, vec3

LOCKED = ("transX", "transY", "transZ", "rotZ")
FREE = ("rotX", "rotY")
SCENE = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def PhysicsScene "scene" (prepend apiSchemas = ["PhysxSceneAPI"]) {{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = {gravity!r}
    uniform token physxScene:solverType = "TGS"
    bool physxScene:enableGPUDynamics = {gpu:d}
    uniform token physxScene:broadphaseType = "{broadphase}"
    bool physxScene:enableExternalForcesEveryIteration = 0
    uniform bool physxScene:disableSleeping = 1
}}
"""
LINK = """
    def Xform "{name}" (prepend apiSchemas = [{apis}"PhysicsRigidBodyAPI", "PhysicsMassAPI",
            "PhysxRigidBodyAPI"]) {{
        double3 xformOp:translate = (0, 0, {z!r})
        uniform token[] xformOpOrder = ["xformOp:translate"]
        float physics:mass = {mass!r}
        point3f physics:centerOfMass = (0, 0, {centre!r})
        float3 physics:diagonalInertia = {inertia!r}
        quatf physics:principalAxes = (1, 0, 0, 0)
        float physxRigidBody:angularDamping = 0{more}
    }}"""
ROOT = """
        bool physxArticulation:enabledSelfCollisions = 0
        int physxArticulation:solverPositionIterationCount = 4
        int physxArticulation:solverVelocityIterationCount = 1"""
JOINT = """
    def PhysicsJoint "joint{i}" (prepend apiSchemas = [{apis}]) {{
        rel physics:body0 = </{env}/{above}>
        rel physics:body1 = </{env}/rod{i}>
        point3f physics:localPos0 = {at!r}
{axes}
    }}"""
LIMIT = "        float limit:{0}:physics:low = 1\n        float limit:{0}:physics:high = -1"
DRIVE = """        float drive:{0}:physics:damping = {1!r}
        float drive:{0}:physics:stiffness = 0"""

_device: list[str] = []
"""Device on which this process runs PhysX; empty before the start."""


def environment(env: str, vehicle: VehicleParams, rope: RopeParams) -> str:
    """Return the USD text of a level vehicle with its rope hanging straight down."""
    length = rope.segment_length
    mount = rope.mount
    body = vehicle.body
    apis = '"PhysicsArticulationRootAPI", "PhysxArticulationAPI", '
    place = {"z": 0.0, "mass": body.mass, "centre": 0.0, "inertia": tuple(body.inertia)}
    parts = [LINK.format(name="vehicle", apis=apis, more=ROOT, **place)]
    joint_apis = [f'"PhysicsLimitAPI:{axis}"' for axis in LOCKED]
    joint_apis += [f'"PhysicsDriveAPI:{axis}"' for axis in FREE]
    for i in range(rope.segments):
        mass, centre, transverse = rope.rod(i == rope.segments - 1)
        place = {"z": mount[2] - i * length, "mass": mass, "centre": -centre}
        inertia = (transverse, transverse, AXIAL_INERTIA)
        parts.append(LINK.format(name=f"rod{i}", apis="", more="", inertia=inertia, **place))
        damping = rope.joint_damping + (rope.mount_damping if i == 0 else 0.0)
        axes = [LIMIT.format(axis) for axis in LOCKED]
        axes += [DRIVE.format(axis, float(np.radians(damping))) for axis in FREE]  # per degree
        above, anchor = (
            ("vehicle", tuple(mount)) if i == 0 else (f"rod{i - 1}", (0.0, 0.0, -length))
        )
        joint = {
            "apis": ", ".join(joint_apis),
            "above": above,
            "at": anchor,
            "axes": "\n".join(axes),
        }
        parts.append(JOINT.format(i=i, env=env, **joint))
    return f'def Xform "{env}" {{{"".join(parts)}\n}}\n'


class PhysxSolver:
    """Articulations of E vehicles in one scene.

    Raises RuntimeError: this process already runs PhysX on another device.
    """

    capturable = False

    def __init__(self, world: World):
        self.world = world
        self._gpu = world.device != "cpu"
        ovphysx = _start(world.device)
        import ovstage
        from ovphysx.types import TensorType

        models, model_of = world.models()
        first = [int(np.argmax(model_of == k)) for k in range(len(models))]
        name = "env{:06d}".format
        usd = [environment(name(e), *model) for e, model in zip(first, models)]
        head = SCENE.format(
            gravity=world.plants.gravity, gpu=self._gpu, broadphase="GPU" if self._gpu else "MBP"
        )
        self._physx = _instance(ovphysx, world.device)
        stage = ovstage.Stage()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.usda"
            file.write_text(head + "".join(usd))
            domains = ovstage.PopulationDomain.ALL
            ovstage.population.open_usd(stage, str(file), ordinal=1, domains=domains)
        stage.advance_write_floor(ordinal=1).wait()
        self._stage = stage
        wait = self._physx.wait_task
        wait(self._physx.attach_ovstage(stage, read_ordinal=1))
        for k, e in enumerate(first):
            copies = [f"/{name(c)}" for c in np.flatnonzero(model_of == k) if c != e]
            if copies:  # all at the same position, because there are no collisions
                wait(self._physx.clone(f"/{name(e)}", copies, [(0.0,) * 6 + (1.0,)] * len(copies)))
        weakref.finalize(self, self._physx.destroy)
        self._physx.warmup()  # a first step, which otherwise the first read or write would do
        self._bind(TensorType)
        self._kernels = _kernels(world)
        self._unscaled = self._masses[:, 0].copy()

    def _bind(self, kind) -> None:
        """Bind the scene's tensors, and allocate arrays to read and write them."""
        kinds = {
            "pose": kind.ARTICULATION_ROOT_POSE,
            "velocity": kind.ARTICULATION_ROOT_VELOCITY,
            "angles": kind.ARTICULATION_DOF_POSITION,
            "rates": kind.ARTICULATION_DOF_VELOCITY,
            "links": kind.ARTICULATION_LINK_POSE,
            "link_velocities": kind.ARTICULATION_LINK_VELOCITY,
            "wrench": kind.ARTICULATION_LINK_WRENCH,
            "mass": kind.ARTICULATION_BODY_MASS,
        }
        bind = self._physx.create_tensor_binding
        self._tensors = {
            name: bind(pattern="/env*/vehicle", tensor_type=value, raise_if_empty=True)
            for name, value in kinds.items()
        }
        paths = self._tensors["pose"].prim_paths
        self._order = np.array([int(path.split("/")[1].removeprefix("env")) for path in paths])
        self._rows = wp.array(self._order, dtype=wp.int32, device=self.world.device)
        of_links = {"links": wp.transformf, "link_velocities": wp.spatial_vectorf}
        self._arrays = {}
        for name, tensor in self._tensors.items():
            dtype = of_links.get(name, wp.float32)
            shape = tensor.shape[:2] if name in of_links else tensor.shape
            self._arrays[name] = wp.zeros(shape, dtype=dtype, device=self.world.device)
        self._masses = np.zeros(self._tensors["mass"].shape, np.float32)  # PhysX has them on host
        self._tensors["mass"].read(self._masses)

    def place(self, mask) -> None:
        w = self.world
        moved = mask.numpy()[self._order] != 0
        if not moved.any():
            return
        names = ("pose", "velocity", "angles", "rates")
        arrays = [self._arrays[name] for name in names]
        rows = wp.array(moved, dtype=wp.uint8, device=w.device)
        w.launch(self._kernels["place"], [w.state, mask, self._rows, *arrays])
        scale = w.state.mass_scale.numpy()[self._order]
        masses = np.where(moved, self._unscaled * scale, self._masses[:, 0])
        changed = masses != self._masses[:, 0]
        if changed.any():
            self._masses[:, 0] = masses
            self._tensors["mass"].write(self._masses, mask=changed.astype(np.uint8))
        for name, array in zip(names, arrays):
            self._tensors[name].write(array, mask=rows)

    def advance(self, duration: float) -> None:
        w = self.world
        arrays = self._arrays
        tensors = self._tensors
        inputs = [w.wrench, w.bodies, self._rows, arrays["wrench"]]
        w.launch(self._kernels["push"], inputs)
        tensors["wrench"].write(arrays["wrench"])
        self._physx.step_sync(duration)
        for name in ("links", "link_velocities"):
            tensors[name].read(arrays[name])
        outputs = [w.plants.ropes, self._rows, arrays["links"], arrays["link_velocities"], w.bodies]
        w.launch(self._kernels["show"], outputs)


def _start(device: str) -> ModuleType:
    """Start PhysX in this process; the device cannot be changed afterwards."""
    import ovphysx
    import ovstage
    from ovphysx.samples.python_samples.schema_support import physx_schema_paths
    from ovphysx.types import GlobalConfigKey

    if not _device:
        ovphysx.PhysX.set_cpu_mode(device == "cpu")
        if device == "cpu":  # the default of 8 makes a step of one vehicle 12 times as slow
            ovphysx.set_global_config(GlobalConfigKey.NUM_THREADS, 0)
        schemas = [*map(str, physx_schema_paths()), str(ovphysx.newton_schema_root())]
        ovstage.population.register_usd_schemas(schemas)
        _device.append(device)
    if _device != [device]:
        raise RuntimeError(
            f"PhysX on {device}: this process runs it on {_device[0]}, and it takes one device a"
            " process"
        )
    return ovphysx


def _instance(ovphysx: ModuleType, device: str) -> Any:
    """Make an instance without collisions, whose state stays on its GPU."""
    gpu = device != "cpu"
    settings = {"/ovphysx/clone/useEnvIds": False, "/physics/suppressReadback": gpu}
    physx = ovphysx.PhysX(config=ovphysx.PhysXConfig(carbonite_overrides=settings))
    if gpu:
        physx.set_config(ovphysx.ConfigKey.ACTIVE_CUDA_GPUS, str(wp.get_device(device).ordinal))
    return physx


def _kernels(world: World) -> dict[str, wp.Kernel]:
    """Build the kernels that convert between the exchange's arrays and PhysX's tensors."""
    t = world.types
    L = world.params.rope.segments
    Wrench = world.kernels.Wrench
    Bodies = world.kernels.Bodies
    loaded = bool(extensions_of(world.ropes) & LOADS) or bool(world.params.laws)

    @unique_kernel
    def push(
        # In:
        wrench: Wrench,
        bodies: Bodies,
        rows: Ints,
        # Out:
        out: wp.array3d(dtype=float),
    ):
        """Write wrenches in the world frame, constant over PhysX's step; 0 for invalid bodies."""
        row = wp.tid()
        env = rows[row]
        q = bodies.quat_wb[env]
        force = wp.quat_rotate(q, wrench.force_b[env])
        torque = wp.quat_rotate(q, wrench.torque_b[env])
        pos = bodies.pos_w[env]
        if not (wp.isfinite(force) and wp.isfinite(torque) and wp.isfinite(pos)):
            force = vec3()
            torque = vec3()
            pos = vec3()
        for k in range(3):
            out[row, 0, k] = force[k]
            out[row, 0, 3 + k] = torque[k]
            out[row, 0, 6 + k] = pos[k]
        if wp.static(loaded):
            load = wrench.load_w[env]
            anchor = bodies.payload_pos_w[env]
            for k in range(3):
                out[row, L, k] = load[k]
                out[row, L, 6 + k] = anchor[k]

    @unique_kernel
    def show(
        # Params:
        ropes: wp.array(dtype=t.Rope),
        # In:
        rows: Ints,
        links: wp.array2d(dtype=wp.transformf),
        velocities: wp.array2d(dtype=wp.spatial_vectorf),
        # Out:
        bodies: Bodies,
    ):
        row = wp.tid()
        env = rows[row]
        rope = ropes[env % ropes.shape[0]]
        q = wp.transform_get_rotation(links[row, 0])
        pos = wp.transform_get_translation(links[row, 0])
        vel = wp.spatial_top(velocities[row, 0])
        rate_w = wp.spatial_bottom(velocities[row, 0])
        bodies.pos_w[env] = pos
        bodies.quat_wb[env] = q
        bodies.vel_w[env] = vel
        bodies.rate_b[env] = wp.quat_rotate_inv(q, rate_w)
        arm = wp.quat_rotate(q, rope.mount)
        pos += arm
        vel += wp.cross(rate_w, arm)
        n = vec3()
        u = vec3()
        for i in range(1, L + 1):
            n = wp.quat_rotate(wp.transform_get_rotation(links[row, i]), vec3(0.0, 0.0, -1.0))
            u = wp.cross(wp.spatial_bottom(velocities[row, i]), n)
            bodies.cable_dir_w[i - 1, env] = n
            bodies.cable_vel_w[i - 1, env] = u
            pos += rope.segment_length * n
            vel += rope.segment_length * u
        bodies.payload_pos_w[env] = pos + rope.payload_offset * n
        bodies.payload_vel_w[env] = vel + rope.payload_offset * u

    return {"place": build_place(world, hinges=False), "push": push, "show": show}
