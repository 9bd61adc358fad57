"""The paper's reward, term by term (Eqs. 2 to 5, Table II), with coefficients from ``[reward]`` of
``configs/task``.

Each term is a function of tensors over the batch. ``u`` is the clipped normalised action:
``command`` uses its three rates, ``change`` its four commands. The paper does not state the unit of
u; with normalised commands Table II's weights are of the same order."""

from torch import Tensor

from visthrow.task import RewardParams


def kinetic(p: RewardParams, vel_w: Tensor, rate_b: Tensor, payload_vel_w: Tensor) -> Tensor:
    """Return r_kin: alpha_v |v_q|^2 + alpha_omega |omega_q|^2 + alpha_p |v_p - v_q|^2, shape
    (E,).
    """
    flight = p.velocity * vel_w.square().sum(-1)
    turn = p.angular_velocity * rate_b.square().sum(-1)
    swing = p.relative_velocity * (payload_vel_w - vel_w).square().sum(-1)
    return flight + turn + swing


def command(p: RewardParams, action: Tensor, weights: Tensor) -> Tensor:
    """Return r_cmd: -beta sum_i c^omega_i u_i^2 over the three rate commands, shape (..., E).
    action: shape (..., E, 5). weights: c^omega, shape (3,).
    """
    squares = action[..., 1:4].square()
    return -p.smoothness * (weights * squares).sum(-1)


def change(p: RewardParams, action: Tensor, previous: Tensor, weights: Tensor) -> Tensor:
    """Return r_rate, which penalises changes of the four commands: -beta sum_j c^Delta_j (eta
    |du_j| + du_j^2), shape (..., E). action, previous: shape (..., E, 5). weights: c^Delta, shape
    (4,).
    """
    delta = action[..., :4] - previous[..., :4]
    jerk = p.l1_mix * delta.abs() + delta.square()
    return -p.smoothness * (weights * jerk).sum(-1)


def carry_time(p: RewardParams, period: float) -> float:
    """Return r_time: -gamma_t dt, for every step up to the release."""
    return -p.carry_time * period


def landing_reward(p: RewardParams, error: Tensor) -> Tensor:
    """Return r_land: k_l exp(-lambda error), shape (E,). error: distance between impact and goal
    [m], shape (E,).
    """
    nearness = (-p.landing_decay * error).exp()
    return p.landing * nearness


def time_of_flight(p: RewardParams, time: Tensor) -> Tensor:
    """Return r_tof: -k_h t_hit, shape (E,). time: [s]."""
    return -p.time_of_flight * time


def proximity(p: RewardParams, clearance: Tensor, margin: float) -> Tensor:
    """Return r_prox: -k_p max(0, d_m - clearance), shape (E,). clearance, margin: [m]."""
    missing = (margin - clearance).clamp(min=0.0)
    return -p.proximity * missing


def release_reward(
    p: RewardParams, error: Tensor, time: Tensor, clearance: Tensor, margin: float
) -> Tensor:
    """Return r_land + r_tof + r_prox of a release, shape (E,). Arguments: see
    :func:`landing_reward`, :func:`time_of_flight` and :func:`proximity`.
    """
    return landing_reward(p, error) + time_of_flight(p, time) + proximity(p, clearance, margin)
