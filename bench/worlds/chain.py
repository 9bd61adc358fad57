"""World P1: the rope as fifteen rods on ball joints in MuJoCo, RK4; the vehicle's actuators beside
it.

The actuators advance by the midpoint rule with the motion that MuJoCo finds; their wrench acts in
the body frame through actuators on the centre of mass, so that MuJoCo turns it with the vehicle
within a step. Armature 0; the rods' inertia about their axes is so small that the twist that the
joints' damping passes on matters to nothing."""

import mujoco
import numpy as np
import warp as wp

from bench.worlds.vehicle import (
    REAL,
    V3,
    V4,
    Body,
    Numbers,
    along,
    ball_force,
    rotation,
    vehicle_load,
)

SEGMENTS = 15
TWIST = 2e-8
"""Inertia of a rod about its axis [kg m^2]: at rest relative to its neighbours within a few
milliseconds.
"""
STEP = 5e-4
TAUT = 3.0
"""Pull [N] up to which RK4 follows the chain's highest mode, sqrt(12 T / (m l)) for rods of mass m
and length l, at ``STEP``.
"""
SLACK = 0.2
"""Pull [N] below which a snap may come within a millisecond, and share of the step that is then
taken.
"""


@wp.func
def inner(b: Body, of: Body):
    """Motion of one state with the actuators and battery of another."""
    out = b
    out.spin = of.spin
    out.integral = of.integral
    out.stick = of.stick
    out.gyro = of.gyro
    out.used = of.used
    out.volt = of.volt
    return out


@wp.kernel(module="unique", enable_backward=False)
def ahead(
    numbers: wp.array(dtype=Numbers),
    bodies: wp.array(dtype=Body),
    middle: wp.array(dtype=Body),
    before: wp.array(dtype=Body),
    commands: wp.array(dtype=V4),
    push: wp.array(dtype=V3),
    twist: wp.array(dtype=V3),
    ball_v: wp.array(dtype=V3),
    h: REAL,
    force: wp.array(dtype=V3),
    torque: wp.array(dtype=V3),
    on_ball: wp.array(dtype=V3),
):
    """Wrench half a step ahead, in the body frame: turning and moving as over the last step,
    actuators by their own rates.
    """
    i = wp.tid()
    p = numbers[i]
    b = bodies[i]
    m = inner(b, b)
    m.v = b.v + REAL(0.5) * (b.v - before[i].v)
    m.w = b.w + REAL(0.5) * (b.w - before[i].w)
    m.x = b.x + REAL(0.5) * h * b.v
    axis = V3(b.q[1], b.q[2], b.q[3])
    turn = REAL(0.25) * h * m.w
    side = axis + b.q[0] * turn + wp.cross(axis, turn)
    m.q = wp.normalize(V4(b.q[0] - wp.dot(axis, turn), side[0], side[1], side[2]))
    before[i] = b
    _f, _t, _thrust, rates = vehicle_load(p, b, commands[i], V3(), V3())
    m = inner(m, along(b, rates, REAL(0.5) * h))
    middle[i] = m
    f, t, thrust, _rates = vehicle_load(p, m, commands[i], push[i], twist[i])
    rot = rotation(m.q)
    force[i] = wp.transpose(rot) * f
    torque[i] = t
    on_ball[i] = ball_force(p, ball_v[i], rot, thrust, 1)


@wp.kernel(module="unique", enable_backward=False)
def behind(
    numbers: wp.array(dtype=Numbers),
    bodies: wp.array(dtype=Body),
    middle: wp.array(dtype=Body),
    before: wp.array(dtype=Body),
    commands: wp.array(dtype=V4),
    push: wp.array(dtype=V3),
    twist: wp.array(dtype=V3),
    hanging: wp.array(dtype=wp.bool),
    h: REAL,
):
    """From the frame's origin to the centre of mass, and the inner states over the whole step by
    their rates half-way.
    """
    i = wp.tid()
    p = numbers[i]
    was = before[i]
    b = inner(bodies[i], bodies[i])
    m = inner(bodies[i], middle[i])
    if hanging[i]:
        rot = rotation(b.q)
        b.x += rot * p.com
        b.v += rot * wp.cross(b.w, p.com)
    m.x = REAL(0.5) * (was.x + b.x)
    m.v = REAL(0.5) * (was.v + b.v)
    m.w = REAL(0.5) * (was.w + b.w)
    m.q = REAL(0.5) * (was.q + b.q)
    middle[i] = m
    _f, _t, _thrust, rates = vehicle_load(p, m, commands[i], push[i], twist[i])
    bodies[i] = inner(b, along(b, rates, h))


def model_of(w) -> mujoco.MjModel:
    """MuJoCo model of one world's vehicle and rope."""
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, -9.81]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint()
    body.mass = w.mass
    body.ipos = w.com.tolist()
    body.inertia = w.inertia.tolist()
    body.explicitinertial = True
    body.add_site(name="centre", pos=w.com.tolist())
    for i in range(6):
        gear = [0.0] * 6
        gear[i] = 1.0
        spec.add_actuator(
            name=f"a{i}", trntype=mujoco.mjtTrn.mjTRN_SITE, target="centre", gear=gear
        )
    length = w.length / SEGMENTS
    mass = w.rope_mass / SEGMENTS
    parent = body
    at = w.mount.tolist()
    for i in range(SEGMENTS):
        rod = parent.add_body(name=f"rod{i}", pos=at)
        total = mass
        centre = length / 2
        inertia = mass * length**2 / 12
        if i == SEGMENTS - 1:
            reach = length + w.ball_reach
            total = mass + w.ball_mass
            centre = (mass * length / 2 + w.ball_mass * reach) / total
            inertia += (
                w.ball_inertia
                + mass * (centre - length / 2) ** 2
                + w.ball_mass * (reach - centre) ** 2
            )
            rod.add_site(name="ball", pos=[0.0, 0.0, -reach])
        rod.mass = total
        rod.ipos = [0.0, 0.0, -centre]
        rod.inertia = [inertia, inertia, TWIST]
        rod.explicitinertial = True
        rod.add_joint(type=mujoco.mjtJoint.mjJNT_BALL).damping[0] = w.joint_damping
        parent = rod
        at = [0.0, 0.0, -length]
    return spec.compile()


class Chain:
    """The hanging phase of a set of lanes."""

    def __init__(self, worlds, bodies: np.ndarray, numbers: wp.array):
        for w in worlds:
            if w.bending or w.stretch or w.joint_damping_square:
                raise ValueError(
                    "the chain of MuJoCo has no bending, stretch or quadratic joint damping"
                )
        cache = {}
        count = len(worlds)
        self.models = [cache.setdefault(repr(vars(w)), model_of(w)) for w in worlds]
        self.data = [mujoco.MjData(m) for m in self.models]
        self.worlds = worlds
        self.site = [m.site("ball").id for m in self.models]
        self.rod = [m.body(f"rod{SEGMENTS - 1}").id for m in self.models]
        self._drag = np.array([w.rope_drag for w in worlds])
        # Arrays of the kernels, and views of them: on the CPU both are the same memory.
        kinds = {"bodies": Body, "middle": Body, "before": Body, "commands": V4} | dict.fromkeys(
            ("push", "twist", "ball_v", "force", "torque", "on_ball"), V3
        )
        arrays = {k: wp.zeros(count, dtype=d) for k, d in kinds.items()} | {
            "hanging": wp.full(count, True, dtype=wp.bool)
        }
        state = [
            numbers,
            *(arrays[k] for k in ("bodies", "middle", "before", "commands", "push", "twist")),
        ]
        loads = [arrays[k] for k in ("force", "torque", "on_ball")]
        self._ahead = wp.launch(
            ahead, count, [*state, arrays["ball_v"], 0.0, *loads], record_cmd=True
        )
        self._behind = wp.launch(behind, count, [*state, arrays["hanging"], 0.0], record_cmd=True)
        self._view = {k: v.numpy() for k, v in arrays.items()}
        self.bodies = self._view["bodies"]
        self.ball_v = self._view["ball_v"]
        self.hanging = self._view["hanging"]
        self.bodies[:] = bodies
        self._view["middle"][:] = bodies
        for d, b, w in zip(self.data, self.bodies, worlds):
            d.qpos[:3] = b["x"] - w.com
            d.qpos[3:7] = b["q"]
        self._view["before"][:] = self.bodies
        self.ball_x = np.zeros((count, 3))
        self.tension = np.array([9.81 * (w.ball_mass + w.rope_mass) for w in worlds])
        self._last_look = 0.0
        self.look(1.0)

    def look(self, now: float) -> None:
        """Positions and velocities of the hanging balls, and the ropes' tension from what they did
        since the last look.
        """
        since = max(now - self._last_look, 1e-4)
        self._last_look = now
        out = np.zeros(6)
        for e in np.flatnonzero(self.hanging):
            m = self.models[e]
            d = self.data[e]
            w = self.worlds[e]
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            mujoco.mj_comVel(m, d)
            mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_SITE, self.site[e], out, 0)
            pull = (out[3:] - self.ball_v[e]) / since + [0.0, 0.0, 9.81]
            self.tension[e] = (w.ball_mass + w.rope_mass) * np.linalg.norm(pull)
            self.ball_x[e] = d.site_xpos[self.site[e]]
            self.ball_v[e] = out[3:]

    def _step(self, lanes: np.ndarray) -> float:
        """Integration step for the ropes' pull at the last look [s]."""
        pull = self.tension[lanes]
        share = np.where(
            pull < SLACK, SLACK, np.minimum(1.0, np.sqrt(TAUT / np.maximum(pull, SLACK)))
        )
        return STEP * float(share.min())

    def run(self, start: float, stop: float, commands: np.ndarray, push, twist, ball) -> None:
        """Advance the hanging lanes from ``start`` to ``stop`` under constant commands
        and gusts.
        """
        lanes = np.flatnonzero(self.hanging)
        if not len(lanes) or stop - start < 1e-9:
            return
        count = max(1, int(np.ceil((stop - start) / self._step(lanes) - 1e-9)))
        h = (stop - start) / count
        v = self._view
        b = self.bodies
        v["commands"][:] = commands
        v["push"][:] = push
        v["twist"][:] = twist
        loads = ball.copy()
        for e in lanes:
            self.models[e].opt.timestep = h
            if self._drag[e]:
                n = self.ball_x[e] - self.data[e].xpos[self.rod[e]]
                n /= np.linalg.norm(n)
                loads[e] -= self._drag[e] * (self.ball_v[e] - n * (n @ self.ball_v[e]))
        self._ahead.set_param_by_name("h", h)
        self._behind.set_param_by_name("h", h)
        x = b["x"]
        q = b["q"]
        speed = b["v"]
        rate = b["w"]
        for _ in range(count):
            self._ahead.launch()
            on_ball = v["on_ball"] + loads
            for e in lanes:
                d = self.data[e]
                rod = self.rod[e]
                d.ctrl[:3] = v["force"][e]
                d.ctrl[3:] = v["torque"][e]
                # MuJoCo applies it at the rod's centre of mass; the couple moves it to the ball's
                # centre.
                a0, a1, a2 = (self.ball_x[e] - d.xipos[rod]).tolist()
                f0, f1, f2 = on_ball[e].tolist()
                d.xfrc_applied[rod] = (
                    f0,
                    f1,
                    f2,
                    a1 * f2 - a2 * f1,
                    a2 * f0 - a0 * f2,
                    a0 * f1 - a1 * f0,
                )
                mujoco.mj_step(self.models[e], d)
                x[e] = d.qpos[:3]
                q[e] = d.qpos[3:7]
                speed[e] = d.qvel[:3]
                rate[e] = d.qvel[3:6]
            self._behind.launch()
        if any(self.data[e].warning.number.any() for e in lanes):
            raise RuntimeError(
                f"MuJoCo's chain became unstable at {stop:.4f} s with a pull of"
                f" {self.tension[lanes].max():.1f} N"
            )
