"""Checks of units, frames and delays by physical relations that hold for any vehicle.

Onboard-safe.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import matrix_of_quat, rotate, rotate_back, tilt_deg
from visthrow.logs.axes import EXCHANGES, is_mirror
from visthrow.logs.check import headings, relations
from visthrow.logs.check.rows import NOTHING, KnownVehicle, Row, worst
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples

# smallest standard deviation at which channels are compared [m], [m/s] or [rad/s]
MOVES = 0.05
_FASTEST_TURN = 40.0  # rate between two samples above which an attitude jumps [rad/s]
_AROUND_JUMP = 0.06  # time over which rates are computed [s]
STEEPEST = 75.0  # median tilt of a flight [deg]
TURNED = 30.0  # larger than a mount's error and the lean of a flight's mean force [deg]

ATTITUDES = ("quat_wb", "est_quat_wb", "mocap_quat_wb")
_PREFIXES = ("", "est_", "mocap_", "payload_")
_FASTEST = 60.0  # of vehicles that throw [m/s]
_FARTHEST = 2000.0  # likewise [m]
_SHARES = ("motor_command", "motor_wanted", "throttle")
# largest command with full scale 1: a controller may demand more than 1, but not twice as much
_LARGEST_SHARE = 2.0
_VOLTS = (0.5, 100.0)  # of any pack of such a vehicle [V]
# correlations: of the same flight, surely of the same flight, and margin by which other axes fit
# better
BELONGS = 0.35
FIRMLY = 0.7
CLEARLY = 0.12
_LIVELY = 0.2  # rates that noise and air currents alone do not cause [rad/s]
_DELAY_WARN = 0.02  # between measurements of one motion [s]
DELAY_BAD = 0.05
LATEST = 0.16  # largest delay of motors with filters, which is 0 to 0.12 s in practice [s]
_RESPONSE = 0.1  # half of the longest time in which rates follow their commands [s]
DELAY_KNOWN = 0.012  # standard deviation below which a delay is known [s]
_UNTOLD = 0.15  # standard deviation above which a delay is unknown [s]
_PERIOD = (2e-4, 2.0)  # between two positions, median [s]
_NATS = 10.0  # evidence needed for other axes: a share e^-10 of valid logs would be rejected
_SHARED = 3.0  # factor by which overlapping accelerations have fewer independent samples
# RMS acceleration above the noise of accelerometers and the effect of air currents [m/s^2]
_PUSHED = 0.2
_LONGER = 0.05  # relative difference from the model's length: markers are not at the cable's ends
_OTHER_CABLE = 0.25  # relative difference from the model's length of another cable
_COMPARED = 4000  # samples of an accelerometer that are compared at each delay
_SPAN = 0.06  # over which velocities and accelerations are averaged [s]
# correlation of the small forces in the rotor plane (0.65 to 0.73 in real flights)
_CORRELATED = 0.5
_FORCES = (0.5, 2.0)  # ratios of two measurements of one force
_TAUT = 0.1  # relative deviation of a taut cable's length from its median
_HEAVIEST = 0.9  # largest share of the payload in the total mass
_UP = np.array([0.0, 0.0, GRAVITY])  # what an accelerometer at rest measures [m/s^2]
_OFFSET = 0.5  # mean acceleration due to bias and tilt of an accelerometer [m/s^2]


def look(log: FlightLog, vehicle: KnownVehicle = NOTHING) -> Iterator[Row]:
    """Yield the findings of all physical checks of a flight."""
    yield from _plausible(log)
    for prefix in _PREFIXES:
        pos = f"{prefix}pos_w"
        vel = f"{prefix}vel_w"
        quat = f"{prefix}quat_wb"
        if pos in log and vel in log:
            yield from _velocity(log, pos, vel)
        if quat in log and prefix != "payload_":
            yield from _rates(log, quat)
            yield from _gravity(log, quat, pos)
            yield from _forces(log, quat, vel if vel in log else pos)
    yield from _still_gravity(log)
    yield from _commands(log)
    yield from _cable(log, vehicle)
    yield from _check_same_quantity(log)


def is_usable(samples: Samples | None, threshold: float) -> bool:
    """Return whether there are enough samples, with a spread above a threshold."""
    if samples is None or len(samples.time) <= 50:
        return False
    return bool(np.max(np.std(samples.values, axis=0)) > threshold)


def median_tilt(quat: np.ndarray) -> float:
    """Return the median tilt of attitudes, shape (N, 4) [deg]."""
    up = matrix_of_quat(quat)[:, 2, 2]
    return np.degrees(np.median(np.arccos(np.clip(up, -1.0, 1.0))))


def _plausible(log: FlightLog) -> Iterator[Row]:
    for name, channel in log.channels.items():
        path = log.samples(name)
        placed = channel.unit == "m" and channel.values.shape[1:] == (3,)
        if placed and path is not None and "setpoint" not in name:
            yield from _plausible_path(name, path)
    yield from _implausible_sizes(log)


def _plausible_path(name: str, path: Samples) -> Iterator[Row]:
    """Report positions with a sampling period, speed or range that no vehicle has."""
    period = np.median(np.diff(path.time))
    if not _PERIOD[0] <= period <= _PERIOD[1]:
        text = (
            f"a sample every {period:.3g} s, expected {_PERIOD[0]:g} to {_PERIOD[1]:g}: is the"
            " unit of time wrong?"
        )
        yield Row("units", name, "bad", text, {"period_s": period})
        return
    speeds = np.linalg.norm(path.derivative(0.1).values, axis=1)
    if not len(speeds):
        return
    fast = np.percentile(speeds, 99)
    farthest = np.max(np.abs(path.values))
    if fast > _FASTEST or farthest > _FARTHEST:
        text = (
            f"{fast:.3g} m/s and {farthest:.3g} m from the origin: no such vehicle; millimetres"
            " taken for metres?"
        )
        figures = {"speed_p99_m_s": fast, "farthest_m": farthest}
        yield Row("units", name, "bad", text, figures)


def _implausible_sizes(log: FlightLog) -> Iterator[Row]:
    """Report commands, voltages and angles whose size shows a wrong unit."""
    for name in ATTITUDES:
        attitude = log.samples(name)
        tilt = 0.0 if attitude is None else median_tilt(attitude.values)
        if tilt > STEEPEST:
            text = (
                f"half of the time tilted by more than {tilt:.0f} deg: degrees taken for"
                " radians, axes, or quaternion order?"
            )
            yield Row("units", name, "bad", text, {"median_tilt_deg": tilt})
    for name in _SHARES:
        share = log.samples(name, 1)
        if share is None or log[name].unit != "1":
            continue
        high = np.percentile(np.abs(share.values), 95)
        if high > _LARGEST_SHARE:
            text = f"95 % of the values reach {high:.3g}: no shares of the full command"
            yield Row("units", name, "bad", text, {"p95": high})
    for name in ("battery_voltage", "supply_voltage"):
        voltage = log.samples(name, 1)
        middle = 0.0 if voltage is None else np.median(voltage.values)
        if middle > _VOLTS[1] or 0.0 < middle < _VOLTS[0]:
            text = f"{middle:.3g} V: no such pack; another unit?"
            yield Row("units", name, "bad", text, {"median_v": middle})


def _velocity(log: FlightLog, pos: str, vel: str) -> Iterator[Row]:
    place = log[pos].samples()
    velocity = log[vel].samples()
    if not (is_usable(place, 0.02) and is_usable(velocity, 0.0)):
        return
    message = log.notes(pos).get("message")
    one_clock = message is not None and message == log.notes(vel).get("message")
    yield from _compare(place.derivative(), velocity, f"d({pos})/dt, {vel}", one_clock)


def _rates(log: FlightLog, quat: str) -> Iterator[Row]:
    measured = log.samples("rate_b")
    derived = _steady_rates(log[quat].samples())
    turns = is_usable(derived, MOVES) or is_usable(measured, MOVES)
    if turns and is_usable(derived, 0.0) and is_usable(measured, 0.0):
        yield from _compare(derived, measured, f"rate of {quat}, rate_b")


def _steady_rates(attitudes: Samples) -> Samples:
    """Return body rates of attitudes without those across jumps, such as an estimate's reset."""
    rates = attitudes.rates()
    fine = attitudes.rates(0.0)
    jumps = fine.time[np.linalg.norm(fine.values, axis=1) > _FASTEST_TURN]
    if not len(jumps):
        return rates
    first = np.searchsorted(jumps, rates.time - _AROUND_JUMP)
    steady = first == np.searchsorted(jumps, rates.time + _AROUND_JUMP)
    return Samples(rates.time[steady], rates.values[steady])


def _compare(
    first: Samples, second: Samples, channels: str, one_clock: bool = False
) -> Iterator[Row]:
    """Report the relation of two measurements of the same motion; ``one_clock``: of one message."""
    relation = relations.relate(first, second)
    if relation is None:
        return
    figures = _figures(relation)
    if _disagrees(relation):
        text = (
            f"hardly go together in any axes (correlation {relation.axes_correlation:.2f}): not the"
            " same flight, or noise"
        )
        yield Row("frames", channels, "bad", text, figures)
        return
    if _is_turned(relation):
        yield _report_other_axes(relation, channels, "go together")
        return
    yield from _together_rows(relation, channels, figures, (0.67, 1.5))
    yield _report_delay(relation, channels, figures, one_clock)


def _together_rows(
    relation: relations.Relation, channels: str, figures: dict, usual: tuple[float, float]
) -> Iterator[Row]:
    """Report scale and delay of a pair that correlates in its axes; ``usual``: range of ratios."""
    text = f"go together as they are, correlation {relation.correlation:.2f}"
    yield Row("frames", channels, "ok", text, figures)
    if usual[0] < relation.scale < usual[1]:
        return
    hint = relations.unit_hint(relation.scale)
    # noise of the first signal reduces the ratio as much as the square of the correlation
    lowest = usual[0] * relation.correlation**2
    weak = not hint and lowest < relation.scale < usual[1]
    text = f"the second is {relation.scale:.4g} times the first: "
    text += "noise dilutes it" if weak else hint or "no unit explains it"
    yield Row("units", channels, "warn" if weak else "bad", text, figures)


def _spread(vectors: np.ndarray) -> float:
    """Return the root mean square deviation of vectors from their mean, shape (N, 3)."""
    return np.sqrt(np.sum(np.var(vectors, axis=0)))


def _figures(relation: relations.Relation) -> dict[str, float]:
    return {
        "correlation": relation.correlation,
        "delay_s": relation.delay,
        "delay_sd_s": relation.delay_sd,
        "scale": relation.scale,
    }


def _is_turned(relation: relations.Relation) -> bool:
    return relation.nats > _NATS and relation.axes_correlation > relation.correlation + CLEARLY


def _report_other_axes(relation: relations.Relation, channels: str, words: str) -> Row:
    """Report a pair that correlates in other axes."""
    figures = _figures(relation) | {"axes": relation.axes, "nats": relation.nats}
    return Row("frames", channels, "bad", f"{words} as {_better(relation)}", figures)


def _better(relation: relations.Relation, whose: str = "") -> str:
    """Return the text on an exchange of axes that correlates better than the axes as they are."""
    kind = "a mirror image" if is_mirror(relation.axes) else "axes exchanged or turned"
    text = f"({relation.axes}){whose}, {relation.nats:.0f} nats better: {kind} "
    return text + f"(correlation {relation.axes_correlation:.2f}, not {relation.correlation:.2f})"


def _report_delay(
    relation: relations.Relation, channels: str, figures: dict, one_clock: bool
) -> Row:
    """Report the delay of a second measurement of one motion, and its remedy."""
    if relation.delay_sd > _UNTOLD:
        text = "how late the second is cannot be determined: too slow, or too noisy"
        return Row("delay", channels, "ok", text, figures)
    text = (
        f"the second is {1e3 * relation.delay:+.1f} ms behind the first (sd"
        f" {1e3 * relation.delay_sd:.1f} ms)"
    )
    large = (
        abs(relation.delay) > DELAY_BAD
        and relation.delay_sd < 0.3 * abs(relation.delay)
        and relation.correlation > FIRMLY
    )
    if large and one_clock:
        text += ": both are of one message, so a filter makes it"
    elif large:
        text += (
            f": streams on clocks apart; add {-relation.delay:+.3f} s to the second's time"
            " (offset of its clock in the mapping)"
        )
    late = abs(relation.delay) > max(_DELAY_WARN, 2.0 * relation.delay_sd)
    verdict = "bad" if large and not one_clock else "warn" if late else "ok"
    return Row("delay", channels, verdict, text, figures)


def _disagrees(relation: relations.Relation) -> bool:
    """Return whether two signals hardly correlate in any axes; the best of 48 exchanges reaches 0.5
    by chance.
    """
    return relation.axes_correlation < BELONGS or (
        relation.correlation < BELONGS and relation.axes_correlation < FIRMLY
    )


def _gravity(log: FlightLog, quat: str, pos: str) -> Iterator[Row]:
    """Check that the mean specific force, rotated to the world frame, balances gravity."""
    attitude = log.samples(quat)
    force_b = log.samples("acc_b")
    if attitude is None or force_b is None:
        return
    sample = np.interp(attitude.time, force_b.time, np.arange(len(force_b.time)))
    nearest = force_b.values[np.round(sample).astype(int)]
    mean_w = np.mean(matrix_of_quat(attitude.values) @ nearest[..., None], axis=0)[:, 0]
    path = log.samples(pos)
    vel_w = [] if path is None else path.derivative().values
    if len(vel_w):
        mean_w = mean_w - (vel_w[-1] - vel_w[0]) / np.ptp(path.time)
    size = np.linalg.norm(mean_w)
    tilt = tilt_deg(mean_w)
    figures = {"mean_m_s2": mean_w.tolist(), "tilt_deg": tilt}
    channels = f"acc_b, {quat}"
    if not 0.85 < size / GRAVITY < 1.15:
        hint = relations.unit_hint(size / GRAVITY)
        text = (
            f"the mean force is {size:.4g} m/s^2, not {GRAVITY}:"
            f" {hint or 'axes are exchanged, or gravity is missing'}"
        )
        yield Row("units" if hint else "frames", channels, "bad", text, figures)
    elif tilt > TURNED:
        text = f"the mean force points {tilt:.0f} deg off up: turned or mirrored axes"
        yield Row("frames", channels, "bad", text, figures)
    else:
        verdict = "warn" if tilt > 3.0 or abs(size / GRAVITY - 1.0) > 0.03 else "ok"
        text = f"the mean force is {size:.3f} m/s^2 and {tilt:.2f} deg off up"
        yield Row("frames", channels, verdict, text, figures)


def _forces(log: FlightLog, quat: str, path: str) -> Iterator[Row]:
    """Compare the force on the vehicle, by accelerometer and attitude, with the change of its
    velocity.

    Without an accelerometer, the force is a multirotor's thrust along body z, which acts on vehicle
    and payload together."""
    motion = log.samples(path)
    attitude = log.samples(quat)
    if motion is None or attitude is None:
        return
    time, acc = accelerations(motion, log[path].unit)
    if len(time) < 50 or _spread(acc) < _PUSHED:
        return
    turn = attitude.attitudes(time)
    sensed = "acc_b" in log
    channels = f"d({path})/dt, {quat} {'acc_b' if sensed else 'thrust along z'}"
    if sensed:
        force_b = log["acc_b"].samples()
        if len(force_b.time) < 50 or sparse(force_b.time) or sparse(motion.time):
            return
        force_w = rotate(attitude.attitudes(force_b.time), force_b.values)
        pushed = Samples(force_b.time, force_w - _UP).mean_over(time, _SPAN)
    else:
        hangs, relative = _find_hanging(log, quat, time, acc)
        if np.sum(hangs) < 50:
            return
        time = time[hangs]
        acc = _together(acc[hangs], relative[hangs], turn[hangs])
        acc, pushed = _compute_leans(acc, turn[hangs])
    relation = relations.relate(Samples(time, acc), Samples(time, pushed))
    if relation is None:
        return
    wrong = _report_exchange(relation, channels)
    if wrong is None:
        velocity = motion.derivative(_SPAN) if log[path].unit == "m" else motion
        wrong = _report_turned_path(
            headings.turn_of(time, acc, pushed, velocity.at(time)), channels
        )
    if wrong is None and sensed:
        wrong = _report_turned_body(Samples(time, acc), attitude, force_b, channels)
    if wrong is not None:
        yield wrong
    else:
        yield from _list_unchecked(acc)
    if wrong is None or wrong.verdict == "warn":
        yield from _check_push(relation, acc, pushed, channels, sensed)


def _list_unchecked(acc: np.ndarray) -> Iterator[Row]:
    """Report the axes along which a path hardly accelerates, so that its mirror image fits as well;
    ``acc``: shape (N, 3).
    """
    power = np.var(acc, axis=0)
    share = power / np.sum(power)
    needed = 0.5 * CLEARLY  # a mirror image changes a correlation by twice the mirrored share
    for axis, part in zip("xy", share.tolist()):
        if part < needed:
            text = (
                f"cannot be answered: {100 * part:.2g} % of the acceleration is along {axis},"
                f" {100 * needed:g} % is needed"
            )
            yield Row("answers", f"mirrored {axis}", "warn", text, {"share": part})


def _report_turned_path(turn: headings.Turn, channels: str) -> Row | None:
    """Return a row if positions and velocities are surely turned about z, else None."""
    if turn.nats < _NATS or turn.alone < CLEARLY:
        return None
    angle, sd = np.degrees([turn.angle, turn.sd])
    text = (
        f"positions and velocities are turned by {angle:+.1f} deg about z (sd {sd:.1f} deg),"
        f" {turn.nats:.0f} nats better: path and attitude are of two frames"
    )
    figures = {"turned_deg": angle, "sd_deg": sd, "of": "path", "nats": turn.nats}
    return Row("frames", channels, "bad", text, figures)


def _find_hanging(
    log: FlightLog, quat: str, time: np.ndarray, acc: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the payload hangs on its cable at each time, shape (N,), and its acceleration
    relative to the vehicle [m/s^2], shape (N, 3); all true and 0 if no payload is measured.
    """
    place = log.samples(quat.replace("quat_wb", "pos_w"), 1)
    payload = log.samples("payload_pos_w")
    if payload is None or place is None:
        return np.ones(len(time), bool), np.zeros_like(acc)
    gap = payload.at(time) - place.at(time)
    length = np.linalg.norm(gap, axis=1)
    acc_p = accelerations(payload, "m")
    if not len(acc_p.time):
        return np.zeros(len(time), bool), np.zeros_like(acc)
    hangs = np.abs(length - np.median(length)) < _TAUT * np.median(length)
    hangs &= (time > acc_p.time[0]) & (time < acc_p.time[-1])
    return hangs, acc_p.at(time) - acc


def _together(acc: np.ndarray, relative: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the acceleration of the common centre of mass of vehicle and payload [m/s^2], for the
    payload's share of the mass with which it follows the thrust best.
    """
    up = matrix_of_quat(turn)[:, :, 2]
    lean = (up / np.maximum(up[:, 2:], 0.2))[:, :2]
    off = acc[:, :2] - lean * (acc[:, 2:] + GRAVITY)
    slope = relative[:, :2] - lean * relative[:, 2:]
    power = max(np.sum(slope**2), 1e-12)
    share = np.clip(-np.sum(off * slope) / power, 0.0, _HEAVIEST)
    return acc + share * relative


def _compute_leans(acc: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the horizontal parts of accelerations, and of a thrust along body z that has their
    vertical part, both [m/s^2], shape (N, 3).
    """
    level = np.array([1.0, 1.0, 0.0])
    up = matrix_of_quat(turn)[:, :, 2]
    pushed = up / np.maximum(up[:, 2:], 0.2) * (acc[:, 2:] + GRAVITY)
    return acc * level, pushed * level


def sparse(time: np.ndarray) -> bool:
    """Return whether the sampling period is too long to average the force between samples."""
    return len(time) > 1 and np.median(np.diff(time)) > relations.INDEPENDENT


@dataclass(frozen=True)
class _LevelForces:
    """Correlations of lateral forces by an accelerometer and by a path, at the delay with the
    highest correlation.
    """

    plain: float  # largest correlation of the axes as they are, at any delay
    turned: complex  # absolute value: correlation after a rotation; argument: its angle
    mirrored: float  # correlation with the mirror image
    size: float  # ratio of the accelerometer's forces to those by the path
    relation: relations.Relation | None  # between both

    @property
    def correlation(self) -> float:
        """Correlation after a rotation or reflection, limited to below 1."""
        return min(max(abs(self.turned), self.mirrored), 0.999)


def _compare_level(acc: Samples, attitude: Samples, force_b: Samples) -> _LevelForces | None:
    """Compare lateral forces at delays of attitude and accelerometer, which share a clock, relative
    to the path; None with too few samples or without lateral motion.
    """
    reach = 2.0 * DELAY_BAD  # half of it already excludes a log
    first = force_b.time[0] + _SPAN + reach
    last = force_b.time[-1] - _SPAN - reach
    known = np.flatnonzero((acc.time > first) & (acc.time < last))
    known = known[:: 1 + len(known) // _COMPARED]
    if len(known) < 50:
        return None
    grid = acc.time[known]
    force_w = acc.values[known] + _UP
    level = np.array([1.0, 1.0, 0.0])
    plain = 0.0
    mirrored = 0.0
    size = 0.0
    turned = 0.0j
    best: tuple[Samples, Samples] | None = None
    for late in np.arange(-reach, reach + 0.5 * _DELAY_WARN, _DELAY_WARN):
        expected = level * rotate_back(attitude.attitudes(grid + late), force_w)
        measured = level * force_b.mean_over(grid + late, 2.0 * _SPAN)
        kept, flipped = _level_correlations(expected, measured)
        plain = max(plain, kept.real)
        if max(abs(kept), abs(flipped)) > max(abs(turned), mirrored):
            turned = kept
            mirrored = abs(flipped)
            size = _spread(measured) / _spread(expected)
            best = Samples(grid, expected), Samples(grid, measured)
    if best is None:
        return None
    return _LevelForces(plain, turned, mirrored, size, relations.relate(*best, reach=DELAY_BAD))


def _report_turned_body(
    acc: Samples, attitude: Samples, force_b: Samples, channels: str
) -> Row | None:
    """Return a row if an accelerometer's x and y fit better exchanged or turned about z, else None.

    They measure only drag and cable forces; z, which measures the thrust, is left out."""
    forces = _compare_level(acc, attitude, force_b)
    if forces is None or forces.relation is None:
        return None
    relation = forces.relation
    plain = forces.plain
    correlation = forces.correlation
    samples = np.ptp(acc.time) / relations.INDEPENDENT
    nats = 0.5 * samples * np.log((1.0 - plain**2) / (1.0 - correlation**2))
    nats -= np.log(len(EXCHANGES))  # penalty for a free angle, as for an exchange
    surely = nats > _NATS and correlation > max(_CORRELATED, plain + CLEARLY)
    keeps_size = _FORCES[0] < forces.size < _FORCES[1]  # as any mount does
    if not (surely and keeps_size):
        return None
    angle = np.degrees(np.angle(forces.turned))
    off_quarter = abs(angle - 90.0 * round(angle / 90.0))
    is_quarter = off_quarter < 0.5 * TURNED < abs(angle)
    is_mirror_image = forces.mirrored > abs(forces.turned)
    # exchanged axes do not correlate without the exchange
    if plain < BELONGS and (is_mirror_image or is_quarter):
        figures = {"axes": relation.axes, "of": "acc_b", "nats": relation.nats}
        return Row("frames", channels, "bad", f"acc_b fits as {_better(relation)}", figures)
    if is_mirror_image or abs(angle) < TURNED:
        return None
    # only a warning: with an estimated attitude that leans, a circle looks turned too
    text = (
        f"acc_b fits turned by {angle:+.0f} deg about z, {nats:.0f} nats better (correlation"
        f" {correlation:.2f}, not {plain:.2f}): its mount, or axes of the attitude"
    )
    return Row("frames", channels, "warn", text, {"turned_deg": angle, "of": "acc_b", "nats": nats})


def _level_correlations(first: np.ndarray, second: np.ndarray) -> tuple[complex, complex]:
    """Return the complex correlations of vectors, shape (N, 3), in x and y; their arguments are the
    angles of the second relative to the first, and relative to the first's mirror image.
    """
    a, b = (v[:, 0] + 1j * v[:, 1] for v in (first, second))
    a = a - np.mean(a)
    b = b - np.mean(b)
    power = max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300)
    return complex(np.vdot(a, b) / power), complex(np.vdot(np.conj(a), b) / power)


def accelerations(path: Samples, unit: str, span: float = _SPAN) -> Samples:
    """Return accelerations [m/s^2] of positions (unit "m") or velocities, by differences over about
    ``span`` seconds.
    """
    velocities = path.derivative(span) if unit == "m" else path
    return velocities.derivative(span)


def _check_push(
    relation: relations.Relation, acc: np.ndarray, pushed: np.ndarray, channels: str, sensed: bool
) -> Iterator[Row]:
    """Report scale and delay of a force whose axes are those of the change of velocity."""
    off = np.mean(pushed - acc, axis=0)
    figures = {
        "correlation": relation.correlation,
        "delay_s": relation.delay,
        "scale": relation.scale,
        "offset_m_s2": off.tolist(),
    }
    if relation.correlation < FIRMLY:
        if sensed:  # otherwise forces of a payload or the air are missing
            strong = relation.correlation < BELONGS and _spread(acc) > 1.0
            text = (
                f"hardly go together (correlation {relation.correlation:.2f}):"
                " attitude or accelerometer of another flight, or noise"
            )
            yield Row("frames", channels, "bad" if strong else "warn", text, figures)
        return
    yield from _together_rows(relation, channels, figures, _FORCES)
    if sensed:
        yield _report_delay(relation, channels, figures, False)
        if np.linalg.norm(off) > _OFFSET:
            text = (
                f"the second is off by ({', '.join(f'{x:+.2f}' for x in off)}) m/s^2 in the mean:"
                " bias, or a tilted mount"
            )
            yield Row("frames", channels, "warn", text, figures)


def _report_exchange(relation: relations.Relation, channels: str) -> Row | None:
    """Report a path that correlates with the force in other axes; None if it does not."""
    firm = relation.axes_correlation > _CORRELATED and relation.nats > _SHARED * _NATS
    if not firm or not _is_turned(relation):
        return None
    text = f"fit with {_better(relation, ' of positions and velocities')}"
    figures = {"axes": relation.axes, "of": "path", "nats": relation.nats}
    return Row("frames", channels, "bad", text, figures)


def _still_gravity(log: FlightLog) -> Iterator[Row]:
    """Check the median magnitude of the specific force of a log without attitude."""
    force_b = log.samples("acc_b", 20)
    if force_b is None or any(f"{prefix}quat_wb" in log for prefix in _PREFIXES):
        return
    size = np.median(np.linalg.norm(force_b.values, axis=1))
    figures = {"median_m_s2": size, "mean_b_m_s2": np.mean(force_b.values, axis=0).tolist()}
    if 0.7 < size / GRAVITY < 1.4:
        yield Row("units", "acc_b", "ok", f"median force {size:.3f} m/s^2", figures)
    else:
        hint = relations.unit_hint(size / GRAVITY) or "gravity is missing or the unit is wrong"
        text = f"median force {size:.4g} m/s^2, not {GRAVITY}: {hint}"
        yield Row("units", "acc_b", "bad", text, figures)


def _commands(log: FlightLog) -> Iterator[Row]:
    """Check that measured rates, or those of the measured attitude, follow the commands."""
    if "rate_b" in log:
        turning = "rate_b"
        rates = log["rate_b"].samples()
    elif "quat_wb" in log:
        turning = "rate of quat_wb"
        rates = log["quat_wb"].samples().rates()
    else:
        return
    if not is_usable(rates, MOVES):
        return
    spread = np.max(np.std(rates.values, axis=0))
    for name in ("command", "rate_setpoint_b"):
        if name not in log:
            continue
        time, values = log[name].samples()
        set_points = Samples(time, values[:, -3:])  # the first component of a command is thrust
        relation = relations.relate(set_points, rates) if is_usable(set_points, MOVES) else None
        if relation is not None:
            channels = f"{name}, {turning}"
            early = _report_early_rates(relation, set_points, rates, channels)
            period = max(np.median(np.diff(clock)) for clock in (time, rates.time))
            yield early or _check_following(relation, channels, spread, period)


def _report_early_rates(
    relation: relations.Relation, set_points: Samples, rates: Samples, channels: str
) -> Row | None:
    """Report rates that precede their commands, if no delay that a controller can have fits as
    well: the clock of the commands is late. A swing that a controller opposes would fit early and
    late rates alike.
    """
    if relation.axes_delay > -DELAY_BAD or relation.axes_correlation < FIRMLY:
        return None
    time = set_points.time
    moved = set_points._replace(time=time + _RESPONSE)
    later = relations.relate(moved, rates, reach=_RESPONSE)
    if later is None:
        return None
    before = min(relation.axes_correlation, 0.999)
    after = min(max(later.axes_correlation, relation.correlation * (relation.delay > 0.0)), 0.999)
    independent = np.ptp(time) / relations.INDEPENDENT
    nats = 0.5 * independent * np.log((1.0 - after**2) / (1.0 - before**2))
    if nats < _NATS or before < after + CLEARLY:
        return None
    early = -1e3 * relation.axes_delay
    text = f"the rates go {early:.0f} ms or more before their commands, correlation {before:.2f}"
    text += f" (behind them {after:.2f}, {nats:.0f} nats): the commands' clock is late"
    figures = {"delay_s": relation.axes_delay, "nats": float(nats)}
    return Row("delay", channels, "bad", text, figures)


def _check_following(
    relation: relations.Relation, channels: str, spread: float, period: float
) -> Row:
    """Report how rates follow their commands.

    Args:
        relation: Of the rates to the commands.
        channels: Both names.
        spread: Largest deviation of the rates [rad/s].
        period: Longer sampling period of both [s].
    """
    figures = _figures(relation)
    if _disagrees(relation) and period > 0.5 * _RESPONSE:
        text = f"come every {1e3 * period:.0f} ms: too seldom to be held against each other"
        return Row("frames", channels, "warn", text, figures)
    if _disagrees(relation):
        text = (
            "the rates do not follow the commands"
            f" (best correlation {relation.axes_correlation:.2f}): not the same flight?"
        )
        return Row("frames", channels, "bad" if spread > _LIVELY else "warn", text, figures)
    if _is_turned(relation):
        return _report_other_axes(relation, channels, "the rates follow the commands")
    is_measured = relation.delay_sd < _UNTOLD
    early = is_measured and relation.delay < -0.005
    slow = is_measured and relation.delay - 2.0 * relation.delay_sd > LATEST
    hint = relations.unit_hint(relation.scale)
    hint = hint if "degrees" in hint else ""  # any other ratio may be a gain
    weak = relation.correlation < FIRMLY
    verdict = "bad" if hint else "warn" if early or slow or weak else "ok"
    when = f"{1e3 * relation.delay:.1f} ms later" if is_measured else "at an unknown delay"
    text = (
        f"the rates follow {when}, correlation {relation.correlation:.2f}, gain"
        f" {relation.scale:.2f}"
    )
    if early:
        text += ": before they were commanded"
    elif slow:
        text += f", more than {1e3 * LATEST:.0f} ms: is the commands' clock early?"
    elif hint:
        text += f": {hint}"
    elif weak:
        text += ": weakly"
    return Row("delay", channels, verdict, text, figures)


def hangs(log: FlightLog, time: np.ndarray) -> np.ndarray:
    """Return whether the payload hangs at each time [s]: by the channel ``attached``, or until the
    first release command; always true without both channels.
    """
    if "attached" in log:
        return log["attached"].hold(time) > 0.5
    if "release_command" not in log:
        return np.ones(len(time), bool)
    stamps, pressed = log["release_command"].samples()
    return time < np.min(stamps[pressed[:, 0] > 0.5], initial=np.inf)


def _cable(log: FlightLog, vehicle: KnownVehicle) -> Iterator[Row]:
    place = log.samples("pos_w", 20)
    payload = log.samples("payload_pos_w", 20)
    if place is None or payload is None:
        return
    time = payload.time
    overlap = (time > place.time[0]) & (time < place.time[-1])
    if "attached" in log:
        overlap &= log["attached"].hold(time).astype(bool)
    payload = Samples(time[overlap], payload.values[overlap])
    gap = payload.values - place.at(payload.time)
    channels = "pos_w, payload_pos_w"
    if len(gap) < 20:
        text = "vehicle and payload were never measured at one time"
        yield Row("frames", channels, "bad", text)
        return
    hanging = hangs(log, payload.time)
    rope = gap[hanging]
    if len(rope) < 20:
        return
    length = np.linalg.norm(rope, axis=1)
    middle = np.median(length)
    low, high = np.percentile(length, [10, 90])
    spread = high - low
    above = np.mean(rope[:, 2] > 0.5 * middle)
    figures = {"median_m": middle, "p10_to_p90_m": spread, "payload_above_share": above}
    text = f"{middle:.4f} m apart (10 to 90 %: {1e3 * spread:.1f} mm)"
    if above > 0.5:
        text += ", the payload above: bodies exchanged, or z down"
        yield Row("frames", channels, "bad", text, figures)
        return
    if not 0.02 < middle < 20.0:
        text += ": no cable; millimetres taken for metres, or metres for millimetres?"
        yield Row("units", channels, "bad", text, figures)
        return
    yield Row("frames", channels, "warn" if spread > 0.1 * middle else "ok", text, figures)
    if vehicle.cable_length:
        yield _length(middle, vehicle.cable_length, channels)
    yield from _check_early_release(log, payload.time, gap)
    hung = Samples(payload.time[hanging], payload.values[hanging])
    yield from _report_payload_delay(place, hung, channels)


def _check_early_release(log: FlightLog, time: np.ndarray, gap: np.ndarray) -> Iterator[Row]:
    """Report a payload that leaves the cable before its release is commanded."""
    if "release_command" not in log:
        return
    stamps, pressed = log["release_command"].samples()
    commanded = np.flatnonzero(pressed.ravel() > 0.0)
    if not len(commanded):
        return
    length = np.linalg.norm(gap, axis=1)
    hangs = (gap[:, 2] < -0.5 * length) & (
        time < stamps[commanded[0]]
    )  # not next to the vehicle on the floor
    if not np.any(hangs):
        return
    taut = np.flatnonzero(length < (1.0 + _TAUT) * np.median(length[hangs]))
    if taut[-1] == len(time) - 1:
        return
    since = stamps[max(commanded[0] - 1, 0)]  # the command is later than this sample
    early = since - time[taut[-1] + 1]
    if early < DELAY_BAD:
        return
    text = f"the payload leaves {1e3 * early:.0f} ms before its release is commanded: "
    text += "the commands' clock is late, or it fell off"
    channels = "release_command, payload_pos_w"
    yield Row("delay", channels, "bad", text, {"delay_s": -early})


def _length(middle: float, expected: float, channels: str) -> Row:
    """Compare the measured cable with the model's."""
    off = middle / expected - 1.0
    figures = {"median_m": middle, "model_m": expected}
    text = f"apart by {100 * off:+.1f} % of the model's cable of {expected:g} m"
    verdict = "bad" if abs(off) > _OTHER_CABLE else "warn" if abs(off) > _LONGER else "ok"
    text += ": another cable, or another body" if verdict == "bad" else ""
    return Row("cable", channels, verdict, text, figures)


def _report_payload_delay(place: Samples, payload: Samples, channels: str) -> Iterator[Row]:
    """Report the delay of the payload's stream, at which the cable's length varies least."""
    delays = np.arange(-0.2, 0.2001, 0.01)
    overlap = (payload.time > place.time[0] + 0.2) & (payload.time < place.time[-1] - 0.2)
    if np.sum(overlap) < 50:
        return
    time, pos = (array[overlap] for array in payload)
    gaps = pos - place.at(time - delays[:, None])
    spread = np.std(np.linalg.norm(gaps, axis=2), axis=1)
    best = int(np.argmin(spread))
    delay = delays[best]
    independent = max(np.ptp(time) / relations.INDEPENDENT, 10.0)
    floor = 1e-9  # smallest spread of a cable's length without noise [m]
    plain, least = np.maximum(spread[[len(delays) // 2, best]], floor)
    nats = independent * np.log(plain / least)
    if nats < _NATS or best in (0, len(delays) - 1) or abs(delay) < _DELAY_WARN:
        return
    text = (
        f"the payload is {1e3 * delay:+.0f} ms behind the vehicle: the cable's length then"
        f" varies by {1e3 * least:.1f} mm, not {1e3 * plain:.1f} ({nats:.0f} nats)"
    )
    verdict = "bad" if abs(delay) > DELAY_BAD else "warn"
    yield Row("delay", channels, verdict, text, {"delay_s": delay, "nats": nats})


def _check_same_quantity(log: FlightLog) -> Iterator[Row]:
    """Compare measurements of one quantity on different clocks: delay, and drift of the delay."""
    bad = False
    for first, second in (("pos_w", "est_pos_w"), ("pos_w", "mocap_pos_w"), ("vel_w", "est_vel_w")):
        a = log.samples(first)
        b = log.samples(second)
        if not (is_usable(a, MOVES) and is_usable(b, MOVES)):
            continue
        rows = list(_compare(a, b, f"{first}, {second}"))
        yield from rows
        bad = bad or worst(rows) == "bad"
        if not bad:
            yield from _drift(a, b, f"{first}, {second}")


def _cut(samples: Samples, start: float, end: float) -> Samples:
    rows = (samples.time >= start) & (samples.time < end)
    return Samples(samples.time[rows], samples.values[rows])


def _drift(first: Samples, second: Samples, channels: str) -> Iterator[Row]:
    """Report a delay that differs between parts of 5 s."""
    starts = []
    delays = []
    piece = 5.0
    for start in np.arange(first.time[0], first.time[-1] - piece, piece):
        a = _cut(first, start, start + piece)
        b = _cut(second, start - 1.0, start + piece + 1.0)
        if not is_usable(a, MOVES) or len(b.time) < 50:
            continue
        relation = relations.relate(a, b)
        if relation is not None and relation.correlation > 0.8 and relation.delay_sd < DELAY_KNOWN:
            starts.append(start)
            delays.append(relation.delay)
    if len(delays) < 3:
        return
    figures = {"delays_s": delays, "from_s": starts}
    text = (
        f"the delay runs from {1e3 * min(delays):+.1f} to {1e3 * max(delays):+.1f} ms over"
        f" {len(delays)} pieces of {piece:.0f} s"
    )
    yield Row("delay", channels, "warn" if np.ptp(delays) > 0.01 else "ok", text, figures)
