"""Backward pass of flights: one kernel for each step of the surrogate, with a thread for each
flight, and the network's derivatives between steps.

Warp differentiates the surrogate's step. The derivative of the cost by a state is complete when all
later steps have been propagated. Therefore the network is differentiated by its observations step
by step, and by its weights for all steps together at the end."""

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from visthrow.onboard import actions
from visthrow.onboard import observations as ob
from visthrow.training.first_order.surrogate import TAUT, Course
from visthrow.training.ppo.network import Network

# lowest throttle at which the thrust's slope is evaluated: at throttle 0 the slope is 0, and no
# gradient would lead away from it
SLACK_THROTTLE = 0.05
# first columns of previous action, goal and payload in a state observation
PREVIOUS_AT = ob.VEHICLE
GOAL_AT = ob.VEHICLE + 5
LOAD_AT = ob.VEHICLE + 7


@wp.struct
class BackwardParams:
    """Parameters of surrogate, plants and policy."""

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
    """Return a function whose value is its first argument and whose derivative is that of its
    second.
    """

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
    """Return the commanded thrust and rates of an action, with the slope for the derivatives."""
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
    """Return the vector from the rope's mount to the payload in state k [m], world frame."""
    return x.load_pos[k, e] - x.pos[k, e] - wp.quat_rotate(x.quat[k, e], p.mount[e])


@wp.func
def advance(
    p: BackwardParams, x: Course, made: Course, action: wp.array3d(dtype=float), k: int, e: int
):
    """Compute state k + 1 from state k and the commands up to k."""
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
    """Add a share of the observation of state k, with the payload's positions of up to ``history``
    earlier steps.
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
    made: Course,  # only its gradients matter; they are those of x
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
    """A network's actions over the steps of flights, shape (T, E, 5), with the derivatives by them
    and by the observations of one step, shape (E, D).
    """

    def __init__(self, network: Network, obs: Tensor):
        """Allocate; ``obs``: buffer of the flights' observations, shape (T, E, D)."""
        self._network = network
        self._obs = obs
        self.action, self.by_action = obs.new_zeros(2, *obs.shape[:2], actions.ACTIONS)
        self.by_observation = torch.zeros_like(obs[0])

    def _decide(self, obs: Tensor) -> Tensor:
        return self._network.mlp(self._network.obs_normalizer(obs))

    def forward(self, k: int, obs: Tensor, flying: Tensor) -> Tensor:
        """Return the actions of step k, shape (E, 5), for observations, shape (E, D), of the
        flights in progress, shape (E,).
        """
        rows = _select_rows(flying)
        self.action[k, rows] = self._decide(obs[rows])
        return self.action[k]

    def backpropagate(self, k: int, flown: Tensor) -> None:
        """Convert derivatives by the actions of step k to derivatives by its observations, for the
        flights that flew this step, shape (E,).
        """
        rows = _select_rows(flown)
        with torch.enable_grad():
            observation = self._obs[k, rows].detach().requires_grad_()
            action = self._decide(observation)
        (self.by_observation[rows],) = torch.autograd.grad(
            action, observation, self.by_action[k, rows]
        )

    def gradients(self, flown: Tensor, shares: Tensor) -> None:
        """Set the gradients of the weights from the steps that were flown, bool, shape (T, E), with
        a factor for each flight, shape (E,).
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
    """Return the rows where a mask, shape (N,), is not 0. On a GPU return all rows, because a
    selection would have to wait for the device.
    """
    return slice(0, len(mask)) if mask.is_cuda or bool(mask.all()) else mask.nonzero()[:, 0]
