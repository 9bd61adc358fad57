"""PPO's loss with its gradient, its learning rate and its returns as Warp kernels, a thread a
sample, step or environment.

In torch each is some dozens of launches of small operations. Formulas are those of rsl_rl 5.5's
``PPO.update`` and ``PPO.compute_returns``; tests compare the two."""

import warp as wp

from sim.kernels import runtime  # noqa: F401  starts Warp

LOWEST, HIGHEST = wp.constant(1e-5), wp.constant(1e-2)  # range of the adaptive learning rate

VALUE = wp.constant(0)
SURROGATE = wp.constant(1)
MOVED = wp.constant(2)
"""Columns of ``parts``: two losses, A squares of how far the mean moved in spreads, A derivatives
by log spreads.
"""

HALF_LOG_TWO_PI = wp.constant(0.9189385332046727)


@wp.func
def log_density(
    action: wp.array2d(dtype=float),
    mean: wp.array2d(dtype=float),
    std: wp.array(dtype=float),
    i: int,
):
    """Log-probability of sample i's action."""
    total = float(0.0)
    for j in range(action.shape[1]):
        z = (action[i, j] - mean[i, j]) / std[j]
        total -= 0.5 * z * z + wp.log(std[j]) + HALF_LOG_TWO_PI
    return total


@wp.kernel(enable_backward=False)
def log_probabilities(
    # In:
    action: wp.array2d(dtype=float),
    mean: wp.array2d(dtype=float),
    std: wp.array(dtype=float),
    # Out:
    log_probability: wp.array(dtype=float),
):
    """Log-density of a Gaussian without correlations at each sample's action."""
    i = wp.tid()
    log_probability[i] = log_density(action, mean, std, i)


@wp.kernel(enable_backward=False)
def loss(
    # Params:
    clip: float,
    value_coefficient: float,
    clip_value: int,
    actor_learns: wp.array(dtype=float),
    # In:
    mean: wp.array2d(dtype=float),
    value: wp.array(dtype=float),
    std: wp.array(dtype=float),
    action: wp.array2d(dtype=float),
    old_mean: wp.array2d(dtype=float),
    old_log_probability: wp.array(dtype=float),
    advantage: wp.array(dtype=float),
    returns: wp.array(dtype=float),
    old_value: wp.array(dtype=float),
    # Out:
    mean_gradient: wp.array2d(dtype=float),
    value_gradient: wp.array(dtype=float),
    parts: wp.array2d(dtype=float),
):
    """Clipped surrogate and value loss of each of N samples; gradients are those of the minibatch's
    mean.

    ``actor_learns`` is 1, or 0 to leave the actor as it is; the value's steps are not clipped then,
    for a critic that is far off to get near."""
    i = wp.tid()
    share = 1.0 / float(mean.shape[0])
    actions = mean.shape[1]
    ratio = wp.exp(log_density(action, mean, std, i) - old_log_probability[i])
    whole = -advantage[i] * ratio
    clipped = -advantage[i] * wp.clamp(ratio, 1.0 - clip, 1.0 + clip)
    parts[i, SURROGATE] = wp.max(whole, clipped)
    slope = float(0.0)  # of the mean loss by the log-probability; beyond the clip it is level
    if whole >= clipped:
        slope = whole * share * actor_learns[0]
    for j in range(actions):
        z = (action[i, j] - mean[i, j]) / std[j]
        moved = (old_mean[i, j] - mean[i, j]) / std[j]
        mean_gradient[i, j] = slope * z / std[j]
        parts[i, MOVED + j] = moved * moved
        parts[i, MOVED + actions + j] = slope * (z * z - 1.0)

    off = value[i] - returns[i]
    error = off * off
    slope = off
    if clip_value != 0 and actor_learns[0] > 0.0:
        step = value[i] - old_value[i]
        clipped_error = old_value[i] + wp.clamp(step, -clip, clip) - returns[i]
        if clipped_error * clipped_error > error:
            error = clipped_error * clipped_error
            slope = wp.where(wp.abs(step) <= clip, clipped_error, 0.0)
    parts[i, VALUE] = error
    value_gradient[i] = 2.0 * value_coefficient * share * slope


@wp.kernel(enable_backward=False)
def spread_and_rate(
    # Params:
    count: float,
    entropy_coefficient: float,
    adaptive: int,
    target_kl: wp.array(dtype=float),
    actor_learns: wp.array(dtype=float),
    # In:
    sums: wp.array(dtype=float),
    std: wp.array(dtype=float),
    old_std: wp.array(dtype=float),
    # Out:
    rate: wp.array(dtype=float),
    spread_gradient: wp.array(dtype=float),
    totals: wp.array(dtype=float),
):
    """Gradient by the log spreads, rsl_rl's adaptive rate, and running totals of value loss,
    surrogate and entropy.

    ``sums`` are those of ``parts`` over ``count`` samples. The divergence is that of the rollout's
    Gaussian to this one; where nothing moved it is exactly 0, as rsl_rl's."""
    actions = std.shape[0]
    divergence = float(0.0)
    entropy = float(0.0)
    for j in range(actions):
        ratio = old_std[j] / std[j]
        square = ratio * ratio
        divergence += 0.5 * (square + sums[MOVED + j] / count - 1.0 - wp.log(square))
        entropy += wp.log(std[j]) + 0.5 + HALF_LOG_TWO_PI
        spread_gradient[j] = sums[MOVED + actions + j] - entropy_coefficient * actor_learns[0]
    totals[0] += sums[VALUE] / count
    totals[1] += sums[SURROGATE] / count
    totals[2] += entropy
    if adaptive != 0:
        if divergence > 2.0 * target_kl[0]:
            rate[0] = wp.max(rate[0] / 1.5, LOWEST)
        elif divergence < 0.5 * target_kl[0] and divergence > 0.0:
            rate[0] = wp.min(rate[0] * 1.5, HIGHEST)


@wp.kernel(enable_backward=False)
def returns_of(
    # Params:
    discount: float,
    trace: float,
    # In:
    rewards: wp.array2d(dtype=float),
    dones: wp.array2d(dtype=wp.uint8),
    values: wp.array2d(dtype=float),
    last_value: wp.array(dtype=float),
    # Out:
    returns: wp.array2d(dtype=float),
):
    """Returns of generalised advantage estimation, arrays of shape (T, E)."""
    env = wp.tid()
    steps = rewards.shape[0]
    following = last_value[env]
    advantage = float(0.0)
    for k in range(steps):
        i = steps - 1 - k
        goes_on = 1.0 - float(dones[i, env])
        error = rewards[i, env] + goes_on * discount * following - values[i, env]
        advantage = error + goes_on * discount * trace * advantage
        following = values[i, env]
        returns[i, env] = advantage + following
