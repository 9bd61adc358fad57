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

import torch
from torch import Tensor

from sim.params import GRAVITY
from sim.quadrotor.queue import queue_depth
from visthrow.onboard import observations as ob
from visthrow.training.env import ThrowEnv
from visthrow.training.first_order.flights import Flights

EXCITED, KEPT = (0.35, 0.5, 0.5, 0.5, 0.0), 0.7
"""Random actions of the fit: spread about hover, and the share of one that the next keeps."""
FITTED = 8000
"""Steps of flight that the fit rests on."""
TAUT = 0.1
"""Pull on the payload in its weights above which the rope counts as taut."""


def fit(env: ThrowEnv, watch: Callable[[Tensor], None], steps: int = 40) -> dict[str, Tensor]:
    """Fit the surrogate to random flights; ``watch`` is shown what the actor observed in them, shape (N, D).

    Returns:
        ``response``: rows A0, A1, B_0, ..., shape (2 + D, 4); ``force``: kappa and drag [N s/m], shape (4,); ``tension``: a, b.
    """
    period = env.cfg.sim.control_period
    lags = max(queue_depth(v.queue.delay, period) for v in env.sim.vehicles)
    flights, parts = Flights(env, steps), []
    spread, hover = torch.tensor(EXCITED, device=env.device), env.previous_action.clone()
    swing = torch.randn_like(hover) * spread

    def act(k: int, seen: Tensor) -> Tensor:
        swing.mul_(KEPT).add_((1.0 - KEPT**2) ** 0.5 * spread * torch.randn_like(swing))
        return hover + swing

    for _ in range(FITTED // (env.num_envs * steps) + 1):
        flights.fly(act)
        watch(flights.observed())
        parts.append(_regressors(flights, lags, period))
    rows = {name: torch.cat([part[name] for part in parts]).double() for name in parts[0]}
    response = [_solve(rows["lagged"][..., c], rows["next"][:, c])[:-1] for c in range(4)]
    force = _solve(rows["push"].flatten(0, 1), rows["momentum"].flatten())
    pulled = -(rows["along"] * (rows["push"] @ force)).sum(-1) / rows["mass"]
    tension = _solve(torch.stack([pulled, rows["swing"]], -1) * rows["reduced"][:, None], rows["tension"])
    found = {"response": torch.stack(response, -1), "force": force, "tension": tension}
    return {name: value.float().contiguous() for name, value in found.items()}


def _solve(features: Tensor, target: Tensor) -> Tensor:
    """Least-squares coefficients; what nothing excites gets none."""
    scale = features.square().mean(0).sqrt().clamp(min=1e-12)
    normal = (features / scale).mT @ (features / scale) / len(features)
    ridge = 1e-9 * torch.eye(len(scale), dtype=normal.dtype, device=normal.device)
    return torch.linalg.solve(normal + ridge, (features / scale).mT @ target / len(features)) / scale


def _regressors(flights: Flights, lags: int, period: float) -> dict[str, Tensor]:
    """Rows of the three regressions from the whole steps of flights; those of the tension count where the rope is taut."""
    f, mass, load_mass = flights.x, flights.mass, flights.load_mass
    k = torch.arange(max(lags - 1, 1), len(f["pos"]) - 1, device=mass.device)
    rot, y = ob.rotation_from_quat(f["quat"]), f["response"]
    lagged = [y[k], y[k - 1], *(f["command"][k - j] for j in range(lags)), torch.ones_like(y[k])]
    thrust_w = 0.25 * (y[k, :, :1] + y[k + 1, :, :1]) * (rot[k, :, :, 2] + rot[k + 1, :, :, 2])
    drag = [-rot[k, :, :, i] * (rot[k, :, :, i] * f["vel"][k]).sum(-1, keepdim=True) for i in range(3)]
    gravity = torch.tensor([0.0, 0.0, GRAVITY], device=mass.device)
    load_force = load_mass[:, None] * ((f["load_vel"][k + 1] - f["load_vel"][k]) / period + gravity)
    arm = f["load_pos"] - f["pos"] - (rot @ flights.mount[:, :, None]).squeeze(-1)
    arm, u = (0.5 * (path[k] + path[k + 1]) for path in (arm, f["load_vel"] - f["vel"]))
    length = arm.norm(dim=-1)
    n = arm / length[..., None]
    tension = -(n * load_force).sum(-1)
    taut = tension > TAUT * GRAVITY * load_mass
    rows = {
        "next": y[k + 1],
        "lagged": torch.stack(lagged, -2),
        "push": torch.stack([thrust_w, *drag], -1),
        "momentum": mass[:, None] * ((f["vel"][k + 1] - f["vel"][k]) / period + gravity) + load_force,
        "along": n,
        "mass": mass.expand_as(tension),
        "reduced": taut * mass * load_mass / (mass + load_mass),
        "swing": (u - (n * u).sum(-1, keepdim=True) * n).square().sum(-1) / length,
        "tension": tension * taut,
    }
    return {name: row[k[:, None] < flights.steps] for name, row in rows.items()}
