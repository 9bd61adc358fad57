"""Surrogate of one control step, which first-order training differentiates in the simulator's place, and its backward pass.

The simulator flies; every value below is the simulator's own, and the surrogate lends its derivative at that point. With
the response ``y = (thrust, body rates)``, commands u, vehicle p, v, R, payload q, s and the control period dt:

    y[k+1] = A0 y[k] + A1 y[k-1] + sum_j B_j u[k-j] + c         per channel: controller, motors and queue
    R[k+1] = R[k] exp(dt (w[k] + w[k+1]) / 2)
    f      = kappa F z - R diag(drag) R^T v                      F, z: mean thrust and mean body z of the step
    T      = mu (-a n.f / M + b |u_perp|^2 / l)                  u = s - v; n, l: of the rope as a taut, massless rod
    v[k+1] = v + dt (f / M + g + T n / M),  s[k+1] = s + dt (g - T n / m),  mu = M m / (M + m)

and positions by the trapezoid. A0, A1, B, c, kappa, drag, a and b are fitted to flights of the simulator under random
commands by linear least squares. The backward pass is one kernel, a thread a flight, with derivatives written by hand;
a rotation's derivative is that by a turn about the body axes, R exp(turn).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from sim.quadrotor.queue import queue_depth
from visthrow.onboard import observations as ob
from visthrow.training.env import ThrowEnv

EXCITED, KEPT = (0.35, 0.5, 0.5, 0.5, 0.0), 0.7
"""Random actions of the fit: spread about hover, and the share of one that the next keeps."""
FITTED = 8000
"""Steps of flight that the fit rests on."""
SLACK_THROTTLE = 0.05
"""Least throttle at which the slope of the thrust is taken: at none it is nought, and nothing would lead away from there."""
TAUT = 0.1
"""Pull on the payload in its weights above which the rope counts as taut."""

VEC5 = wp.types.vector(5, float)


@wp.struct
class Course:
    """Course of flights, or derivatives of a cost by it: (T + 1, E)."""

    pos: wp.array2d(dtype=wp.vec3)
    vel: wp.array2d(dtype=wp.vec3)
    turn: wp.array2d(dtype=wp.vec3)  # derivatives alone
    load_pos: wp.array2d(dtype=wp.vec3)
    load_vel: wp.array2d(dtype=wp.vec3)
    response: wp.array2d(dtype=wp.vec4)  # thrust, body rates
    command: wp.array2d(dtype=wp.vec4)
    quat: wp.array2d(dtype=wp.quat)  # flights alone


class Plants(NamedTuple):
    """An environment's plants, each over (E,)."""

    body_mass: Tensor
    rope_mass: Tensor
    load_mass: Tensor
    mount: Tensor
    thrust_factor: Tensor

    @staticmethod
    def of(env: ThrowEnv) -> "Plants":
        """Those of an environment."""
        vehicle, rope = env.sim.plants()
        rope_mass = rope["total_mass"] - rope["payload_mass"]
        rows = (vehicle["body"]["mass"], rope_mass, rope["payload_mass"], rope["mount"], vehicle["thrust"]["k_f"])
        return Plants(*(torch.tensor(row, device=env.device, dtype=torch.float32) for row in rows))


class Flights:
    """Recorded flights, or derivatives by them.

    Attributes:
        x: tensors of shape (T + 1, E, 3 or 4) under the names of :class:`Course`; the same memory for kernels: ``course``.
        steps: until the flight ended, shape (E,), int32: states 0 to ``steps`` are of one flight. mass: of the vehicles, the
            rope included [kg], shape (E,).
    """

    def __init__(self, steps: int, count: int, device: str):
        kinds = {name: field.type.dtype for name, field in Course.vars.items()}
        self.x = {name: torch.zeros(steps + 1, count, kind._length_, device=device) for name, kind in kinds.items()}
        self.course = Course()
        for name, kind in kinds.items():
            setattr(self.course, name, wp.from_torch(self.x[name], dtype=kind))
        self.steps, self.mass = torch.zeros(count, device=device, dtype=torch.int32), torch.zeros(count, device=device)

    def fly(self, env: ThrowEnv, plants: Plants, act: Callable[[int, Tensor], Tensor], passed: Callable[[int], None]) -> None:
        """Fly from new starts without release; ``act(k, observations)``, then ``passed(k)`` at each state k, the last included."""
        state, out, x = env.views.state, env.views.out, self.x
        seen = env.reset()
        self.mass.copy_(plants.body_mass * state["mass_scale"] + plants.rope_mass)
        self.steps.zero_()
        alive = torch.ones_like(self.steps)
        for k in range(len(x["pos"])):
            for name, source in (("pos", state["pos_w"]), ("vel", state["vel_w"]), ("quat", state["quat_wb"]),
                                 ("load_pos", out["payload_pos_w"]), ("load_vel", out["payload_vel_w"])):  # fmt: skip
                x[name][k].copy_(source)
            x["response"][k, :, 0].copy_(plants.thrust_factor * state["motor_speed"].square().sum(-1))
            x["response"][k, :, 1:].copy_(state["rate_b"])
            passed(k)
            if k < len(x["pos"]) - 1:
                seen, _, done, _ = env.step(act(k, seen["actor"]), hold=True)
                x["command"][k].copy_(env.views.command)
                alive = alive * (done == 0)
                self.steps += alive


@dataclass
class Surrogate:
    """Fitted coefficients: rows A0, A1, B_0, ..., shape (2 + D, 4); kappa and drag [N s/m], shape (4,); a, b, shape (2,)."""

    response: Tensor
    force: Tensor
    tension: Tensor


def fit(env: ThrowEnv, plants: Plants, watch: Callable[[Tensor], None], steps: int = 40) -> Surrogate:
    """Fit the surrogate to random flights; ``watch`` is shown the actor's observations, shape (E, D), of each step."""
    period = env.cfg.sim.control_period
    lags = max(queue_depth(v.queue.delay, period) for v in env.sim.vehicles)
    flights, parts = Flights(steps, env.num_envs, env.device), []
    spread, hover = torch.tensor(EXCITED, device=env.device), env.previous_action.clone()
    swing = torch.randn_like(hover) * spread

    def act(k: int, seen: Tensor) -> Tensor:
        watch(seen)
        swing.mul_(KEPT).add_((1.0 - KEPT**2) ** 0.5 * spread * torch.randn_like(swing))
        return hover + swing

    for _ in range(FITTED // (env.num_envs * steps) + 1):
        flights.fly(env, plants, act, lambda k: None)
        parts.append(_regressors(flights, plants, lags, period))
    rows = {name: torch.cat([part[name] for part in parts]).double() for name in parts[0]}
    response = [_solve(rows["lagged"][..., c], rows["next"][:, c])[:-1] for c in range(4)]
    force = _solve(rows["push"].flatten(0, 1), rows["momentum"].flatten())
    pulled = -(rows["along"] * (rows["push"] @ force)).sum(-1) / rows["mass"]
    tension = _solve(torch.stack([pulled, rows["swing"]], -1) * rows["reduced"][:, None], rows["tension"])
    return Surrogate(*(x.float().contiguous() for x in (torch.stack(response, -1), force, tension)))


def _solve(features: Tensor, target: Tensor) -> Tensor:
    """Least-squares coefficients; what nothing excites gets none."""
    scale = features.square().mean(0).sqrt().clamp(min=1e-12)
    normal = (features / scale).mT @ (features / scale) / len(features)
    ridge = 1e-9 * torch.eye(len(scale), dtype=normal.dtype, device=normal.device)
    return torch.linalg.solve(normal + ridge, (features / scale).mT @ target / len(features)) / scale


def _regressors(flights: Flights, plants: Plants, lags: int, period: float) -> dict[str, Tensor]:
    """Rows of the three regressions from the whole steps of flights; those of the tension count where the rope is taut."""
    f, mass, load_mass = flights.x, flights.mass, plants.load_mass
    k = torch.arange(max(lags - 1, 1), len(f["pos"]) - 1, device=mass.device)
    rot, y = ob.rotation_from_quat(f["quat"]), f["response"]
    lagged = [y[k], y[k - 1], *(f["command"][k - j] for j in range(lags)), torch.ones_like(y[k])]
    thrust_w = 0.25 * (y[k, :, :1] + y[k + 1, :, :1]) * (rot[k, :, :, 2] + rot[k + 1, :, :, 2])
    drag = [-rot[k, :, :, i] * (rot[k, :, :, i] * f["vel"][k]).sum(-1, keepdim=True) for i in range(3)]
    gravity = torch.tensor([0.0, 0.0, GRAVITY], device=mass.device)
    load_force = load_mass[:, None] * ((f["load_vel"][k + 1] - f["load_vel"][k]) / period + gravity)
    momentum = mass[:, None] * ((f["vel"][k + 1] - f["vel"][k]) / period + gravity) + load_force
    arm = f["load_pos"] - f["pos"] - (rot @ plants.mount[:, :, None]).squeeze(-1)
    arm, u = (0.5 * (path[k] + path[k + 1]) for path in (arm, f["load_vel"] - f["vel"]))
    length = arm.norm(dim=-1)
    n = arm / length[..., None]
    tension = -(n * load_force).sum(-1)
    taut = tension > TAUT * GRAVITY * load_mass
    rows = {
        "next": y[k + 1],
        "lagged": torch.stack(lagged, -2),
        "push": torch.stack([thrust_w, *drag], -1),
        "momentum": momentum,
        "along": n,
        "mass": mass.expand_as(tension),
        "reduced": taut * mass * load_mass / (mass + load_mass),
        "swing": (u - (n * u).sum(-1, keepdim=True) * n).square().sum(-1) / length,
        "tension": tension * taut,
    }
    return {name: row[k[:, None] < flights.steps] for name, row in rows.items()}


@wp.struct
class Model:
    """The surrogate and what it is evaluated on."""

    response: wp.array(dtype=wp.vec4)
    force: wp.array(dtype=float)
    tension: wp.array(dtype=float)
    mass: wp.array(dtype=float)
    load_mass: wp.array(dtype=float)
    mount: wp.array(dtype=wp.vec3)
    max_thrust: float
    max_rate: wp.vec3
    period: float
    decay: float  # of derivatives, per step


@wp.struct
class Seen:
    """What the actor sees, and its derivatives."""

    age: wp.array(dtype=float)  # of poses [s]
    goal: wp.array(dtype=wp.vec3)
    corners: wp.array(dtype=wp.vec3)  # of the goal square, from the goal
    lens: wp.array3d(dtype=wp.vec3)  # (T, E, 16): of image coordinates by points in the body frame
    network: wp.array4d(dtype=float)  # (T, E, 5, D): of actions by observations


@wp.func
def turned(quat: wp.quat, arm_b: wp.vec3, grad_w: wp.vec3):
    """Derivative by the turn of what has the derivative ``grad_w`` by the world vector ``R arm_b``."""
    return wp.cross(arm_b, wp.quat_rotate_inv(quat, grad_w))


@wp.func
def step_back(p: Model, x: Course, adj: Course, k: int, e: int):
    """Add to the derivatives by state k, k - 1 and by the commands up to k what those by state k + 1 make of them."""
    dt = p.period
    half = 0.5 * dt
    mass = p.mass[e]
    load_mass = p.load_mass[e]
    mount = p.mount[e]
    up = wp.vec3(0.0, 0.0, 1.0)
    rot = x.quat[k, e]
    rot_next = x.quat[k + 1, e]
    g_pos = p.decay * adj.pos[k + 1, e]
    g_load = p.decay * adj.load_pos[k + 1, e]
    g_vel = p.decay * adj.vel[k + 1, e] + half * g_pos
    g_load_vel = p.decay * adj.load_vel[k + 1, e] + half * g_load
    g_turn = p.decay * adj.turn[k + 1, e]
    g_response = p.decay * adj.response[k + 1, e]

    z = 0.5 * (wp.quat_rotate(rot, up) + wp.quat_rotate(rot_next, up))
    thrust = 0.5 * p.force[0] * (x.response[k, e][0] + x.response[k + 1, e][0])
    drag = wp.vec3(p.force[1], p.force[2], p.force[3])
    f = thrust * z - wp.quat_rotate(rot, wp.cw_mul(drag, wp.quat_rotate_inv(rot, x.vel[k, e])))
    arm = 0.5 * (x.load_pos[k, e] - x.pos[k, e] + x.load_pos[k + 1, e] - x.pos[k + 1, e])
    arm = arm - 0.5 * (wp.quat_rotate(rot, mount) + wp.quat_rotate(rot_next, mount))
    length = wp.length(arm)
    n = arm / length
    u = 0.5 * (x.load_vel[k, e] - x.vel[k, e] + x.load_vel[k + 1, e] - x.vel[k + 1, e])
    along = wp.dot(n, u)
    across = u - along * n
    pull = -load_mass * wp.dot(n, (x.load_vel[k + 1, e] - x.load_vel[k, e]) / dt + GRAVITY * up)

    g_f = dt / mass * g_vel
    g_u = wp.vec3(0.0, 0.0, 0.0)
    g_arm = wp.vec3(0.0, 0.0, 0.0)
    if pull > TAUT * GRAVITY * load_mass:
        both = g_f - dt / load_mass * g_load_vel
        g_pull = wp.dot(n, both) * mass * load_mass / (mass + load_mass)
        swing = g_pull * p.tension[1] / length
        g_n = pull * both - g_pull * p.tension[0] / mass * f - 2.0 * swing * along * u
        g_u = 2.0 * swing * across
        g_f = g_f - g_pull * p.tension[0] / mass * n
        g_arm = (g_n - wp.dot(n, g_n) * n - swing * wp.dot(across, across) * n) / length

    g_z = 0.5 * thrust * g_f
    g_turn = g_turn + turned(rot_next, up, g_z)
    rates = x.response[k, e] + x.response[k + 1, e]
    phi = half * wp.vec3(rates[1], rates[2], rates[3])
    g_rate = half * (g_turn + 0.5 * wp.cross(phi, g_turn) + wp.cross(phi, wp.cross(phi, g_turn)) / 6.0)
    g_mean = wp.vec4(0.5 * p.force[0] * wp.dot(z, g_f), g_rate[0], g_rate[1], g_rate[2])
    g_response = g_response + g_mean
    adj.response[k, e] += g_mean + wp.cw_mul(p.response[0], g_response)
    if k > 0:
        adj.response[k - 1, e] += wp.cw_mul(p.response[1], g_response)
    for j in range(p.response.shape[0] - 2):
        if k >= j:
            adj.command[k - j, e] += wp.cw_mul(p.response[2 + j], g_response)
    adj.pos[k, e] += g_pos - g_arm
    adj.load_pos[k, e] += g_load + g_arm
    g_drag = wp.quat_rotate(rot, wp.cw_mul(drag, wp.quat_rotate_inv(rot, g_f)))
    adj.vel[k, e] += g_vel + half * (g_pos - g_arm) - g_u - g_drag
    adj.load_vel[k, e] += g_load_vel + half * (g_load + g_arm) + g_u
    before = wp.quat_rotate_inv(rot, wp.quat_rotate(rot_next, g_turn))
    adj.turn[k, e] += before + turned(rot, up, g_z) - turned(rot, mount, g_arm)


@lru_cache
def build_backward(layout: ob.Layout) -> wp.Kernel:
    """Backward pass of whole flights whose actor sees a layout, a thread a flight."""
    vision, history, width = layout.name == "vision", layout.history, layout.payload
    previous_at, goal_at, load_at = ob.VEHICLE, ob.VEHICLE + 5, ob.VEHICLE + 5 + layout.goal

    @wp.func
    def by(s: Seen, g: VEC5, k: int, e: int, i: int):
        """Derivative by entry i of observation k."""
        total = g[0] * s.network[k, e, 0, i]
        for j in range(1, 5):
            total += g[j] * s.network[k, e, j, i]
        return total

    @wp.func
    def by_three(s: Seen, g: VEC5, k: int, e: int, i: int):
        return wp.vec3(by(s, g, k, e, i), by(s, g, k, e, i + 1), by(s, g, k, e, i + 2))

    @wp.func
    def point_back(x: Course, adj: Course, i: int, e: int, point_w: wp.vec3, g_b: wp.vec3):
        """From the derivative by a point in the body frame to those by the pose that it is seen from."""
        adj.pos[i, e] -= wp.quat_rotate(x.quat[i, e], g_b)
        adj.turn[i, e] += wp.cross(g_b, wp.quat_rotate_inv(x.quat[i, e], point_w - x.pos[i, e]))

    @wp.func
    def vehicle_back(s: Seen, x: Course, adj: Course, g: VEC5, k: int, i: int, e: int, share: float):
        """From observation k to state i, of which ``share`` is in it: the vehicle and the goal."""
        adj.pos[i, e] += share * by_three(s, g, k, e, 0)
        adj.vel[i, e] += share * by_three(s, g, k, e, 3)
        rate = share * by_three(s, g, k, e, 6)
        adj.response[i, e] += wp.vec4(0.0, rate[0], rate[1], rate[2])
        x_axis = turned(x.quat[i, e], wp.vec3(1.0, 0.0, 0.0), by_three(s, g, k, e, 9))
        adj.turn[i, e] += share * (x_axis + turned(x.quat[i, e], wp.vec3(0.0, 1.0, 0.0), by_three(s, g, k, e, 12)))
        if wp.static(vision):
            for j in range(4):
                at = goal_at + 2 * j
                g_b = by(s, g, k, e, at) * s.lens[k, e, 2 * j] + by(s, g, k, e, at + 1) * s.lens[k, e, 2 * j + 1]
                point_back(x, adj, i, e, s.goal[e] + s.corners[j], share * g_b)
        else:
            adj.load_pos[i, e] -= share * wp.vec3(by(s, g, k, e, goal_at), by(s, g, k, e, goal_at + 1), 0.0)

    @wp.func
    def load_back(s: Seen, x: Course, adj: Course, g: VEC5, k: int, age: int, i: int, e: int, share: float):
        """From observation k to state i: the payload as it was ``age`` observations ago."""
        at = load_at + width * age
        if wp.static(vision):
            g_b = wp.vec3(0.0, 0.0, 0.0)
            for j in range(8):
                g_b += share * by(s, g, k, e, at + j) * s.lens[wp.max(k - age, 0), e, 8 + j]
            point_back(x, adj, i, e, x.load_pos[i, e], g_b)
            adj.load_pos[i, e] += wp.quat_rotate(x.quat[i, e], g_b)
        else:
            offset = share * by_three(s, g, k, e, at)
            adj.load_pos[i, e] += offset
            adj.pos[i, e] -= offset

    @wp.kernel(module="unique", enable_backward=False)
    def backward_kernel(
        # Params:
        p: Model,
        # State in:
        adj: Course,
        # In:
        x: Course,
        s: Seen,
        steps: wp.array(dtype=wp.int32),
        action: wp.array3d(dtype=float),
        # Out:
        by_clipped: wp.array3d(dtype=float),
        by_action: wp.array3d(dtype=float),
    ):
        e = wp.tid()
        late = s.age[e] / p.period
        for back in range(action.shape[0]):
            k = action.shape[0] - 1 - back
            if k <= steps[e]:
                if k < steps[e]:
                    step_back(p, x, adj, k, e)
                throttle = wp.clamp(0.5 * (action[k, e, 0] + 1.0), SLACK_THROTTLE, 1.0)
                scale = wp.vec4(p.max_thrust * throttle, p.max_rate[0], p.max_rate[1], p.max_rate[2])
                command = wp.cw_mul(scale, adj.command[k, e])
                g = VEC5()
                for j in range(5):
                    clipped = by_clipped[k, e, j]
                    if j < 4:
                        clipped += command[j]
                    if wp.abs(action[k, e, j]) > 1.0:
                        clipped = 0.0
                    g[j] = by_action[k, e, j] + clipped
                    by_action[k, e, j] = g[j]
                before = wp.max(k - 1, 0)
                if k > 0:
                    for j in range(5):
                        by_clipped[before, e, j] += by(s, g, k, e, previous_at + j)
                vehicle_back(s, x, adj, g, k, k, e, 1.0 - late)
                vehicle_back(s, x, adj, g, k, before, e, late)
                for age in range(history + 1):
                    load_back(s, x, adj, g, k, age, wp.max(k - age, 0), e, 1.0 - late)
                    load_back(s, x, adj, g, k, age, wp.max(k - age - 1, 0), e, late)

    return backward_kernel
