"""Backward pass of flights through the surrogate, a kernel a step, a thread a flight; the network's part lies between two of them.

Derivatives are written by hand; a rotation's is that by a turn about the body axes, R exp(turn). Equations:
:mod:`visthrow.training.first_order.surrogate`.
"""

from functools import lru_cache

import warp as wp

from sim.params import GRAVITY
from visthrow.onboard import observations as ob
from visthrow.training.first_order.flights import Course
from visthrow.training.first_order.surrogate import TAUT

SLACK_THROTTLE = 0.05
"""Least throttle at which the slope of the thrust is taken: at none it is nought, and nothing would lead away from there."""


@wp.struct
class Setting:
    """What flights and policy are like: the surrogate, the plants, what the actor sees and how it reacts."""

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
    age: wp.array(dtype=float)  # of poses [s]


@wp.func
def turned(quat: wp.quat, arm_b: wp.vec3, grad_w: wp.vec3):
    """Derivative by the turn of what has the derivative ``grad_w`` by the world vector ``R arm_b``."""
    return wp.cross(arm_b, wp.quat_rotate_inv(quat, grad_w))


@wp.func
def step_back(p: Setting, x: Course, adj: Course, k: int, e: int):
    """Add to the derivatives by state k, k - 1 and by the commands up to k what those by state k + 1 make of them."""
    dt, half, up = p.period, 0.5 * p.period, wp.vec3(0.0, 0.0, 1.0)
    mass, load_mass, mount = p.mass[e], p.load_mass[e], p.mount[e]
    rot, rot_next = x.quat[k, e], x.quat[k + 1, e]
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
        g_n = pull * both - g_pull * p.tension[0] / mass * f - 2.0 * swing * along * u
        g_u = 2.0 * swing * across
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
    """Backward pass of step k of flights whose actor sees a state layout."""
    history, width = layout.history, layout.payload
    previous_at, goal_at, load_at = ob.VEHICLE, ob.VEHICLE + 5, ob.VEHICLE + 5 + layout.goal

    @wp.func
    def three(by_seen: wp.array2d(dtype=float), e: int, i: int):
        return wp.vec3(by_seen[e, i], by_seen[e, i + 1], by_seen[e, i + 2])

    @wp.func
    def vehicle_back(by_seen: wp.array2d(dtype=float), x: Course, adj: Course, i: int, e: int, share: float):
        """From an observation to state i, of which ``share`` is in it: the vehicle and the goal."""
        adj.pos[i, e] += share * three(by_seen, e, 0)
        adj.vel[i, e] += share * three(by_seen, e, 3)
        rate = share * three(by_seen, e, 6)
        adj.response[i, e] += wp.vec4(0.0, rate[0], rate[1], rate[2])
        x_axis = turned(x.quat[i, e], wp.vec3(1.0, 0.0, 0.0), three(by_seen, e, 9))
        adj.turn[i, e] += share * (x_axis + turned(x.quat[i, e], wp.vec3(0.0, 1.0, 0.0), three(by_seen, e, 12)))
        adj.load_pos[i, e] -= share * wp.vec3(by_seen[e, goal_at], by_seen[e, goal_at + 1], 0.0)

    @wp.func
    def load_back(by_seen: wp.array2d(dtype=float), adj: Course, age: int, i: int, e: int, share: float):
        """From an observation to state i: the payload as it was ``age`` observations ago."""
        offset = share * three(by_seen, e, load_at + width * age)
        adj.load_pos[i, e] += offset
        adj.pos[i, e] -= offset

    @wp.kernel(module="unique", enable_backward=False)
    def backward_kernel(
        # Params:
        p: Setting,
        k: int,
        # State in:
        adj: Course,
        by_clipped: wp.array3d(dtype=float),
        # In:
        x: Course,
        steps: wp.array(dtype=wp.int32),
        action: wp.array3d(dtype=float),
        by_seen: wp.array2d(dtype=float),  # by observation k + 1
        # Out:
        by_action: wp.array3d(dtype=float),
    ):
        e = wp.tid()
        late = p.age[e] / p.period
        command = wp.vec4()
        if k < steps[e]:
            for j in range(5):
                by_clipped[k, e, j] += by_seen[e, previous_at + j]
            vehicle_back(by_seen, x, adj, k + 1, e, 1.0 - late)
            vehicle_back(by_seen, x, adj, k, e, late)
            for age in range(history + 1):
                load_back(by_seen, adj, age, wp.max(k + 1 - age, 0), e, 1.0 - late)
                load_back(by_seen, adj, age, wp.max(k - age, 0), e, late)
            step_back(p, x, adj, k, e)
            throttle = wp.clamp(0.5 * (action[k, e, 0] + 1.0), SLACK_THROTTLE, 1.0)
            scale = wp.vec4(p.max_thrust * throttle, p.max_rate[0], p.max_rate[1], p.max_rate[2])
            command = wp.cw_mul(scale, adj.command[k, e])
        for j in range(5):
            total = by_clipped[k, e, j]
            if j < 4:
                total += command[j]
            if wp.abs(action[k, e, j]) > 1.0:
                total = 0.0
            by_action[k, e, j] = wp.where(k > steps[e], 0.0, by_action[k, e, j] + total)

    return backward_kernel
