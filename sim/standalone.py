"""QuadSim: a batch of quadrotors without a rope, from the same blocks as the hybrid simulator, by
Euler or RK4.

For racing, navigation and system identification, and the small sibling in which a block can be
studied alone."""

import math

import numpy as np
import warp as wp

from sim.kernels import runtime  # noqa: F401  starts Warp
from sim.kernels import state as st
from sim.kernels.quadrotor.queue import held, push, queue_depth, split_delay
from sim.kernels.quadrotor.rigid_body import advance, angular_acceleration, blend, build_flow
from sim.kernels.quadrotor.start import build_start
from sim.kernels.structs import Types, extensions_of, kinds_of, pack, pack_vehicle, types
from sim.params import GRAVITY, AirParams, VehicleParams

INTEGRATORS = ("euler", "rk4")
FIELDS = st.QUAD_FIELDS | {"queue": ("vec4", True), "status": ("int", False)}
START_FIELDS = {
    k: st.QUAD_FIELDS[k] for k in ("pos_w", "quat_wb", "vel_w", "rate_b", "charge_used")
}
_BUILDS: dict = {}


def build_quad_step(t: Types, flow, rate, motor_advance, integrator: str):
    """Return ``step(p, air, s, command, force_w, torque_b, gravity, h) -> state`` of one
    integrator.

    Source: Hairer, Norsett, Wanner, *Solving Ordinary Differential Equations I*, II.1 (the
    classical method of order 4)."""
    Vehicle = t.Vehicle
    Air = t.Air
    QuadState = t.QuadState
    vec3 = t.vec3
    vec4 = t.vec4
    real = t.real

    @wp.func
    def slope(
        p: Vehicle,
        air: Air,
        s: QuadState,
        command: vec4,
        force_w: vec3,
        torque_b: vec3,
        gravity: vec3,
    ):
        f = flow(p, air, s, command)
        acc = (wp.quat_rotate(s.quat_wb, f.force_b) + force_w) / p.body.mass + gravity
        return (
            rate(p, s, f, acc, angular_acceleration(p, s.rate_b, f.torque_b + torque_b)),
            f.motor_speed,
        )

    @wp.func
    def euler(
        p: Vehicle,
        air: Air,
        s: QuadState,
        command: vec4,
        force_w: vec3,
        torque_b: vec3,
        gravity: vec3,
        h: real,
    ):
        r, acting = slope(p, air, s, command, force_w, torque_b, gravity)
        out = advance(s, r, h)
        out.motor_speed = motor_advance(out.motor_speed, acting)
        return out

    @wp.func
    def rk4(
        p: Vehicle,
        air: Air,
        s: QuadState,
        command: vec4,
        force_w: vec3,
        torque_b: vec3,
        gravity: vec3,
        h: real,
    ):
        half = real(0.5)
        one = real(1.0)
        r1, _a1 = slope(p, air, s, command, force_w, torque_b, gravity)
        r2, _a2 = slope(p, air, advance(s, r1, half * h), command, force_w, torque_b, gravity)
        r3, _a3 = slope(p, air, advance(s, r2, half * h), command, force_w, torque_b, gravity)
        r4, acting = slope(p, air, advance(s, r3, h), command, force_w, torque_b, gravity)
        outer = blend(r1, one, r4, one)
        inner = blend(r2, one, r3, one)
        out = advance(s, blend(outer, one / real(6.0), inner, one / real(3.0)), h)
        out.motor_speed = motor_advance(out.motor_speed, acting)
        return out

    return {"euler": euler, "rk4": rk4}[integrator]


def build_kernels(t: Types, vehicle: VehicleParams, integrator: str, extensions: frozenset[str]):
    """Step and reset kernels for one choice of blocks, and their structs of state and
    start arrays.
    """
    real = t.real
    vec3 = t.vec3
    vec4 = t.vec4
    Vehicle = t.Vehicle
    Air = t.Air
    State = st.array_struct(t, "QuadArrays", FIELDS)
    Start = st.array_struct(t, "QuadStart", START_FIELDS)
    load, store = st.build_access(t, State)
    begin = build_start(t, vehicle, State)
    integrate = build_quad_step(t, *build_flow(t, vehicle, extensions), integrator)
    limit = real(st.SPEED_LIMIT)

    @wp.kernel(module="unique", enable_backward=False)
    def quad_step_kernel(
        # Params:
        vehicle: wp.array(dtype=Vehicle),
        airs: wp.array(dtype=Air),
        period: real,
        largest_step: real,
        gravity: real,
        # State in:
        state: State,
        # In:
        command: wp.array(dtype=vec4),
        force_w: wp.array(dtype=vec3),
        torque_b: wp.array(dtype=vec3),
    ):
        env = wp.tid()
        p = vehicle[env % vehicle.shape[0]]
        air = airs[env % airs.shape[0]]
        g = vec3(real(0.0), real(0.0), -gravity)
        s = load(state, env)
        taken = push(state.queue, env, command[env])
        whole, switch = split_delay(p, period)
        tiny = real(1.0e-6)
        time = real(0.0)
        while time < period - tiny:
            active, until = held(state.queue, env, whole, switch, time, period)
            count = int(wp.ceil((until - time) / largest_step - real(1.0e-3)))
            h = (until - time) / real(float(count))
            for _k in range(count):
                s = integrate(p, air, s, active, force_w[env], torque_b[env], g, h)
            time = until
        status = int(0)
        if st.size(s) < limit:  # false for NaN
            store(state, env, s)
        else:
            status = 1
        if not taken:
            status = 1
        state.status[env] = status

    @wp.kernel(module="unique", enable_backward=False)
    def quad_reset_kernel(
        # Params:
        vehicle: wp.array(dtype=Vehicle),
        gravity: real,
        # State in:
        state: State,
        # In:
        start: Start,
        mask: wp.array(dtype=wp.int32),
    ):
        env = wp.tid()
        if mask[env] != 0:
            p = vehicle[env % vehicle.shape[0]]
            state.pos_w[env] = start.pos_w[env]
            state.quat_wb[env] = start.quat_wb[env]
            state.vel_w[env] = start.vel_w[env]
            state.rate_b[env] = start.rate_b[env]
            begin(p, state, env, p.body.mass * gravity, start.charge_used[env])
            state.status[env] = 0

    return quad_step_kernel, quad_reset_kernel, State, Start


def _built(
    precision: str, vehicle: VehicleParams, integrator: str, extensions: frozenset[str]
) -> tuple:
    """Return kernels and structs of a choice of blocks, built once."""
    key = (precision, integrator, kinds_of(vehicle), extensions)
    if key not in _BUILDS:
        _BUILDS[key] = build_kernels(types(precision), vehicle, integrator, extensions)
    return _BUILDS[key]


def _check(count: int, integrator: str, times: dict[str, float]) -> None:
    """Refuse a batch that cannot be simulated."""
    if count < 1:
        raise ValueError(f"QuadSim of {count} environments; expected 1 or more")
    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator {integrator!r}; expected one of {INTEGRATORS}")
    for name, value in times.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} {value} s; expected a finite, positive time")


class QuadSim:
    """Batched quadrotor: command queue, rate controller, motors, battery, aerodynamics, external
    wrench.

    All arrays live on the device and keep their addresses for life, so a captured graph of ``step``
    or ``reset`` stays valid. Bit :data:`sim.kernels.state.NONFINITE` of ``state.status`` tells that
    a step led to a bad state and was undone, or that its command was not finite and the last one
    was held.

    Attributes:
        command: collective thrust [N] and body rates [rad/s] of the next step, shape (E,) of vec4.
        force_w: external force at the centre of mass [N], shape (E,) of vec3, world frame; held
            over a step.
        torque_b: external torque about it [N m], shape (E,) of vec3, body frame.
        state: arrays of :data:`FIELDS`.
        start: arrays of :data:`START_FIELDS`, to which ``reset`` puts an environment back; may be
            written to.
    """

    def __init__(
        self,
        vehicle: VehicleParams,
        count: int,
        integrator: str = "rk4",
        step: float = 0.002,
        control_period: float = 0.02,
        device: str = "cpu",
        precision: str = "float32",
        *,
        vehicles: list[VehicleParams] | None = None,
        air: AirParams = AirParams(),
        gravity: float = GRAVITY,
    ):
        """Allocate ``count`` quadrotors at the origin, in hover.

        Raises ValueError: no environment, an unknown integrator or precision, a step or period that
        is not positive, vehicles of other kinds of blocks, or an unphysical parameter.

        Args:
            vehicle: its kinds of blocks hold for all.
            count: number of environments E.
            integrator: "euler" or "rk4".
            step: largest integration step [s]; steps end on command switches. Full-range commands
                keep the mixer at its
                limits: after a second of them RK4 is 0.6 mm off at 2 ms, 0.04 mm at 0.5 ms.
            control_period: time that :meth:`step` advances [s].
            device: Warp device, "cpu" or "cuda:0".
            precision: "float32" or "float64".
            vehicles: parameters of environment e at ``e % len(vehicles)``; default ``[vehicle]``.
            air: wind and ground effect, for all.
            gravity: acceleration of free fall, along -z [m/s^2].
        """
        _check(count, integrator, {"step": step, "control_period": control_period})
        vehicles = vehicles or [vehicle]
        t = types(precision)
        rows = pack_vehicle(t, vehicles, kinds_of(vehicle))
        self.vehicle = vehicle
        self.count = count
        self.device = device
        self.types = t
        self.integration_step = step
        self.control_period = control_period
        self.gravity = gravity
        extensions = extensions_of(vehicles, airs=[air])
        self._step, self._reset, State, Start = _built(precision, vehicle, integrator, extensions)
        self._vehicles = wp.array(rows, dtype=t.Vehicle, device=device)
        self._airs = wp.array(pack(t.Air, air), dtype=t.Air, device=device)
        depth = max(queue_depth(v.queue.delay, control_period) for v in vehicles)
        self.state = st.allocate(t, State, FIELDS, count, {"queue": depth}, device)
        self.start = st.allocate(t, Start, START_FIELDS, count, {}, device)
        self.command = wp.zeros(count, dtype=t.vec4, device=device)
        self.force_w = wp.zeros(count, dtype=t.vec3, device=device)
        self.torque_b = wp.zeros(count, dtype=t.vec3, device=device)
        self._all = wp.full(count, 1, dtype=wp.int32, device=device)
        self.place(np.zeros((count, 3)))

    def step(self) -> None:
        """Advance every quadrotor by one control period under ``command``, ``force_w`` and
        ``torque_b``.
        """
        given = [
            self._vehicles,
            self._airs,
            self.control_period,
            self.integration_step,
            self.gravity,
        ]
        given += [self.state, self.command, self.force_w, self.torque_b]
        wp.launch(self._step, self.count, given, device=self.device)

    def reset(self, mask: wp.array | None = None) -> None:
        """Put environments back to ``start``, in hover, where ``mask`` (shape (E,), int) is
        non-zero; all without one.
        """
        mask = self._all if mask is None else mask
        wp.launch(
            self._reset,
            self.count,
            [self._vehicles, self.gravity, self.state, self.start, mask],
            device=self.device,
        )

    def place(
        self,
        pos_w: np.ndarray,
        quat_wb: np.ndarray | None = None,
        vel_w: np.ndarray | None = None,
        rate_b: np.ndarray | None = None,
        battery_used: float = 0.0,
    ) -> None:
        """Set ``start`` for every environment and reset all.

        Raises ValueError: a shape that does not fit.

        Args:
            pos_w: [m], shape (E, 3).
            quat_wb: xyzw, shape (E, 4); default level.
            vel_w: [m/s], shape (E, 3).
            rate_b: [rad/s], shape (E, 3).
            battery_used: fraction of charge used.
        """
        zero = np.zeros(3)
        given = {
            "pos_w": (pos_w, zero),
            "quat_wb": (quat_wb, st.LEVEL),
            "vel_w": (vel_w, zero),
            "rate_b": (rate_b, zero),
        }
        st.put(self.types, self.start, given, self.count)
        self.start.charge_used.fill_(battery_used)
        self.reset()

    def set_command(self, command: np.ndarray) -> None:
        """Copy commands [N, rad/s], shape (E, 4), to the device.

        Raises ValueError for another shape.
        """
        st.put(self.types, self, {"command": (command, np.zeros(4))}, self.count)

    def set_wrench(self, force_w: np.ndarray, torque_b: np.ndarray) -> None:
        """Copy the external wrench [N], [N m], shapes (E, 3), to the device.

        Raises ValueError for another shape.
        """
        st.put(
            self.types,
            self,
            {"force_w": (force_w, np.zeros(3)), "torque_b": (torque_b, np.zeros(3))},
            self.count,
        )

    def get(self, name: str) -> np.ndarray:
        """Copy of a state array by name, shape (E, ...); the queue (E, D, 4).

        Raises ValueError for an unknown name.
        """
        if name not in FIELDS:
            raise ValueError(f"no array {name!r}; there are {sorted(FIELDS)}")
        return st.fetched(getattr(self.state, name), FIELDS[name][1])
