"""Backward pass of flights: through the surrogate a kernel a step, a thread a flight, and between
two of them through the network.

Derivatives are written by hand; a rotation's is that by a turn about the body axes, R exp(turn).
What a derivative by a state is worth is known once all later steps are done: so the network's own
are products with one vector a step, those by its weights products over all steps at the end."""

import torch
import warp as wp
from torch import Tensor, nn

from sim.params import GRAVITY
from visthrow.onboard import observations as ob
from visthrow.training.first_order.surrogate import TAUT, Course
from visthrow.training.ppo.network import Network

# least at which the slope of the thrust is taken: at none it is nought, and nothing would lead away
# from there
SLACK_THROTTLE = 0.05
PREVIOUS_AT, GOAL_AT, LOAD_AT = (
    ob.VEHICLE,
    ob.VEHICLE + 5,
    ob.VEHICLE + 7,
)  # columns of a state observation where these begin


@wp.struct
class BackwardParams:
    """The dimensions of flights and policy."""

    response: wp.array(dtype=wp.vec4)
    force: wp.array(dtype=float)
    tension: wp.array(dtype=float)
    mass: wp.array(dtype=float)
    load_mass: wp.array(dtype=float)
    mount: wp.array(dtype=wp.vec3)
    age: wp.array(dtype=float)  # of poses [s]
    history: int
    max_thrust: float
    max_rate: wp.vec3
    period: float
    decay: float  # of derivatives, per step


@wp.func
def turned(quat: wp.quat, arm_b: wp.vec3, grad_w: wp.vec3):
    """Return the derivative by the turn of what has the derivative ``grad_w`` by the world vector
    ``R arm_b``.
    """
    return wp.cross(arm_b, wp.quat_rotate_inv(quat, grad_w))


@wp.func
def step_back(p: BackwardParams, x: Course, adj: Course, k: int, e: int):
    """Add to the derivatives by state k, k - 1 and by the commands up to k what those by state k +
    1 make of them.
    """
    dt, half, up = p.period, 0.5 * p.period, wp.vec3(0.0, 0.0, 1.0)
    mass, load_mass, mount, rot, rot_next = (
        p.mass[e],
        p.load_mass[e],
        p.mount[e],
        x.quat[k, e],
        x.quat[k + 1, e],
    )
    g_pos, g_load = p.decay * adj.pos[k + 1, e], p.decay * adj.load_pos[k + 1, e]
    g_vel, g_load_vel = (
        p.decay * adj.vel[k + 1, e] + half * g_pos,
        p.decay * adj.load_vel[k + 1, e] + half * g_load,
    )
    g_turn, g_response = p.decay * adj.turn[k + 1, e], p.decay * adj.response[k + 1, e]
    z = 0.5 * (wp.quat_rotate(rot, up) + wp.quat_rotate(rot_next, up))
    rates = x.response[k, e] + x.response[k + 1, e]
    thrust, drag = 0.5 * p.force[0] * rates[0], wp.vec3(p.force[1], p.force[2], p.force[3])
    f = thrust * z - wp.quat_rotate(rot, wp.cw_mul(drag, wp.quat_rotate_inv(rot, x.vel[k, e])))
    arm = 0.5 * (x.load_pos[k, e] - x.pos[k, e] + x.load_pos[k + 1, e] - x.pos[k + 1, e])
    arm = arm - 0.5 * (wp.quat_rotate(rot, mount) + wp.quat_rotate(rot_next, mount))
    length, n = wp.length(arm), wp.normalize(arm)
    u = 0.5 * (x.load_vel[k, e] - x.vel[k, e] + x.load_vel[k + 1, e] - x.vel[k + 1, e])
    perpendicular = u - wp.dot(n, u) * n
    pull = -load_mass * wp.dot(n, (x.load_vel[k + 1, e] - x.load_vel[k, e]) / dt + GRAVITY * up)

    g_f = dt / mass * g_vel
    g_u, g_arm = wp.vec3(), wp.vec3()
    if pull > TAUT * GRAVITY * load_mass:
        combined = g_f - dt / load_mass * g_load_vel
        g_pull = wp.dot(n, combined) * mass * load_mass / (mass + load_mass)
        swing = g_pull * p.tension[1] / length
        g_n = pull * combined - g_pull * p.tension[0] / mass * f - 2.0 * swing * wp.dot(n, u) * u
        g_u = 2.0 * swing * perpendicular
        g_f = g_f - g_pull * p.tension[0] / mass * n
        g_arm = (
            g_n - wp.dot(n, g_n) * n - swing * wp.dot(perpendicular, perpendicular) * n
        ) / length

    g_z = 0.5 * thrust * g_f
    g_turn += turned(rot_next, up, g_z)
    phi = half * wp.vec3(rates[1], rates[2], rates[3])
    g_rate = half * (
        g_turn + 0.5 * wp.cross(phi, g_turn) + wp.cross(phi, wp.cross(phi, g_turn)) / 6.0
    )
    g_mean = wp.vec4(0.5 * p.force[0] * wp.dot(z, g_f), g_rate[0], g_rate[1], g_rate[2])
    g_response += g_mean
    adj.response[k, e] += g_mean + wp.cw_mul(p.response[0], g_response)
    if k > 0:
        adj.response[k - 1, e] += wp.cw_mul(p.response[1], g_response)
    for j in range(wp.min(p.response.shape[0] - 2, k + 1)):
        adj.command[k - j, e] += wp.cw_mul(p.response[2 + j], g_response)
    adj.pos[k, e] += g_pos - g_arm
    adj.load_pos[k, e] += g_load + g_arm
    g_drag = wp.quat_rotate(rot, wp.cw_mul(drag, wp.quat_rotate_inv(rot, g_f)))
    adj.vel[k, e] += g_vel + half * (g_pos - g_arm) - g_u - g_drag
    adj.load_vel[k, e] += g_load_vel + half * (g_load + g_arm) + g_u
    before = wp.quat_rotate_inv(rot, wp.quat_rotate(rot_next, g_turn))
    adj.turn[k, e] += before + turned(rot, up, g_z) - turned(rot, mount, g_arm)


@wp.func
def three(by_seen: wp.array2d(dtype=float), e: int, i: int):
    """Return the derivative by three columns of an observation."""
    return wp.vec3(by_seen[e, i], by_seen[e, i + 1], by_seen[e, i + 2])


@wp.func
def seen_back(
    p: BackwardParams,
    x: Course,
    adj: Course,
    by_seen: wp.array2d(dtype=float),
    i: int,
    e: int,
    share: float,
):
    """Add an observation's derivatives to state i, of which ``share`` is in it, and to the payload
    as it was up to ``history`` steps before.
    """
    adj.pos[i, e] += share * three(by_seen, e, 0)
    adj.vel[i, e] += share * three(by_seen, e, 3)
    adj.response[i, e] += share * wp.vec4(0.0, by_seen[e, 6], by_seen[e, 7], by_seen[e, 8])
    for axis in range(2):
        unit = wp.vec3(1.0 - float(axis), float(axis), 0.0)
        adj.turn[i, e] += share * turned(x.quat[i, e], unit, three(by_seen, e, 9 + 3 * axis))
    adj.load_pos[i, e] -= share * wp.vec3(by_seen[e, GOAL_AT], by_seen[e, GOAL_AT + 1], 0.0)
    for age in range(p.history + 1):
        offset = share * three(by_seen, e, LOAD_AT + 3 * age)
        adj.load_pos[wp.max(i - age, 0), e] += offset
        adj.pos[wp.max(i - age, 0), e] -= offset


@wp.kernel(module="unique", enable_backward=False)
def backward(
    # Params:
    p: BackwardParams,
    k: int,
    # State in:
    adj: Course,
    # In:
    x: Course,
    steps: wp.array(dtype=wp.int32),
    action: wp.array3d(dtype=float),
    by_seen: wp.array2d(dtype=float),  # by observation k + 1
    # Out:
    by_action: wp.array3d(dtype=float),
):
    e = wp.tid()
    if k < steps[e]:
        seen_back(p, x, adj, by_seen, k + 1, e, 1.0 - p.age[e] / p.period)
        seen_back(p, x, adj, by_seen, k, e, p.age[e] / p.period)
        step_back(p, x, adj, k, e)
        throttle = wp.clamp(0.5 * (action[k, e, 0] + 1.0), SLACK_THROTTLE, 1.0)
        command = wp.cw_mul(
            wp.vec4(p.max_thrust * throttle, p.max_rate[0], p.max_rate[1], p.max_rate[2]),
            adj.command[k, e],
        )
        for j in range(5):
            if wp.abs(action[k, e, j]) <= 1.0:
                by_action[k, e, j] += by_seen[e, PREVIOUS_AT + j]
                if j < 4:
                    by_action[k, e, j] += command[j]


class Layers:
    """The activations of a network's layers over the steps of flights, shape (T, E, N), and
    derivatives by it; by what one step saw, shape (E, D).
    """

    def __init__(self, network: Network, obs: Tensor):
        self._network = network
        self._linear = [layer for layer in network.mlp if isinstance(layer, nn.Linear)]
        rooms = [
            [obs.new_zeros(*obs.shape[:2], layer.out_features) for layer in self._linear]
            for _ in range(3)
        ]
        self._inner, self._by_inner, (*self._slope, _) = rooms
        self._first = torch.zeros_like(self._linear[0].weight)  # with the normaliser's spread
        self.action = self._inner[-1]
        self.by_action = self._by_inner[-1]
        self.by_seen = torch.zeros_like(obs[0])

    def forward(self, k: int, obs: Tensor, flying: Tensor) -> Tensor:
        """Actions of step k, shape (E, 5), for observations, shape (E, D), of the flights that are
        flying, shape (E,).
        """
        rows = _picked(flying)
        x = self._network.obs_normalizer(obs[rows])
        for layer, inner in zip(self._linear, self._inner):
            out = torch.addmm(layer.bias, x, layer.weight.T)
            inner[k, rows], x = out, self._network.mlp[1](out)
        return self.action[k]

    def prepare(self, steps: int) -> None:
        """Begin a way back from this step."""
        for inner, slope in zip(self._inner, self._slope):
            for x, out in zip(
                inner[:steps].split(4), slope[:steps].split(4)
            ):  # pieces that caches hold
                with torch.enable_grad():
                    out.copy_(
                        torch.autograd.grad(
                            self._network.mlp[1](leaf := x.detach().requires_grad_()).sum(), leaf
                        )[0]
                    )
        if self._network.obs_normalization:
            spread = self._network.obs_normalizer.std + self._network.obs_normalizer.eps
        else:
            spread = 1.0
        self._first.copy_(self._linear[0].weight.detach() / spread)
        self.by_seen.zero_()

    def backpropagate(self, k: int, flown: Tensor) -> None:
        """Turn derivatives by the actions of step k into those by its observations, of the flights
        that flew it, shape (E,).
        """
        rows = _picked(flown)
        gradient = self.by_action[k, rows]
        for layer, slope, by_inner in reversed(
            list(zip(self._linear[1:], self._slope, self._by_inner))
        ):
            gradient = by_inner[k, rows] = (gradient @ layer.weight).mul_(slope[k, rows])
        self.by_seen[rows] = gradient @ self._first

    def gradients(self, obs: Tensor, flown: Tensor, shares: Tensor) -> None:
        """Give the weights their derivatives: seen, shape (T, E, D), at steps that were flown, (T,
        E); flights count by shares, (E,).
        """
        rows = _picked(flown.flatten())
        x = self._network.obs_normalizer(obs.flatten(0, 1)[rows])
        shares = shares.expand(flown.shape).flatten()[rows, None]
        for layer, inner, by_inner in zip(self._linear, self._inner, self._by_inner):
            gradient = by_inner.flatten(0, 1)[rows] * shares
            layer.weight.grad = gradient.mT @ x
            layer.bias.grad = gradient.sum(0)
            x = self._network.mlp[1](inner.flatten(0, 1)[rows])


def _picked(mask: Tensor) -> Tensor | slice:
    """Rows where a mask, shape (N,), is not 0; all of them where that is so, and on a GPU, which
    would have to wait to know.
    """
    return slice(0, len(mask)) if mask.is_cuda or bool(mask.all()) else mask.nonzero()[:, 0]
