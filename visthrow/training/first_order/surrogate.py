"""Surrogate of one control step, which first-order training differentiates in the simulator's place.

The simulator flies; every value below is the simulator's own, and the surrogate lends its derivative at that point. With
the response ``y = (thrust, body rates)``, commands u, vehicle p, v, R, payload q, s and the control period dt:

    y[k+1] = A0 y[k] + A1 y[k-1] + sum_j B_j u[k-j] + c         per channel: controller, motors and queue
    R[k+1] = R[k] exp(dt (w[k] + w[k+1]) / 2)
    f      = kappa F z - R diag(drag) R^T v                      F, z: mean thrust and mean body z of the step
    T      = mu (-a n.f / M + b |u_perp|^2 / l)                  u = s - v; n, l: of the rope as a taut, massless rod
    v[k+1] = v + dt (f / M + g + T n / M),  s[k+1] = s + dt (g - T n / m),  mu = M m / (M + m)

and positions by the trapezoid. A0, A1, B, c, kappa, drag, a and b are fitted to flights of the simulator under random
commands by linear least squares; :mod:`visthrow.training.first_order.backward` has the derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from sim.quadrotor.queue import queue_depth
from visthrow.onboard import observations as ob
from visthrow.training import terminations
from visthrow.training.env import ThrowEnv

EXCITED, KEPT = (0.35, 0.5, 0.5, 0.5, 0.0), 0.7
"""Random actions of the fit: spread about hover, and the share of one that the next keeps."""
FITTED = 8000
"""Steps of flight that the fit rests on."""
TAUT = 0.1
"""Pull on the payload in its weights above which the rope counts as taut."""

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
        self.status, self.flown = torch.zeros(steps + 1, count, device=device, dtype=torch.int32), steps

    def whole(self) -> Tensor:
        """Whether the flight had not ended, shape (T, E), at each of its steps."""
        return torch.arange(len(self.status) - 1, device=self.steps.device)[:, None] <= self.steps

    def fly(self, env: ThrowEnv, plants: Plants, act: Callable[[int, Tensor], Tensor | None], passed: Callable[[int], None]) -> None:
        """Fly from new starts without release: ``passed(k)`` at each state k, the last included, then ``act(k, observations)``.

        Where it has no actions, flights end; what was recorded of earlier flights stands beyond.
        """
        state, out, x, T = env.views.state, env.views.out, self.x, len(self.status) - 1
        seen = env.reset()
        self.mass.copy_(plants.body_mass * state["mass_scale"] + plants.rope_mass)
        for k in range(T + 1):
            for name, source in (("pos", state["pos_w"]), ("vel", state["vel_w"]), ("quat", state["quat_wb"]),
                                 ("load_pos", out["payload_pos_w"]), ("load_vel", out["payload_vel_w"])):  # fmt: skip
                x[name][k].copy_(source)
            x["response"][k, :, 0].copy_(plants.thrust_factor * state["motor_speed"].square().sum(-1))
            x["response"][k, :, 1:].copy_(state["rate_b"])
            self.status[k].copy_(state["status"])
            passed(k)
            action = act(k, seen["actor"]) if k < T else None
            if action is None:
                break
            seen = env.carry(action)
            x["command"][k].copy_(env.views.command)
        self.flown = k
        flown = (x["pos"][1:], ob.rotation_from_quat(x["quat"][1:]), x["load_pos"][1:], self.status[1:])
        pos, rot, load_pos, status = (value.flatten(0, 1) for value in flown)
        held, time = torch.zeros_like(status, dtype=torch.bool), torch.zeros_like(pos[:, 0])
        ends = terminations.negative(env.cfg.task.bounds, pos, rot, load_pos, status, held, time, env.cfg.release.landing_height)
        self.steps.copy_((~ends).view(T, -1).int().cumprod(0).sum(0).clamp(max=self.flown))


@dataclass
class Surrogate:
    """Fitted coefficients: rows A0, A1, B_0, ..., shape (2 + D, 4); kappa and drag [N s/m], shape (4,); a, b, shape (2,)."""

    response: Tensor
    force: Tensor
    tension: Tensor


def fit(env: ThrowEnv, plants: Plants, watch: Callable[[Tensor], None], steps: int = 40) -> Surrogate:
    """Fit the surrogate to random flights; ``watch`` is shown what the actor observed in them, shape (N, D)."""
    period = env.cfg.sim.control_period
    lags = max(queue_depth(v.queue.delay, period) for v in env.sim.vehicles)
    flights, parts = Flights(steps, env.num_envs, env.device), []
    spread, hover = torch.tensor(EXCITED, device=env.device), env.previous_action.clone()
    swing = torch.randn_like(hover) * spread

    def act(k: int, seen: Tensor) -> Tensor:
        observed.append(seen)
        swing.mul_(KEPT).add_((1.0 - KEPT**2) ** 0.5 * spread * torch.randn_like(swing))
        return hover + swing

    for _ in range(FITTED // (env.num_envs * steps) + 1):
        observed: list[Tensor] = []
        flights.fly(env, plants, act, lambda k: None)
        watch(torch.stack(observed)[flights.whole()])
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
