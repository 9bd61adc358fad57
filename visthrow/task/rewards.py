"""The paper's reward, term by term (Eqs. 2 to 5, Table II), with coefficients from ``[reward]`` of
``configs/task``.

Each term is a function of tensors over the batch. ``u`` is the clipped normalised action; its rates
enter ``command`` and its four commands ``change`` (the paper leaves the unit of u open; normalised,
chosen so that Table II's weights are of one order)."""

from torch import Tensor

from visthrow.task import RewardParams


def kinetic(p: RewardParams, vel_w: Tensor, rate_b: Tensor, payload_vel_w: Tensor) -> Tensor:
    """r_kin: alpha_v |v_q|^2 + alpha_omega |omega_q|^2 + alpha_p |v_p - v_q|^2, shape (E,)."""
    flight = p.velocity * vel_w.square().sum(-1)
    turn = p.angular_velocity * rate_b.square().sum(-1)
    swing = p.relative_velocity * (payload_vel_w - vel_w).square().sum(-1)
    return flight + turn + swing


def command(p: RewardParams, action: Tensor, weights: Tensor) -> Tensor:
    """r_cmd: -beta sum_i c^omega_i u_i^2 over the three rate commands, shape (..., E). action:
    shape (..., E, 5). weights: c^omega, shape (3,).
    """
    squares = action[..., 1:4].square()
    return -p.smoothness * (weights * squares).sum(-1)


def change(p: RewardParams, action: Tensor, previous: Tensor, weights: Tensor) -> Tensor:
    """r_rate, which keeps commands smooth: -beta sum_j c^Delta_j (eta |du_j| + du_j^2) punishes
    jerks of the four, shape (..., E). action, previous: shape (..., E, 5). weights: shape (4,).
    """
    delta = action[..., :4] - previous[..., :4]
    jerk = p.l1_mix * delta.abs() + delta.square()
    return -p.smoothness * (weights * jerk).sum(-1)


def carry_time(p: RewardParams, period: float) -> float:
    """r_time: -gamma_t dt, of every step while carrying or at release."""
    return -p.carry_time * period


def landing(p: RewardParams, error: Tensor) -> Tensor:
    """r_land: k_l exp(-lambda error), shape (E,). error: distance of impact and goal [m], shape
    (E,).
    """
    nearness = (-p.landing_decay * error).exp()
    return p.landing * nearness


def time_of_flight(p: RewardParams, time: Tensor) -> Tensor:
    """r_tof: -k_h t_hit, shape (E,). time: [s]."""
    return -p.time_of_flight * time


def proximity(p: RewardParams, clearance: Tensor, margin: float) -> Tensor:
    """r_prox: -k_p max(0, d_m - clearance), shape (E,). clearance, margin: [m]."""
    missing = (margin - clearance).clamp(min=0.0)
    return -p.proximity * missing


def release_reward(
    p: RewardParams, error: Tensor, time: Tensor, clearance: Tensor, margin: float
) -> Tensor:
    """r_land + r_tof + r_prox of a release, shape (E,); arguments as of :func:`landing`,
    :func:`time_of_flight` and :func:`proximity`.
    """
    return landing(p, error) + time_of_flight(p, time) + proximity(p, clearance, margin)
