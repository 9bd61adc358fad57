"""Surrogate of one control step, which first-order training differentiates in the simulator's place, and its backward pass.

The simulator flies; every value below is the simulator's own, and the surrogate lends its derivative at that point. With
the response ``y = (thrust, body rates)``, commands u, vehicle p, v, R, payload q, s and the control period dt:

    y[k+1] = A0 y[k] + A1 y[k-1] + sum_j B_j u[k-j] + c         per channel: controller, motors and queue
    R[k+1] = R[k] exp(dt (w[k] + w[k+1]) / 2)
    f      = kappa F z - R diag(drag) R^T v                      F, z: mean thrust and mean body z of the step
    T      = mu (-a n.f / M + b |u_perp|^2 / l + c n.u / dt)     u = s - v; n, l: of the rope as a taut, massless rod
    v[k+1] = v + dt (f / M + g + T n / M),  s[k+1] = s + dt (g - T n / m),  mu = M m / (M + m)

and positions by the trapezoid. A0, A1, B, c, kappa, drag, a, b, c are fitted to flights of the simulator under random
commands by linear least squares. The backward pass is one kernel, a thread a flight, with derivatives written by hand;
a rotation's derivative is that by a turn about the body axes, R exp(turn).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from sim.quadrotor.queue import queue_depth
from visthrow.onboard import observations as ob
from visthrow.training.env import ThrowEnv

EXCITED = ((0.35, 0.5, 0.5, 0.5), 0.7)
"""Random commands of the fit: spread of the normalised actions about hover, and how much of one the next step keeps."""

SLACK_THROTTLE = 0.05
"""Least throttle at which the slope of the thrust is taken: at none it is nought, and nothing would lead away from there."""

TAUT = 0.1
"""Pull on the payload in its weights above which the rope counts as taut."""


VEC5 = wp.types.vector(5, float)


@wp.struct
class Course:
    """Course of flights or derivatives of a cost by it: steps first, (T + 1, E)."""

    pos: wp.array2d(dtype=wp.vec3)
    vel: wp.array2d(dtype=wp.vec3)
    turn: wp.array2d(dtype=wp.vec3)  # derivatives alone
    load_pos: wp.array2d(dtype=wp.vec3)
    load_vel: wp.array2d(dtype=wp.vec3)
    response: wp.array2d(dtype=wp.vec4)  # thrust, body rates
    command: wp.array2d(dtype=wp.vec4)
    quat: wp.array2d(dtype=wp.quat)  # flights alone


WIDTHS = {"pos": 3, "vel": 3, "turn": 3, "load_pos": 3, "load_vel": 3, "response": 4, "command": 4, "quat": 4}


class Flights:
    """Recorded flights, or derivatives by them: tensors of shape (T + 1, E, width) under the names of :class:`Course`.

    Attributes:
        steps: steps until the flight ended, shape (E,), int32: states 0 to ``steps`` are of one flight.
        course: the same memory for kernels.
    """

    def __init__(self, steps: int, count: int, device: str):
        self.tensors = {name: torch.zeros(steps + 1, count, width, device=device) for name, width in WIDTHS.items()}
        self.steps = torch.zeros(count, device=device, dtype=torch.int32)
        self.course = Course()
        for name, tensor in self.tensors.items():
            kind = {3: wp.vec3, 4: wp.quat if name == "quat" else wp.vec4}[WIDTHS[name]]
            setattr(self.course, name, wp.from_torch(tensor, dtype=kind))

    def __getattr__(self, name: str) -> Tensor:
        try:
            return self.__dict__["tensors"][name]
        except KeyError:
            raise AttributeError(name) from None

    def record(self, k: int, env: ThrowEnv, thrust_factor: Tensor) -> None:
        """Take down the environment's state as state k."""
        state, out = env.views.state, env.views.out
        sources = {"pos": state["pos_w"], "vel": state["vel_w"], "quat": state["quat_wb"],
                   "load_pos": out["payload_pos_w"], "load_vel": out["payload_vel_w"]}  # fmt: skip
        for name, source in sources.items():
            self.tensors[name][k].copy_(source)
        self.response[k, :, 0].copy_(thrust_factor * state["motor_speed"].square().sum(-1))
        self.response[k, :, 1:].copy_(state["rate_b"])


class Plants:
    """Masses, mounts and thrust factors of an environment's plants, each over (E,)."""

    def __init__(self, env: ThrowEnv):
        vehicle, rope = env.sim.plants()
        make = {"device": env.device, "dtype": torch.float32}
        self.body_mass = torch.tensor(vehicle["body"]["mass"], **make)
        self.rope_mass = torch.tensor(rope["total_mass"] - rope["payload_mass"], **make)
        self.load_mass = torch.tensor(rope["payload_mass"], **make)
        self.mount = torch.tensor(rope["mount"], **make)
        self.thrust_factor = torch.tensor(vehicle["thrust"]["k_f"], **make)

    def mass(self, env: ThrowEnv) -> Tensor:
        """Mass of the vehicles with the rope [kg], shape (E,)."""
        return self.body_mass * env.views.state["mass_scale"] + self.rope_mass


@dataclass
class Surrogate:
    """Fitted coefficients.

    Attributes:
        response: rows A0, A1, B_0, ..., B_(D-1), shape (2 + D, 4).
        force: kappa and the drag along the body axes [N s/m], shape (4,). tension: a, b, c, shape (3,).
        residual: root mean square of what the fit leaves of a step's change of response, momentum and tension, as shares
            of that change's own root mean square, shape (6,).
    """

    response: Tensor
    force: Tensor
    tension: Tensor
    residual: Tensor


def random_flights(env: ThrowEnv, plants: Plants, steps: int, watch: Callable[[Tensor], None]) -> tuple[Flights, Tensor]:
    """Flights under random commands from the task's starts, and the vehicles' masses; ``watch`` is shown what is observed."""
    flights = Flights(steps, env.num_envs, env.device)
    env.reset()
    mass = plants.mass(env).clone()
    spread, kept = EXCITED
    spread = torch.tensor([*spread, 0.0], device=env.device)
    hover = env.previous_action.clone()
    swing = torch.randn_like(hover) * spread
    alive = torch.ones(env.num_envs, device=env.device, dtype=torch.bool)
    flights.record(0, env, plants.thrust_factor)
    for k in range(steps):
        seen, _, done, _ = env.step(hover + swing, hold=True)
        watch(seen["actor"])
        flights.command[k].copy_(env.views.command)
        flights.record(k + 1, env, plants.thrust_factor)
        alive = alive & (done == 0)
        flights.steps += alive
        swing = kept * swing + (1.0 - kept**2) ** 0.5 * spread * torch.randn_like(swing)
    return flights, mass


def _solve(features: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Least-squares coefficients, and the root mean square left as a share of the target's."""
    features, target = features.double(), target.double()
    scale = features.square().mean(0).sqrt().clamp(min=1e-12)
    normal = (features / scale).T @ (features / scale)
    ridge = 1e-9 * len(features) * torch.eye(len(scale), dtype=normal.dtype, device=normal.device)
    found = torch.linalg.solve(normal + ridge, (features / scale).T @ target) / scale
    left = target - features @ found
    return found, (left.square().mean() / target.square().mean()).sqrt()


def fit(
    env: ThrowEnv, plants: Plants, watch: Callable[[Tensor], None] = lambda obs: None, steps: int = 40, least: int = 8000
) -> Surrogate:
    """Fit the surrogate to random flights of the environment's plants, at least ``least`` steps of them.

    ``watch`` is shown the actor's observations, shape (E, D), of each step.
    """
    period, lags = env.cfg.sim.control_period, max(queue_depth(env.cfg.vehicle.queue.delay, env.cfg.sim.control_period), 2)
    parts: list[dict[str, Tensor]] = []
    for _ in range(-(-least // (env.num_envs * steps)) + 1):
        flights, mass = random_flights(env, plants, steps, watch)
        k = torch.arange(lags, steps, device=env.device)
        whole = k[:, None] < flights.steps
        parts.append(_regressors(flights, plants, mass, k, lags, period, whole))
    rows = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    response, residual = [], []
    for c in range(4):
        found, left = _solve(rows["lagged"][..., c], rows["next"][:, c])
        response.append(found[:-1])
        change = (rows["next"] - rows["lagged"][:, 0])[:, c].square().mean().sqrt()
        residual.append(left * rows["next"][:, c].square().mean().sqrt() / change)
    force, left = _solve(rows["push"].flatten(0, 1), rows["momentum"].flatten())
    residual.append(left)
    pulling = -(rows["along"] * (rows["push"] @ force.float())).sum(-1) / rows["mass"]
    pull = torch.stack([pulling, *rows["swing"].unbind(-1)], -1) * (rows["reduced"] * rows["taut"])[:, None]
    tension, left = _solve(pull, rows["tension"] * rows["taut"])
    residual.append(left)
    return Surrogate(*(x.float() for x in (torch.stack(response, -1), force, tension, torch.stack(residual))))


def _regressors(f: Flights, plants: Plants, mass: Tensor, k: Tensor, lags: int, period: float, whole: Tensor) -> dict:
    """Rows of the three regressions from the steps ``k`` of flights, where ``whole``."""
    lagged = [f.response[k], f.response[k - 1], *(f.command[k - j] for j in range(lags))]
    rot = ob.rotation_from_quat(f.quat)
    thrust_w = (0.5 * (f.response[k, :, :1] + f.response[k + 1, :, :1])) * 0.5 * (rot[k, :, :, 2] + rot[k + 1, :, :, 2])
    load_mass = plants.load_mass[:, None]
    drag = [-rot[k, :, :, i] * (rot[k, :, :, i] * f.vel[k]).sum(-1, keepdim=True) for i in range(3)]
    gravity = torch.tensor([0.0, 0.0, GRAVITY], device=f.vel.device)
    load_force = load_mass * ((f.load_vel[k + 1] - f.load_vel[k]) / period + gravity)
    momentum = mass[:, None] * ((f.vel[k + 1] - f.vel[k]) / period + gravity) + load_force
    arm = f.load_pos - f.pos - (rot @ plants.mount[:, :, None]).squeeze(-1)
    arm = 0.5 * (arm[k] + arm[k + 1])
    length = arm.norm(dim=-1)
    n = arm / length[..., None]
    u = 0.5 * (f.load_vel[k] - f.vel[k] + f.load_vel[k + 1] - f.vel[k + 1])
    along = (n * u).sum(-1)
    reduced = mass * plants.load_mass / (mass + plants.load_mass)
    swing = torch.stack([(u.square().sum(-1) - along.square()) / length, along / period], -1)
    tension = -(n * load_force).sum(-1)
    return {
        "next": f.response[k + 1][whole],
        "lagged": torch.stack([*lagged, torch.ones_like(lagged[0])], -2)[whole],
        "push": torch.stack([thrust_w, *drag], -1)[whole],
        "momentum": momentum[whole],
        "along": n[whole],
        "swing": swing[whole],
        "mass": mass.expand(len(k), -1)[whole],
        "reduced": reduced.expand(len(k), -1)[whole],
        "tension": tension[whole],
        "taut": (tension > TAUT * GRAVITY * plants.load_mass)[whole].float(),
    }


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
        g_n = pull * both + g_pull * (p.tension[2] / dt * u - p.tension[0] / mass * f) - 2.0 * swing * along * u
        g_u = 2.0 * swing * across + g_pull * p.tension[2] / dt * n
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
