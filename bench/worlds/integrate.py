"""RK4 of vehicle and rope between events: command switches, the separation and the instants of
recording fall on step edges.
"""

from functools import cache

import warp as wp

from bench.worlds import rod, string
from bench.worlds.vehicle import (
    EARTH,
    REAL,
    V3,
    V4,
    Body,
    Numbers,
    along,
    ball_force,
    free_motion,
    rotation,
    vehicle_load,
)

PLANTS = {"rod": lambda: rod.build(), "string": lambda: string.build(24)}
QUEUE = 6
"""Commands that are remembered; the oldest is the one before the delay's reach."""


@wp.struct
class Ride:
    """What else a lane carries: the ball after separation, the release, the last tension."""

    hanging: wp.int32
    release_at: REAL
    ball_x: V3
    ball_v: V3
    tension: REAL
    thrust: REAL
    separated_at: REAL


@wp.struct
class Gust:
    """Forces [N, world], torque [N m, body] at the start and the end of a period,
    linear between.
    """

    push: V3
    push_end: V3
    twist: V3
    twist_end: V3
    ball: V3
    ball_end: V3


@cache
def build(kind: str):
    """Kernels ``advance`` and ``settle`` of a plant and its number of nodes."""
    rates, ball, tidy, nodes = PLANTS[kind]()
    N = nodes

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        numbers: wp.array(dtype=Numbers),
        bodies: wp.array(dtype=Body),
        rides: wp.array(dtype=Ride),
        places: wp.array2d(dtype=V3),
        speeds: wp.array2d(dtype=V3),
        commands: wp.array2d(dtype=V4),
        stamps: wp.array2d(dtype=REAL),
        delays: wp.array(dtype=REAL),
        gusts: wp.array(dtype=Gust),
        kicks: wp.array(dtype=V3),
        edge: REAL,
        period: REAL,
        starts: wp.array(dtype=REAL),
        marks: wp.array(dtype=REAL),
        step: REAL,
        out_x: wp.array2d(dtype=V3),
        out_q: wp.array2d(dtype=V4),
        out_ball: wp.array2d(dtype=V3),
        out_w: wp.array2d(dtype=V3),
    ):
        lane = wp.tid()
        p = numbers[lane]
        b = bodies[lane]
        r = rides[lane]
        g = gusts[lane]
        x0 = wp.zeros(shape=(N,), dtype=V3)
        v0 = wp.zeros(shape=(N,), dtype=V3)
        xs = wp.zeros(shape=(N,), dtype=V3)
        vs = wp.zeros(shape=(N,), dtype=V3)
        dx = wp.zeros(shape=(N,), dtype=V3)
        dv = wp.zeros(shape=(N,), dtype=V3)
        a = wp.zeros(shape=(N,), dtype=V3)
        for i in range(N):
            x0[i] = places[lane, i]
            v0[i] = speeds[lane, i]
        t = starts[lane] + REAL(0.0)
        tiny = REAL(1.0e-9)
        for k in range(marks.shape[0]):
            mark = marks[k]
            while t < mark - tiny:
                stop = mark
                now = int(0)  # noqa: UP018, RUF046  a dynamic variable of the kernel
                for j in range(QUEUE):  # newest last
                    at = stamps[lane, j] + delays[lane]
                    if at <= t + tiny:
                        now = j
                    elif at < stop - tiny:
                        stop = at
                if r.hanging == 1 and r.release_at > t + tiny and r.release_at < stop - tiny:
                    stop = r.release_at
                command = commands[lane, now]
                count = int(wp.ceil((stop - t) / step - tiny))
                h = (stop - t) / REAL(float(count))
                for sub in range(count):
                    begin = t + REAL(float(sub)) * h
                    total = Body()
                    stage = b
                    for i in range(N):
                        xs[i] = x0[i]
                        vs[i] = v0[i]
                        dx[i] = V3()
                        dv[i] = V3()
                    ball_dx = V3()
                    ball_dv = V3()
                    first_pull = r.tension + REAL(0.0)
                    ball_vs = r.ball_v + V3()
                    for s in range(4):
                        weight = REAL(2.0)
                        if s == 0 or s == 3:
                            weight = REAL(1.0)
                        ahead = REAL(0.5) * h
                        if s == 2:
                            ahead = h
                        here = REAL(0.0)
                        if s == 1 or s == 2:
                            here = REAL(0.5) * h
                        if s == 3:
                            here = h
                        part = (begin + here - edge) / period
                        push = g.push + part * (g.push_end - g.push)
                        twist = g.twist + part * (g.twist_end - g.twist)
                        on_ball = g.ball + part * (g.ball_end - g.ball)
                        d = Body()
                        if r.hanging == 1:
                            d, pull, thrust = rates(
                                p, stage, command, push, twist, on_ball, r.tension, xs, vs, a
                            )
                            if s == 0:
                                r.thrust = thrust
                                first_pull = pull
                        else:
                            force, torque, thrust, d = vehicle_load(p, stage, command, push, twist)
                            d = free_motion(p, stage, force, torque, d)
                            air = ball_force(p, ball_vs, rotation(stage.q), thrust, 0) + on_ball
                            ball_a = air / p.ball_mass + V3(REAL(0.0), REAL(0.0), -REAL(EARTH))
                            ball_dx += weight * ball_vs
                            ball_dv += weight * ball_a
                            if s < 3:
                                ball_vs = r.ball_v + ahead * ball_a
                        total = along(total, d, weight)
                        if s == 0 and r.hanging == 1:
                            r.tension = first_pull
                        for i in range(N):
                            dx[i] = dx[i] + weight * vs[i]
                            dv[i] = dv[i] + weight * a[i]
                        if s < 3:
                            for i in range(N):
                                xs[i] = x0[i] + ahead * vs[i]
                                vs[i] = v0[i] + ahead * a[i]
                            stage = along(b, d, ahead)
                    sixth = h / REAL(6.0)
                    b = along(b, total, sixth)
                    b.q = b.q / wp.length(b.q)
                    if r.hanging == 1:
                        for i in range(N):
                            x0[i] = x0[i] + sixth * dx[i]
                            v0[i] = v0[i] + sixth * dv[i]
                        tidy(x0, v0)
                    else:
                        r.ball_x = r.ball_x + sixth * ball_dx
                        r.ball_v = r.ball_v + sixth * ball_dv
                t = stop
                if r.hanging == 1 and wp.abs(t - r.release_at) < tiny:
                    left_x, left_v = ball(p, b, x0, v0)
                    r.ball_x = left_x
                    r.ball_v = left_v + kicks[lane]
                    r.hanging = 0
                    r.separated_at = t
            if r.hanging == 1:
                here_x, here_v = ball(p, b, x0, v0)
                r.ball_x = here_x
                r.ball_v = here_v
            if mark > starts[lane] - tiny:  # earlier ones are the caller's
                out_x[lane, k] = b.x - rotation(b.q) * p.com
                out_q[lane, k] = b.q
                out_w[lane, k] = b.w
                out_ball[lane, k] = r.ball_x
        bodies[lane] = b
        rides[lane] = r
        for i in range(N):
            places[lane, i] = x0[i]
            speeds[lane, i] = v0[i]

    return advance, N
