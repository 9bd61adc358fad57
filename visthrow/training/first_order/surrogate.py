"""Surrogate of one control step, which first-order training differentiates instead of the
simulator.

The values of all states come from the simulator; the surrogate supplies the derivatives at these
states. With the response ``y = (thrust, body rates)``, commands u, vehicle p, v, R, payload q, s
and the control period dt:

    y[k+1] = A0 y[k] + A1 y[k-1] + sum_j B_j u[k-j] + c
    R[k+1] = R[k] exp(dt (w[k] + w[k+1]) / 2)
    f      = kappa F z - R diag(drag) R^T v
    T      = mu (-a n.f / M + b |u_perp|^2 / l)
    v[k+1] = v + dt (f / M + g + T n / M),  s[k+1] = s + dt (g - T n / m),  mu = M m / (M + m)

The first line describes controller, motors and queue and holds for each channel. F and z are mean
thrust and mean body z axis of the step, u = s - v, and n and l are direction and length of the rope
as a taut, massless rod. Positions follow by the trapezoidal rule. A0, A1, B, c, kappa, drag, a and
b are fitted by linear least squares to simulated flights under random commands.
:mod:`visthrow.training.first_order.backward` computes the derivatives."""

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from sim.kernels.quadrotor.queue import queue_depth
from sim.params import GRAVITY
from sim.torch_bridge import on_torch_stream
from visthrow.onboard import actions
from visthrow.onboard import observations as ob
from visthrow.training.env import ThrowEnv

# standard deviation of random actions about hover; three times these values saturate the motors of
# a heavy vehicle, and the fitted thrust then responds to its command by only a fifth
ACTION_SPREAD = (0.1, 0.15, 0.15, 0.15, 0.0)
CORRELATION = 0.7  # correlation of successive random actions
FIT_STEPS = 8000  # steps of flight for the fit
TAUT = 0.1  # tension above which the rope counts as taut, in weights of the payload

STATES = ("pos", "vel", "quat", "load_pos", "load_vel", "response")


@wp.struct
class Course:
    """States of flights, (T + 1, E), with the derivatives of a cost by them as gradients."""

    pos: wp.array2d(dtype=wp.vec3)
    vel: wp.array2d(dtype=wp.vec3)
    quat: wp.array2d(dtype=wp.quat)
    load_pos: wp.array2d(dtype=wp.vec3)
    load_vel: wp.array2d(dtype=wp.vec3)
    response: wp.array2d(dtype=wp.vec4)  # thrust, body rates


class FlightBatch:
    """A batch of flights without release, and their plants.

    Attributes:
        x: states by :data:`STATES` and commands, shape (T + 1, E, 3 or 4). adjoint: derivatives by
            the states. course: both of these for kernels. made: the same derivatives, with other
            memory for the states.
        obs: the actor's observations, shape (T, E, D).
        landing: landing point of a payload that separates at a state [m], shape (T + 1, E, 2).
        time: its time of flight [s], shape (T + 1, E).
        mass, load_mass: masses of vehicles with their ropes and of payloads [kg], shape (E,).
        mount: mounts of the ropes [m], shape (E, 3), body frame.
        flying: whether a flight is in progress, int32, shape (E,).
        steps: number of steps until a flight ended, int32, shape (E,). last: that of the longest.
    """

    def __init__(self, env: ThrowEnv, steps: int):
        E = env.num_envs
        make = {"device": env.device}
        times = steps + 1
        self.env = env
        self.last = steps
        self.course = Course()
        self.made = Course()
        self.adjoint = {}
        self.x = {"command": torch.zeros(times, E, actions.COMMANDS, **make)}
        for name in STATES:
            dtype = Course.vars[name].type.dtype
            states, unused = (wp.zeros((times, E), dtype, env.device) for _ in range(2))
            states.requires_grad = True
            unused.grad = states.grad
            setattr(self.course, name, states)
            setattr(self.made, name, unused)
            self.x[name] = wp.to_torch(states, requires_grad=False)
            self.adjoint[name] = wp.to_torch(states.grad)
        self.obs = torch.zeros(steps, E, env.layout.dimension, **make)
        self.landing = torch.zeros(times, E, 2, **make)
        self.time = torch.zeros(times, E, **make)
        self.failed = torch.zeros(times, E, dtype=torch.bool, **make)
        self.flying, self.steps = (torch.zeros(E, dtype=torch.int32, **make) for _ in range(2))
        self._mask = wp.from_torch(self.flying)
        vehicle, rope = env.sim.plants()
        above = rope["total_mass"] - rope["payload_mass"]
        parts = (
            vehicle["body"]["mass"],
            above,
            rope["payload_mass"],
            rope["mount"],
            vehicle["thrust"]["k_f"],
        )
        self._body, self._rope, self.load_mass, self.mount, self._thrust = (
            torch.tensor(p, dtype=torch.float32, **make) for p in parts
        )
        self.mass = self._body + self._rope

    def mark_flown_steps(self) -> Tensor:
        """Return whether each flight was in progress at each step, bool, shape (T, E)."""
        return torch.arange(len(self.obs), device=self.steps.device)[:, None] <= self.steps

    def fly(self, act: Callable[[int, Tensor], Tensor | None]) -> None:
        """Fly from new starts with the actions ``act(k, observations)``, until it returns None."""
        env = self.env
        x = self.x
        views = env.views
        state = views.state
        out = views.out
        sources = {
            "pos": state["pos_w"],
            "vel": state["vel_w"],
            "quat": state["quat_wb"],
            "load_pos": out["payload_pos_w"],
            "load_vel": out["payload_vel_w"],
        }
        observation = env.reset()["actor"]
        self.mass.copy_(self._body * state["mass_scale"] + self._rope)
        self.flying[:] = 1
        self.steps[:] = 0
        for k in range(len(self.obs) + 1):
            with on_torch_stream(env.device):
                env.sim.foresee()
            for name, source in sources.items():
                x[name][k] = source
            x["response"][k, :, 0] = self._thrust * state["motor_speed"].square().sum(-1)
            x["response"][k, :, 1:] = state["rate_b"]
            self.failed[k] = env.find_failures()
            self.landing[k] = views.foreseen["landing_w"][:, :2]
            self.time[k] = views.foreseen["time_to_impact"]
            self.last = k
            if k == len(self.obs):
                break
            self.obs[k] = observation
            if (action := act(k, observation)) is None:
                break
            self.steps.add_(self.flying)
            observation = env.carry(action, self._mask)["actor"]
            x["command"][k] = views.command
        self.steps.clamp_(max=(~self.failed[1:]).int().cumprod(0).sum(0))


def fit(flights: FlightBatch) -> dict[str, Tensor]:
    """Fit the surrogate's coefficients to flights with random commands.

    Returns ``response``, rows A0, A1, B_0, ..., shape (2 + D, 4), ``force``, kappa and drag
    [N s/m], shape (4,), and ``tension``, a and b.
    """
    env = flights.env
    period = env.cfg.sim.control_period
    lags = max(queue_depth(v.queue.delay, period) for v in env.sim.vehicles)
    parts = []
    hover = env.previous_action.clone()
    spread = hover.new_tensor(ACTION_SPREAD)
    swing = torch.randn_like(hover) * spread

    def act(k: int, obs: Tensor) -> Tensor:
        swing.mul_(CORRELATION).add_(
            (1.0 - CORRELATION**2) ** 0.5 * spread * torch.randn_like(swing)
        )
        return hover + swing

    for _ in range(FIT_STEPS // flights.obs[..., 0].numel() + 1):
        flights.fly(act)
        parts.append(_regressors(flights, lags, period))
    rows = {name: torch.cat([part[name] for part in parts]).double() for name in parts[0]}
    response = [_solve(rows["lagged"][..., c], rows["next"][:, c])[:-1] for c in range(4)]
    force = _solve(rows["push"].flatten(0, 1), rows["momentum"].flatten())
    pulled = -(rows["along"] * (rows["push"] @ force)).sum(-1) / rows["mass"]
    pulls = torch.stack([pulled, rows["swing"]], -1) * rows["reduced"][:, None]
    tension = _solve(pulls, rows["tension"])
    found = {"response": torch.stack(response, -1), "force": force, "tension": tension}
    return {name: value.float().contiguous() for name, value in found.items()}


def _solve(features: Tensor, target: Tensor) -> Tensor:
    """Return the least-squares coefficients; those of features that are not excited are 0."""
    scale = features.square().mean(0).sqrt().clamp(min=1e-12)
    scaled = features / scale
    ridge = 1e-9 * len(features) * torch.eye(len(scale), dtype=scale.dtype, device=scale.device)
    return torch.linalg.solve(scaled.mT @ scaled + ridge, scaled.mT @ target) / scale


def _regressors(flights: FlightBatch, lags: int, period: float) -> dict[str, Tensor]:
    """Return the rows of the three regressions from the complete steps of flights; rows of the
    tension are 0 where the rope is slack.
    """
    f = flights.x
    mass = flights.mass
    load_mass = flights.load_mass
    k = torch.arange(max(lags - 1, 1), len(f["pos"]) - 1, device=mass.device)
    after = k + 1
    rot = ob.rotation_from_quat(f["quat"])
    y = f["response"]
    lagged = [y[k], y[k - 1], *(f["command"][k - j] for j in range(lags)), torch.ones_like(y[k])]
    thrusts = y[k, :, :1] + y[after, :, :1]
    axes = rot[k].unbind(-1)
    thrust_w = 0.25 * thrusts * (axes[2] + rot[after, :, :, 2])
    vel = f["vel"][k]
    drag = [-axis * (axis * vel).sum(-1, keepdim=True) for axis in axes]
    gravity = torch.tensor([0.0, 0.0, GRAVITY], device=mass.device)
    load_gain = (f["load_vel"][after] - f["load_vel"][k]) / period
    load_force = load_mass[:, None] * (load_gain + gravity)
    gain = (f["vel"][after] - vel) / period
    momentum = mass[:, None] * (gain + gravity) + load_force
    arm = f["load_pos"] - f["pos"] - (rot @ flights.mount[:, :, None]).squeeze(-1)
    arm, u = (0.5 * (path[k] + path[after]) for path in (arm, f["load_vel"] - f["vel"]))
    length = arm.norm(dim=-1)
    n = arm / length[..., None]
    tension = -(n * load_force).sum(-1)
    taut = tension > TAUT * GRAVITY * load_mass
    along = (n * u).sum(-1, keepdim=True) * n
    swing = (u - along).square().sum(-1) / length
    rows = {
        "next": y[after],
        "lagged": torch.stack(lagged, -2),
        "push": torch.stack([thrust_w, *drag], -1),
        "momentum": momentum,
        "along": n,
        "mass": mass.expand_as(tension),
        "reduced": taut * mass * load_mass / (mass + load_mass),
        "swing": swing,
        "tension": tension * taut,
    }
    return {name: row[k[:, None] < flights.steps] for name, row in rows.items()}
