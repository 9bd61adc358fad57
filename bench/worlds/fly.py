"""Fly a world: lanes of one or many worlds in step, 50 Hz commands, recordings at 1 kHz, all in
float64 on the CPU.
"""

from types import SimpleNamespace

import numpy as np
import warp as wp

from bench.worlds.integrate import QUEUE, Gust, Ride, build
from bench.worlds.numbers import EXTRA
from bench.worlds.pilot import PERIOD
from bench.worlds.vehicle import EARTH, REAL, V3, V4, Body, Numbers

RECORDS = 20
"""Recordings a control period: one a millisecond."""
GUST_TIME = 0.3
"""Correlation time of gusts [s]."""
STEPS = {"rod": 5e-4, "string": 1.25e-4}
"""Largest integration step of each plant [s]."""


def rows(worlds: list[SimpleNamespace]) -> np.ndarray:
    """Structured array of :class:`Numbers`, one row a lane."""
    out = np.zeros(len(worlds), dtype=Numbers.numpy_dtype())
    for row, w in zip(out, worlds, strict=True):
        for name, value in vars(w).items():
            if name not in EXTRA:
                row[name] = value
    return out


def ornstein(rng: np.random.Generator, sizes: np.ndarray, ticks: int) -> np.ndarray:
    """Gusts at the period's edges, shape (ticks + 1, lanes, 3), of standard deviation ``sizes``,
    shape (lanes,).
    """
    keep = np.exp(-PERIOD / GUST_TIME)
    out = np.empty((ticks + 1, len(sizes), 3))
    out[0] = rng.normal(size=(len(sizes), 3))
    for k in range(ticks):
        out[k + 1] = keep * out[k] + np.sqrt(1 - keep**2) * rng.normal(size=(len(sizes), 3))
    return out * sizes[:, None]


def hover(worlds: list[SimpleNamespace], starts: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Bodies level at rest at ``starts`` (origins), actuators at hover."""
    out = np.zeros(len(worlds), dtype=Body.numpy_dtype())
    for row, w, start, fraction in zip(out, worlds, starts, used, strict=True):
        weight = EARTH * (w.mass + w.ball_mass + w.rope_mass)
        row["x"] = start + w.com
        row["q"] = (1.0, 0.0, 0.0, 0.0)
        row["used"] = fraction
        c = w.ocv
        rest = row["volt"] = c[0] + fraction * (c[1] + fraction * (c[2] + fraction * c[3]))
        for _ in range(20):  # load and voltage settle together
            volts = 1.0 + w.per_volt * (row["volt"] - w.nominal_voltage)
            row["spin"] = np.sqrt(weight / 4 / (w.thrust_square * volts))
            power = w.idle_power + w.kappa * weight * row["spin"][0] / w.efficiency
            row["volt"] = rest - w.resistance * power / row["volt"]
        if w.ideal_battery:
            row["volt"] = w.nominal_voltage
    return out


class Hanging:
    """Lanes of one plant between two commands, whatever the plant is."""

    def __init__(
        self, kind: str, worlds: list[SimpleNamespace], bodies: np.ndarray, starts: np.ndarray
    ):
        self.kind = kind
        self.lanes = len(worlds)
        # After the separation all plants are alike: the chain's lanes then go on in the kernel of
        # the rod.
        self._advance, nodes = build("rod" if kind == "chain" else kind)
        at = np.zeros((self.lanes, nodes, 3))
        for e, w in enumerate(worlds):
            if nodes == 1:
                at[e, 0] = (0.0, 0.0, -1.0)
            else:
                reach = np.arange(1, nodes + 1) * w.length / nodes
                reach[-1] += w.ball_reach
                at[e] = starts[e] + w.mount
                at[e, :, 2] -= reach
        if nodes > 1:  # half of the first piece of rope rides on the mount
            worlds = [
                SimpleNamespace(**vars(w) | {"mass": w.mass + 0.5 * w.rope_mass / nodes})
                for w in worlds
            ]
        self.worlds = worlds
        self._numbers = wp.array(rows(worlds), dtype=Numbers)
        self._bodies = wp.array(bodies, dtype=Body)
        ride = np.zeros(self.lanes, dtype=Ride.numpy_dtype())
        ride["hanging"] = 1
        ride["release_at"] = np.inf
        ride["separated_at"] = np.inf
        ride["tension"] = [EARTH * (w.ball_mass + w.rope_mass) for w in worlds]
        self.rides = wp.array(ride, dtype=Ride)
        self._places, self._speeds = wp.array(at, dtype=V3), wp.zeros((self.lanes, nodes), dtype=V3)
        self._delays = np.array([w.delay for w in worlds])
        self._kicks = np.array([w.kick for w in worlds])
        self._out = [wp.zeros((self.lanes, RECORDS), dtype=d) for d in (V3, V4, V3, V3)]
        self._chain = None
        if kind == "chain":
            from bench.worlds.chain import Chain

            self._chain = Chain(worlds, bodies, self._numbers)

    def look(self):
        """Bodies, which lanes hang, and the rope's tension [N]."""
        r = self.rides.numpy()
        if self._chain is None:
            return self._bodies.numpy(), r["hanging"] == 1, r["tension"]
        b = np.where(r["hanging"] == 1, self._chain.bodies, self._bodies.numpy())
        return b, r["hanging"] == 1, self._chain.tension

    def latch(self, lane: int, time: float) -> None:
        """Separate a lane's payload at ``time``."""
        r = self.rides.numpy()
        r["release_at"][lane] = time
        self.rides.assign(r)

    def period(self, t: float, queue: np.ndarray, stamps: np.ndarray, blow: np.ndarray):
        """Advance by one period; position, quaternion, ball, rate at each record, shape (E,
        RECORDS, ...).
        """
        marks = t + PERIOD * np.arange(1, RECORDS + 1) / RECORDS
        begin = np.full(self.lanes, t)
        early = None
        if self._chain is not None:
            early = self._hang(t, marks, begin, queue, stamps, blow)
        if self._chain is None or not self._chain.hanging.all():
            wp.launch(
                self._advance,
                self.lanes,
                [
                    self._numbers,
                    self._bodies,
                    self.rides,
                    self._places,
                    self._speeds,
                    wp.array(queue, dtype=V4),
                    wp.array(stamps, dtype=REAL),
                    wp.array(self._delays, dtype=REAL),
                    wp.array(blow, dtype=Gust),
                    wp.array(self._kicks, dtype=V3),
                    t,
                    PERIOD,
                    wp.array(begin, dtype=REAL),
                    wp.array(marks, dtype=REAL),
                    STEPS.get(self.kind, STEPS["rod"]),
                    *self._out,
                ],
            )
        out = [o.numpy().copy() for o in self._out]
        if early is not None:
            for mine, theirs in zip(out, early):
                known = ~np.isnan(theirs[..., 0])
                mine[known] = theirs[known]
        return out

    def _hang(self, t, marks, begin, queue, stamps, blow):
        """MuJoCo's part of a period: all hanging lanes from event to event; ``begin`` becomes where
        the rest starts.
        """
        chain = self._chain
        ride = self.rides.numpy()
        out = [np.full((self.lanes, RECORDS, n), np.nan) for n in (3, 4, 3, 3)]
        acts = stamps + self._delays[:, None]
        events = np.unique(
            np.round(np.concatenate([marks, acts.ravel(), ride["release_at"][chain.hanging]]), 9)
        )
        now = t
        last = marks[-1]
        for stop in events[(events > t + 1e-9) & (events <= last + 1e-9)]:
            active = np.array([np.flatnonzero(a <= now + 1e-9)[-1] for a in acts])
            part = (0.5 * (now + stop) - t) / PERIOD
            gust = [
                blow[n] + part * (blow[n + "_end"] - blow[n]) for n in ("push", "twist", "ball")
            ]
            chain.run(now, stop, queue[np.arange(self.lanes), active], *gust)
            now = stop
            hit = np.flatnonzero(np.abs(marks - now) < 1e-9)
            if len(hit):
                view = chain.bodies
                chain.look(now)
                for e in np.flatnonzero(chain.hanging):
                    out[0][e, hit[0]] = chain.data[e].qpos[:3]
                    out[1][e, hit[0]] = view[e]["q"]
                    out[3][e, hit[0]] = view[e]["w"]
                    out[2][e, hit[0]] = chain.ball_x[e]
            for e in np.flatnonzero(chain.hanging & (np.abs(ride["release_at"] - now) < 2e-9)):
                chain.look(now)
                chain.hanging[e] = False
                body = self._bodies.numpy()
                body[e] = chain.bodies[e]
                self._bodies.assign(body)
                ride["hanging"][e] = 0
                ride["separated_at"][e] = now
                begin[e] = now
                ride["ball_x"][e] = chain.ball_x[e]
                ride["ball_v"][e] = chain.ball_v[e] + self._kicks[e]
        begin[chain.hanging] = last + 1.0  # nothing left to do in the other kernel
        self.rides.assign(ride)
        return out


class Flights:
    """States and commands of a set of lanes; arrays over time (1 kHz), lane first."""

    def __init__(self, time, pos, quat, ball, commands, release_at, separated_at, rate, volt):
        self.time = time
        self.pos = pos
        self.quat = quat
        self.ball = ball
        self.commands = commands
        self.release_at = release_at
        self.separated_at = separated_at
        self.rate = rate
        self.volt = volt  # at the start of each period, shape (E, ticks)


def fly(*args, **options) -> Flights:
    """Fly lanes of a plant on the CPU; see :func:`_fly` for the arguments."""
    # state is read and written through views of the kernels' memory
    with wp.ScopedDevice("cpu"):
        return _fly(*args, **options)


def _fly(kind, worlds, pilots, references, seconds, gusts, seed, used, lost=0.0) -> Flights:
    """Fly lanes of a plant.

    Args:
        kind: "chain", "string" or "rod".
        worlds: numbers of each lane.
        pilots: function (t, pos, vel, quat, hanging) -> commands (E, 4).
        references: of each lane, with ``at(0)`` the start and ``release`` the time of its release
            command.
        seconds: to fly.
        gusts: standard deviations of force [N], torque [N m], force on the ball [N].
        seed: of the gusts.
        used: fraction of charge used at the start, shape (E,).
        lost: share of commands that never arrive, where the last one stays for a period more.
    """
    wp.config.log_level = wp.LOG_WARNING
    lanes = len(worlds)
    ticks = round(seconds / PERIOD)
    rng = np.random.default_rng(seed)
    starts = np.array([r.at(0.0)[0] for r in references])
    plant = Hanging(kind, worlds, hover(worlds, starts, used), starts)
    level = np.zeros((lanes, 4))
    level[:, 0] = [EARTH * (w.mass + w.ball_mass + w.rope_mass) for w in worlds]
    queue = np.repeat(level[:, None], QUEUE, 1)
    stamps = np.tile(np.arange(-QUEUE, 0) * PERIOD - 1.0, (lanes, 1))
    blows = [ornstein(rng, np.full(lanes, size), ticks) for size in gusts]
    jitter = rng.normal(size=lanes)
    pos, ball, rate = (np.empty((lanes, ticks * RECORDS + 1, 3)) for _ in range(3))
    quat = np.empty((lanes, ticks * RECORDS + 1, 4))
    sent = np.empty((lanes, ticks, 4))
    volts = np.empty((lanes, ticks))
    pos[:, 0] = starts
    quat[:, 0] = (1.0, 0.0, 0.0, 0.0)
    rate[:, 0] = 0.0
    ball[:, 0] = [s + w.mount - [0, 0, w.length + w.ball_reach] for s, w in zip(starts, worlds)]
    release_time = np.full(lanes, np.inf)
    link = np.random.default_rng([seed, 9])
    for k in range(ticks):
        t = k * PERIOD
        now = k * RECORDS
        b, hanging, tension = plant.look()
        sent[:, k] = pilots(t, pos[:, now], b["v"], b["q"], hanging)
        volts[:, k] = b["volt"]
        for e, (w, reference) in enumerate(zip(worlds, references)):
            if not np.isfinite(release_time[e]) and t >= reference.release - 1e-9:
                release_time[e] = t
                excess = tension[e] - EARTH * w.ball_mass
                plant.latch(
                    e, t + w.release_lag + w.lag_per_newton * excess + w.lag_jitter * jitter[e]
                )
        arrived = np.where(link.random((lanes, 1)) < lost, queue[:, -1], sent[:, k])
        queue = np.concatenate([queue[:, 1:], arrived[:, None]], 1)
        stamps = np.concatenate([stamps[:, 1:], np.full((lanes, 1), t)], 1)
        blow = np.zeros(lanes, dtype=Gust.numpy_dtype())
        for name, series in zip(("push", "twist", "ball"), blows):
            blow[name] = series[k]
            blow[name + "_end"] = series[k + 1]
        span = slice(now + 1, now + RECORDS + 1)
        pos[:, span], quat[:, span], ball[:, span], rate[:, span] = plant.period(
            t, queue, stamps, blow
        )
    time = np.arange(ticks * RECORDS + 1) * PERIOD / RECORDS
    return Flights(
        time, pos, quat, ball, sent, release_time, plant.rides.numpy()["separated_at"], rate, volts
    )
