"""World P1: the rope as fifteen rods on ball joints in MuJoCo, RK4; the vehicle's actuators beside it.

The actuators advance by the midpoint rule with the motion that MuJoCo finds; their wrench acts in the body frame through
actuators on the centre of mass, so that MuJoCo turns it with the vehicle within a step. Armature 0; the rods' inertia about
their axes is so small that the twist that the joints' damping passes on matters to nothing.
"""

import mujoco
import numpy as np
import warp as wp

from tests.worlds.vehicle import REAL, V3, V4, Body, Numbers, along, ball_force, rotation, vehicle_load

SEGMENTS = 15
TWIST = 2e-8
"""Inertia of a rod about its axis [kg m^2]: at rest relative to its neighbours within a few milliseconds."""
STEP = 5e-4
TAUT = 3.0
"""Pull [N] up to which RK4 follows the chain's highest mode, sqrt(12 T / (m l)) for rods of mass m and length l, at ``STEP``."""
SLACK = 0.2
"""Pull [N] below which a snap may come within a millisecond, and share of the step that is then taken."""


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
def midpoint(
    numbers: wp.array(dtype=Numbers), bodies: wp.array(dtype=Body), middle: wp.array(dtype=Body),
    commands: wp.array(dtype=V4), push: wp.array(dtype=V3), twist: wp.array(dtype=V3), ball_v: wp.array(dtype=V3),
    h: REAL, last: wp.int32, force: wp.array(dtype=V3), torque: wp.array(dtype=V3), on_ball: wp.array(dtype=V3),
):  # fmt: skip
    """Wrench half a step ahead (``last`` 0), or the inner states over the whole step by their rate there (``last`` 1)."""
    i = wp.tid()
    p, b = numbers[i], bodies[i]
    if last == 0:
        _f, _t, _thrust, d0 = vehicle_load(p, b, commands[i], V3(), V3())
        middle[i] = inner(middle[i], along(b, d0, REAL(0.5) * h))
    m = middle[i]
    f, t, thrust, d = vehicle_load(p, m, commands[i], push[i], twist[i])
    if last == 0:
        rot = rotation(m.q)
        force[i] = wp.transpose(rot) * f
        torque[i] = t
        on_ball[i] = ball_force(p, ball_v[i], rot, thrust, 1)
    else:
        bodies[i] = inner(b, along(b, d, h))


def model_of(w) -> mujoco.MjModel:
    """MuJoCo model of one world's vehicle and rope."""
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, -9.81]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint()
    body.mass, body.ipos, body.inertia, body.explicitinertial = w.mass, w.com.tolist(), w.inertia.tolist(), True
    body.add_site(name="centre", pos=w.com.tolist())
    for i in range(6):
        gear = [0.0] * 6
        gear[i] = 1.0
        spec.add_actuator(name=f"a{i}", trntype=mujoco.mjtTrn.mjTRN_SITE, target="centre", gear=gear)
    length, mass = w.length / SEGMENTS, w.rope_mass / SEGMENTS
    parent, at = body, w.mount.tolist()
    for i in range(SEGMENTS):
        rod = parent.add_body(name=f"rod{i}", pos=at)
        total, centre, inertia = mass, length / 2, mass * length**2 / 12
        if i == SEGMENTS - 1:
            reach = length + w.ball_reach
            total = mass + w.ball_mass
            centre = (mass * length / 2 + w.ball_mass * reach) / total
            inertia += w.ball_inertia + mass * (centre - length / 2) ** 2 + w.ball_mass * (reach - centre) ** 2
            rod.add_site(name="ball", pos=[0.0, 0.0, -reach])
        rod.mass, rod.ipos, rod.inertia, rod.explicitinertial = total, [0.0, 0.0, -centre], [inertia, inertia, TWIST], True
        rod.add_joint(type=mujoco.mjtJoint.mjJNT_BALL).damping[0] = w.joint_damping
        parent, at = rod, [0.0, 0.0, -length]
    return spec.compile()


class Chain:
    """The hanging phase of a set of lanes."""

    def __init__(self, worlds, bodies: np.ndarray, numbers: wp.array):
        for w in worlds:
            if w.bending or w.stretch or w.joint_damping_square:
                raise ValueError("the chain of MuJoCo has no bending, stretch or quadratic joint damping")
        cache, count = {}, len(worlds)
        self.models = [cache.setdefault(repr(vars(w)), model_of(w)) for w in worlds]
        self.data = [mujoco.MjData(m) for m in self.models]
        self.worlds, self._com = worlds, np.array([w.com for w in worlds])
        self.site = [m.site("ball").id for m in self.models]
        self.rod = [m.body(f"rod{SEGMENTS - 1}").id for m in self.models]
        self._drag = np.array([w.rope_drag for w in worlds])
        # Arrays of the kernel, and views of them: on the CPU both are the same memory.
        shared = {"bodies": Body, "middle": Body, "commands": V4, "push": V3, "twist": V3, "ball_v": V3}
        arrays = {k: wp.zeros(count, dtype=d) for k, d in (shared | {"force": V3, "torque": V3, "on_ball": V3}).items()}
        self._in = [numbers] + [arrays[k] for k in shared]
        self._out = [arrays[k] for k in ("force", "torque", "on_ball")]
        self._view = {k: v.numpy() for k, v in arrays.items()}
        self.bodies, self.ball_v = self._view["bodies"], self._view["ball_v"]
        self.bodies[:] = bodies
        self._view["middle"][:] = bodies
        for d, b, com in zip(self.data, self.bodies, self._com):
            d.qpos[:3], d.qpos[3:7] = b["x"] - com, b["q"]
        self._before = self.bodies.copy()
        self.hanging = np.ones(count, dtype=bool)
        self.ball_x = np.zeros((count, 3))
        self.tension = np.array([9.81 * (w.ball_mass + w.rope_mass) for w in worlds])
        self._seen = 0.0
        self.look(1.0)

    def look(self, now: float) -> None:
        """Positions and velocities of the hanging balls, and the ropes' tension from what they did since the last look."""
        since = max(now - self._seen, 1e-4)
        self._seen = now
        out = np.zeros(6)
        for e in np.flatnonzero(self.hanging):
            m, d, w = self.models[e], self.data[e], self.worlds[e]
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            mujoco.mj_comVel(m, d)
            mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_SITE, self.site[e], out, 0)
            pull = (out[3:] - self.ball_v[e]) / since + [0.0, 0.0, 9.81]
            self.tension[e] = (w.ball_mass + w.rope_mass) * np.linalg.norm(pull)
            self.ball_x[e], self.ball_v[e] = d.site_xpos[self.site[e]], out[3:]

    def _step(self, lanes: np.ndarray) -> float:
        """Integration step for the ropes' pull at the last look [s]."""
        pull = self.tension[lanes]
        share = np.where(pull < SLACK, SLACK, np.minimum(1.0, np.sqrt(TAUT / np.maximum(pull, SLACK))))
        return STEP * float(share.min())

    def run(self, start: float, stop: float, commands: np.ndarray, push, twist, ball) -> None:
        """Advance the hanging lanes from ``start`` to ``stop`` under constant commands and gusts."""
        lanes = np.flatnonzero(self.hanging)
        if not len(lanes) or stop - start < 1e-9:
            return
        count = max(1, int(np.ceil((stop - start) / self._step(lanes) - 1e-9)))
        h = (stop - start) / count
        v, b, m = self._view, self.bodies, self._view["middle"]
        v["commands"][:], v["push"][:], v["twist"][:] = commands, push, twist
        loads = ball.copy()
        for e in lanes:
            self.models[e].opt.timestep = h
            if self._drag[e]:
                n = self.ball_x[e] - self.data[e].xpos[self.rod[e]]
                n /= np.linalg.norm(n)
                loads[e] -= self._drag[e] * (self.ball_v[e] - n * (n @ self.ball_v[e]))
        for _ in range(count):
            # Half a step ahead: turning and moving as over the last step, actuators by their own rates.
            m["v"] = b["v"] + 0.5 * (b["v"] - self._before["v"])
            m["w"] = b["w"] + 0.5 * (b["w"] - self._before["w"])
            m["x"] = b["x"] + 0.5 * h * b["v"]
            q, r = b["q"], 0.25 * h * m["w"]
            m["q"][:, 0] = q[:, 0] - (q[:, 1:] * r).sum(1)
            m["q"][:, 1:] = q[:, 1:] + q[:, :1] * r + np.cross(q[:, 1:], r)
            m["q"] /= np.linalg.norm(m["q"], axis=1, keepdims=True)
            self._before = b.copy()
            wp.launch(midpoint, len(b), [*self._in, h, 0, *self._out])
            on_ball = v["on_ball"] + loads
            for e in lanes:
                d = self.data[e]
                d.ctrl[:3], d.ctrl[3:] = v["force"][e], v["torque"][e]
                d.xfrc_applied[self.rod[e], :3] = on_ball[e]
                # MuJoCo applies it at the rod's centre of mass; the couple moves it to the ball's centre.
                d.xfrc_applied[self.rod[e], 3:] = np.cross(self.ball_x[e] - d.xipos[self.rod[e]], on_ball[e])
                mujoco.mj_step(self.models[e], d)
                b["x"][e], b["q"][e], b["v"][e], b["w"][e] = d.qpos[:3], d.qpos[3:7], d.qvel[:3], d.qvel[3:6]
            if self._com.any():
                q, c = b["q"], self._com
                side = 2 * np.cross(q[:, 1:], c)
                b["x"][lanes] += (c + q[:, :1] * side + np.cross(q[:, 1:], side))[lanes]
                c = np.cross(b["w"], c)
                side = 2 * np.cross(q[:, 1:], c)
                b["v"][lanes] += (c + q[:, :1] * side + np.cross(q[:, 1:], side))[lanes]
            for name in ("x", "v", "w", "q"):
                m[name] = 0.5 * (self._before[name] + b[name])
            wp.launch(midpoint, len(b), [*self._in, h, 1, *self._out])
        if any(self.data[e].warning.number.any() for e in lanes):
            raise RuntimeError(f"MuJoCo's chain became unstable at {stop:.4f} s with a pull of {self.tension[lanes].max():.1f} N")
