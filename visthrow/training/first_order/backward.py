"""Backward pass of flights: through the surrogate a kernel a step, a thread a flight, and between
two of them through the network.

Warp differentiates the surrogate's step. What a derivative by a state is worth is known once all
later steps are done: so the network is differentiated by its observations step by step, and by its
weights over all steps at the end."""

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from visthrow.onboard import actions
from visthrow.onboard import observations as ob
from visthrow.training.first_order.surrogate import TAUT, Course
from visthrow.training.ppo.network import Network

# least at which the slope of the thrust is taken: at none it is nought, and nothing would lead away
# from there
SLACK_THROTTLE = 0.05
# columns of a state observation where previous action, goal and payload begin
PREVIOUS_AT = ob.VEHICLE
GOAL_AT = ob.VEHICLE + 5
LOAD_AT = ob.VEHICLE + 7


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


def _make_attach(kind: type) -> wp.Function:
    """Return the function that gives a value the derivatives of another."""

    @wp.func
    def at(value: kind, slope: kind):
        return value

    @wp.func_grad(at)
    def adj_at(value: kind, slope: kind, adj_ret: kind):
        wp.adjoint[slope] += adj_ret

    return at


number_at, vector_at, response_at, turn_at = map(_make_attach, (float, wp.vec3, wp.vec4, wp.quat))


@wp.func
def command(p: BackwardParams, action: wp.array3d(dtype=float), k: int, e: int):
    """Return thrust and rates that an action commands, as its derivatives have it."""
    throttle = 0.5 * (wp.clamp(action[k, e, 0], -1.0, 1.0) + 1.0)
    slack = SLACK_THROTTLE * (2.0 * throttle - SLACK_THROTTLE)
    return wp.vec4(
        p.max_thrust * wp.where(throttle > SLACK_THROTTLE, throttle * throttle, slack),
        p.max_rate[0] * wp.clamp(action[k, e, 1], -1.0, 1.0),
        p.max_rate[1] * wp.clamp(action[k, e, 2], -1.0, 1.0),
        p.max_rate[2] * wp.clamp(action[k, e, 3], -1.0, 1.0),
    )


@wp.func
def arm_of(p: BackwardParams, x: Course, k: int, e: int):
    """Return the rope's vector in state k."""
    return x.load_pos[k, e] - x.pos[k, e] - wp.quat_rotate(x.quat[k, e], p.mount[e])


@wp.func
def advance(
    p: BackwardParams, x: Course, made: Course, action: wp.array3d(dtype=float), k: int, e: int
):
    """Make state k + 1 of state k and the commands up to k."""
    dt = p.period
    decay = p.decay
    after = k + 1
    up = wp.vec3(0.0, 0.0, 1.0)
    mass = p.mass[e]
    load_mass = p.load_mass[e]
    rot = x.quat[k, e]
    vel = x.vel[k, e]
    load_vel = x.load_vel[k, e]
    y = wp.cw_mul(p.response[0], x.response[k, e])
    if k > 0:
        y += wp.cw_mul(p.response[1], x.response[k - 1, e])
    for j in range(wp.min(p.response.shape[0] - 2, k + 1)):
        y += wp.cw_mul(p.response[2 + j], command(p, action, k - j, e))
    y = response_at(x.response[after, e], y)
    mean = 0.5 * (x.response[k, e] + y)
    half_turn = 0.5 * dt * wp.vec3(mean[1], mean[2], mean[3])
    square = wp.dot(half_turn, half_turn)
    turn = wp.quat(half_turn * (1.0 - square / 6.0), 1.0 - 0.5 * square)
    rot_next = turn_at(x.quat[after, e], rot * turn)
    z = 0.5 * (wp.quat_rotate(rot, up) + wp.quat_rotate(rot_next, up))
    drag_b = wp.cw_mul(wp.vec3(p.force[1], p.force[2], p.force[3]), wp.quat_rotate_inv(rot, vel))
    f = p.force[0] * mean[0] * z - wp.quat_rotate(rot, drag_b)

    slip = load_vel - vel
    begin = arm_of(p, x, k, e)
    arm = vector_at(0.5 * (begin + arm_of(p, x, after, e)), begin + 0.5 * dt * slip)
    u = vector_at(0.5 * (slip + x.load_vel[after, e] - x.vel[after, e]), slip)
    n = wp.normalize(arm)
    along = wp.dot(n, u)
    swing = (wp.dot(u, u) - along * along) / wp.length(arm)
    reduced = mass * load_mass / (mass + load_mass)
    rod = reduced * (p.tension[1] * swing - p.tension[0] / mass * wp.dot(n, f))
    load_gain = (x.load_vel[after, e] - load_vel) / dt + GRAVITY * up
    pull = number_at(-load_mass * wp.dot(n, load_gain), rod)
    tension = wp.where(pull > TAUT * GRAVITY * load_mass, pull, 0.0) * n
    vel_next = vel + dt / mass * (f + tension)
    load_vel_next = load_vel - dt / load_mass * tension
    made.pos[after, e] = decay * (x.pos[k, e] + 0.5 * dt * (vel + vel_next))
    made.vel[after, e] = decay * vel_next
    made.quat[after, e] = decay * rot_next
    made.load_pos[after, e] = decay * (x.load_pos[k, e] + 0.5 * dt * (load_vel + load_vel_next))
    made.load_vel[after, e] = decay * load_vel_next
    made.response[after, e] = decay * y


@wp.func
def show(
    p: BackwardParams, x: Course, observation: wp.array2d(dtype=float), k: int, e: int, share: float
):
    """Add the share of an observation that state k has, with the payload as it was up to
    ``history`` steps before.
    """
    rot = x.quat[k, e]
    forward = wp.quat_rotate(rot, wp.vec3(1.0, 0.0, 0.0))
    left = wp.quat_rotate(rot, wp.vec3(0.0, 1.0, 0.0))
    for i in range(3):
        observation[e, i] += share * x.pos[k, e][i]
        observation[e, 3 + i] += share * x.vel[k, e][i]
        observation[e, 6 + i] += share * x.response[k, e][1 + i]
        observation[e, 9 + i] += share * forward[i]
        observation[e, 12 + i] += share * left[i]
    for i in range(2):
        observation[e, GOAL_AT + i] -= share * x.load_pos[k, e][i]
    for age in range(p.history + 1):
        before = wp.max(k - age, 0)
        offset = x.load_pos[before, e] - x.pos[before, e]
        for i in range(3):
            observation[e, LOAD_AT + 3 * age + i] += share * offset[i]


@wp.kernel(module="unique", enable_backward=True)
def step(
    # Params:
    p: BackwardParams,
    k: int,
    # State in:
    x: Course,
    # In:
    steps: wp.array(dtype=wp.int32),
    action: wp.array3d(dtype=float),
    # Out:
    made: Course,  # of no use but for the derivatives, which it shares with x
    observation: wp.array2d(dtype=float),  # observation k + 1
):
    e = wp.tid()
    if k < steps[e]:
        advance(p, x, made, action, k, e)
        late = p.age[e] / p.period
        show(p, x, observation, k + 1, e, 1.0 - late)
        show(p, x, observation, k, e, late)
        for j in range(5):
            observation[e, PREVIOUS_AT + j] += wp.clamp(action[k, e, j], -1.0, 1.0)


class Layers:
    """A network's actions over the steps of flights, shape (T, E, 5), with derivatives by them and
    by what one step saw, shape (E, D).
    """

    def __init__(self, network: Network, obs: Tensor):
        """Allocate; ``obs``: where flights write what they see, shape (T, E, D)."""
        self._network = network
        self._obs = obs
        self.action, self.by_action = obs.new_zeros(2, *obs.shape[:2], actions.ACTIONS)
        self.by_observation = torch.zeros_like(obs[0])

    def _decide(self, obs: Tensor) -> Tensor:
        return self._network.mlp(self._network.obs_normalizer(obs))

    def forward(self, k: int, obs: Tensor, flying: Tensor) -> Tensor:
        """Actions of step k, shape (E, 5), for observations, shape (E, D), of the flights that are
        flying, shape (E,).
        """
        rows = _select_rows(flying)
        self.action[k, rows] = self._decide(obs[rows])
        return self.action[k]

    def backpropagate(self, k: int, flown: Tensor) -> None:
        """Turn derivatives by the actions of step k into those by its observations, of the flights
        that flew it, shape (E,).
        """
        rows = _select_rows(flown)
        with torch.enable_grad():
            observation = self._obs[k, rows].detach().requires_grad_()
            action = self._decide(observation)
        (self.by_observation[rows],) = torch.autograd.grad(
            action, observation, self.by_action[k, rows]
        )

    def gradients(self, flown: Tensor, shares: Tensor) -> None:
        """Give the weights their derivatives from the steps that were flown, bool, shape (T, E);
        flights count by shares, shape (E,).
        """
        rows = _select_rows(flown.flatten())
        obs, by_action = (
            tensor[: len(flown)].flatten(0, 1)[rows]
            for tensor in (self._obs, self.by_action * shares[:, None])
        )
        weights = list(self._network.mlp.parameters())
        with torch.enable_grad():
            action = self._decide(obs)
        for weight, gradient in zip(weights, torch.autograd.grad(action, weights, by_action)):
            weight.grad = gradient


def _select_rows(mask: Tensor) -> Tensor | slice:
    """Rows where a mask, shape (N,), is not 0; all of them where that is so, and on a GPU, which
    would have to wait to know.
    """
    return slice(0, len(mask)) if mask.is_cuda or bool(mask.all()) else mask.nonzero()[:, 0]
