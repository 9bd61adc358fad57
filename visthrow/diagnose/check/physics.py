"""Checks of units, frames and delays by physics: what must follow from what, whatever the vehicle."""

from collections.abc import Iterator

import numpy as np

from sim.reference.rotations import rotation_from_quat, turned
from visthrow.diagnose.check import relations
from visthrow.diagnose.check.rows import Row
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.onboard.hover import GRAVITY

MOVES = 0.05
"""Below this speed [m/s], rate [rad/s] or acceleration / 10 [m/s^2] a channel does not move enough to be compared."""

_PREFIXES = ("", "est_", "mocap_", "payload_")
_FASTEST, _FARTHEST = 60.0, 2000.0  # of vehicles that throw [m/s], [m]
_SHARES = ("motor_command", "motor_wanted", "throttle")
_LARGEST_SHARE = 2.0  # of a command whose full size is 1; what a controller asks for may exceed it, a wrong unit by far more
_VOLTS = (0.5, 100.0)  # of any pack of such a vehicle [V]
_BELONGS, _FIRMLY, _CLEARLY = 0.35, 0.7, 0.12
_LIVELY = 0.2  # rates that noise and draught alone do not make [rad/s]
_DELAY_WARN, _DELAY_KNOWN = 0.02, 0.003  # [s]


def _valid(channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    values = channel.values.astype(float)
    return channel.time[channel.valid], values[channel.valid].reshape(int(np.sum(channel.valid)), int(np.prod(values.shape[1:])))


def look(log: FlightLog) -> list[Row]:
    """All checks that compare channels of one log."""
    rows = list(_plausible(log))
    for prefix in _PREFIXES:
        pos, vel, quat = f"{prefix}pos_w", f"{prefix}vel_w", f"{prefix}quat_wb"
        if pos in log and vel in log:
            rows += _velocity(log, pos, vel)
        if quat in log:
            rows += _rates(log, quat)
            rows += _gravity(log, quat, pos)
    rows += _still_gravity(log)
    rows += _commands(log)
    rows += _motors(log)
    rows += _cable(log)
    rows += _same(log)
    return rows


def _usable(time: np.ndarray, values: np.ndarray, least: float) -> bool:
    return len(time) > 50 and bool(np.max(np.std(values, axis=0)) > least)


def _plausible(log: FlightLog) -> Iterator[Row]:
    for name, channel in log.channels.items():
        if channel.unit != "m" or channel.values.shape[1:] != (3,) or np.sum(channel.valid) < 50 or "setpoint" in name:
            continue
        time, pos = _valid(channel)
        speeds = np.linalg.norm(relations.derivative(time, pos, 0.1)[1], axis=1)
        if not len(speeds):
            continue
        fast, far = float(np.percentile(speeds, 99)), float(np.max(np.abs(pos)))
        figures = {"speed_p99_m_s": fast, "farthest_m": far}
        if fast > _FASTEST or far > _FARTHEST:
            text = f"{fast:.3g} m/s and {far:.3g} m from the origin: no such vehicle; millimetres taken for metres?"
            yield Row("units", name, "bad", text, figures)
    yield from _implausible_sizes(log)


def _implausible_sizes(log: FlightLog) -> Iterator[Row]:
    """Commands and voltages of a size that only another unit gives them."""
    for name in _SHARES:
        if name in log and log[name].unit == "1" and np.any(log[name].valid):
            high = float(np.percentile(np.abs(_valid(log[name])[1]), 95))
            if high > _LARGEST_SHARE:
                text = f"95 % of the values reach {high:.3g}: no shares of the full command"
                yield Row("units", name, "bad", text, {"p95": high})
    for name in ("battery_voltage", "supply_voltage"):
        if name in log and np.any(log[name].valid):
            middle = float(np.median(_valid(log[name])[1]))
            if middle > _VOLTS[1] or 0.0 < middle < _VOLTS[0]:
                yield Row("units", name, "bad", f"{middle:.3g} V: no such pack; another unit?", {"median_v": middle})


def _velocity(log: FlightLog, pos: str, vel: str) -> list[Row]:
    (time_p, p), (time_v, v) = _valid(log[pos]), _valid(log[vel])
    if not (_usable(time_p, p, 0.02) and _usable(time_v, v, 0.0)):
        return []
    time_d, derived = relations.derivative(time_p, p)
    return _compared(relations.relate(time_d, derived, time_v, v), f"d({pos})/dt", vel)


def _rates(log: FlightLog, quat: str) -> list[Row]:
    if "rate_b" not in log:
        return []
    (time_q, q), (time_w, w) = _valid(log[quat]), _valid(log["rate_b"])
    if len(time_q) < 50 or len(time_w) < 50:
        return []
    time_d, derived = relations.rates_of(time_q, q)
    if not (_usable(time_d, derived, MOVES) and _usable(time_w, w, 0.0)):
        return []
    return _compared(relations.relate(time_d, derived, time_w, w), f"rate of {quat}", "rate_b")


def _compared(found: relations.Relation | None, first: str, second: str) -> list[Row]:
    """Rows about a pair that should be one and the same motion."""
    if found is None:
        return []
    both = f"{first}, {second}"
    figures = {"correlation": found.correlation, "delay_s": found.delay, "delay_sd_s": found.delay_sd, "scale": found.scale}
    if _apart(found):
        text = f"hardly go together in any axes (correlation {found.axes_correlation:.2f}): not the same flight, or noise"
        return [Row("frames", both, "bad", text, figures)]
    if found.axes_correlation > found.correlation + _CLEARLY:
        kind = "a mirror image" if found.mirror else "turned axes"
        text = f"go together as ({found.axes}), correlation {found.axes_correlation:.2f} against {found.correlation:.2f}: {kind}"
        return [Row("frames", both, "bad", text, figures | {"axes": found.axes})]
    rows = [Row("frames", both, "ok", f"go together as they are, correlation {found.correlation:.2f}", figures)]
    if not 0.67 < found.scale < 1.5:
        hint = relations.unit_hint(found.scale) or "no unit explains it"
        weak = abs(found.correlation) < 0.7 and 0.4 < found.scale < 1.5
        text = f"the second is {found.scale:.4g} times the first: {'noise dilutes it' if weak else hint}"
        rows.append(Row("units", both, "warn" if weak else "bad", text, figures))
    verdict = "warn" if abs(found.delay) > _DELAY_WARN else "ok"
    text = f"the second is {1e3 * found.delay:+.1f} ms behind the first (sd {1e3 * found.delay_sd:.1f} ms)"
    rows.append(Row("delay", both, verdict, text, figures))
    return rows


def _apart(found: relations.Relation) -> bool:
    """Whether two signals hardly go together, in whatever axes; the best of 48 exchanges reaches 0.5 by chance."""
    return found.axes_correlation < _BELONGS or (found.correlation < _BELONGS and found.axes_correlation < _FIRMLY)


def _gravity(log: FlightLog, quat: str, pos: str) -> list[Row]:
    """The mean force on the body, turned to the world, must hold the vehicle up."""
    if "acc_b" not in log:
        return []
    (time_q, q), (time_a, acc) = _valid(log[quat]), _valid(log["acc_b"])
    if len(time_q) < 50 or len(time_a) < 50:
        return []
    at = np.interp(time_q, time_a, np.arange(len(time_a)))
    mean_w = np.mean(turned(rotation_from_quat(q), acc[np.round(at).astype(int)]), axis=0)
    extra = np.zeros(3)
    if pos in log and len(log[pos].time) > 50:
        time_p, p = _valid(log[pos])
        _, v = relations.derivative(time_p, p)
        extra = (v[-1] - v[0]) / float(np.ptp(time_p)) if len(v) else extra
    mean_w = mean_w - extra
    size = float(np.linalg.norm(mean_w))
    tilt = float(np.degrees(np.arccos(np.clip(mean_w[2] / max(size, 1e-9), -1.0, 1.0))))
    figures = {"mean_m_s2": mean_w.tolist(), "tilt_deg": tilt}
    both = f"acc_b, {quat}"
    hint = relations.unit_hint(size / GRAVITY)
    if not 0.85 < size / GRAVITY < 1.15:
        text = f"the mean force is {size:.4g} m/s^2, not {GRAVITY}: {hint or 'axes are exchanged, or gravity is missing'}"
        return [Row("units" if hint else "frames", both, "bad", text, figures)]
    if tilt > 30.0:
        text = f"the mean force points {tilt:.0f} deg off up: turned or mirrored axes"
        return [Row("frames", both, "bad", text, figures)]
    verdict = "warn" if tilt > 3.0 or abs(size / GRAVITY - 1.0) > 0.03 else "ok"
    return [Row("frames", both, verdict, f"the mean force is {size:.3f} m/s^2 and {tilt:.2f} deg off up", figures)]


def _still_gravity(log: FlightLog) -> list[Row]:
    """Without an attitude: the size of the force, in its median."""
    if "acc_b" not in log or any(f"{prefix}quat_wb" in log for prefix in _PREFIXES):
        return []
    _, acc = _valid(log["acc_b"])
    if len(acc) < 20:
        return []
    size = float(np.median(np.linalg.norm(acc, axis=1)))
    figures = {"median_m_s2": size, "mean_b_m_s2": np.mean(acc, axis=0).tolist()}
    if not 0.7 < size / GRAVITY < 1.4:
        hint = relations.unit_hint(size / GRAVITY) or "gravity is missing or the unit is wrong"
        return [Row("units", "acc_b", "bad", f"median force {size:.4g} m/s^2, not {GRAVITY}: {hint}", figures)]
    return [Row("units", "acc_b", "ok", f"median force {size:.3f} m/s^2", figures)]


def _body_rates(log: FlightLog) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Measured rates, or those of the measured attitude."""
    if "rate_b" in log:
        return ("rate_b", *_valid(log["rate_b"]))
    if "quat_wb" in log and len(_valid(log["quat_wb"])[0]) > 50:
        return ("rate of quat_wb", *relations.rates_of(*_valid(log["quat_wb"])))
    return None


def _commands(log: FlightLog) -> list[Row]:
    rows: list[Row] = []
    pairs = []
    rates = _body_rates(log)
    if rates is None:
        return rows
    turning, time_w, rate = rates
    if "command" in log:
        time, command = _valid(log["command"])
        pairs.append(("command", time, command[:, 1:]))
    if "rate_setpoint_b" in log:
        pairs.append(("rate_setpoint_b", *_valid(log["rate_setpoint_b"])))
    for name, time, wanted in pairs:
        if not (_usable(time, wanted, MOVES) and _usable(time_w, rate, MOVES)):
            continue
        found = relations.relate(time, wanted, time_w, rate)
        if found is None:
            continue
        rows += _followed(found, f"{name}, {turning}", float(np.max(np.std(rate, axis=0))))
    if "command" in log and "acc_b" in log:
        rows += _thrust(log)
    return rows


def _followed(found: relations.Relation, both: str, spread: float) -> list[Row]:
    figures = {"correlation": found.correlation, "delay_s": found.delay, "delay_sd_s": found.delay_sd, "scale": found.scale}
    if _apart(found):
        text = f"the rates do not follow the commands (best correlation {found.axes_correlation:.2f}): not the same flight?"
        return [Row("frames", both, "bad" if spread > _LIVELY else "warn", text, figures)]
    if found.axes_correlation > found.correlation + _CLEARLY:
        text = f"the rates follow the commands as ({found.axes}): "
        text += f"correlation {found.axes_correlation:.2f}, not {found.correlation:.2f}"
        return [Row("frames", both, "bad", text, figures | {"axes": found.axes})]
    late = found.delay < -0.005
    hint = relations.unit_hint(found.scale)
    weak = found.correlation < _FIRMLY
    verdict = "bad" if hint else "warn" if late or weak else "ok"
    text = f"the rates follow {1e3 * found.delay:.1f} ms later, correlation {found.correlation:.2f}, gain {found.scale:.2f}"
    text += ": before they were commanded" if late else f": {hint}" if hint else ": weakly" if weak else ""
    return [Row("delay", both, verdict, text, figures)]


def _thrust(log: FlightLog) -> list[Row]:
    (time_c, command), (time_a, acc) = _valid(log["command"]), _valid(log["acc_b"])
    if not (_usable(time_c, command[:, :1], 1e-3) and _usable(time_a, acc[:, 2:], 0.3)):
        return []
    found = relations.relate(time_c, command[:, :1], time_a, acc[:, 2:3])
    if found is None:
        return []
    mass = float(np.median(command[:, 0]) / max(np.median(acc[:, 2]), 1e-6))
    figures = {"correlation": found.correlation, "delay_s": found.delay, "mass_kg": mass}
    good = found.correlation > _BELONGS and mass > 0.0
    text = f"the force follows {1e3 * found.delay:.1f} ms later, correlation {found.correlation:.2f}; "
    text += f"thrust over force {mass:.4g} kg"
    return [Row("delay", "command, acc_b", "ok" if good else "warn", text, figures)]


def _motors(log: FlightLog) -> list[Row]:
    """Which way the vehicle turns when motors differ: order of the motors, and sign."""
    name = next((n for n in ("motor_speed", "motor_command", "pwm") if n in log), None)
    if name is None or "rate_b" not in log or log[name].values.shape[1:] != (4,):
        return []
    (time_m, motors), (time_w, rate) = _valid(log[name]), _valid(log["rate_b"])
    if not _usable(time_w, rate, MOVES) or len(time_m) < 50:
        return []
    time_d, turning = relations.derivative(time_w, rate, 0.03)
    front_left, front_right, rear_left, rear_right = motors.T
    torque = np.column_stack(
        [front_left + rear_left - front_right - rear_right, rear_left + rear_right - front_left - front_right]
    )
    if len(time_d) < 50 or np.max(np.std(torque, axis=0)) <= 0.0:
        return []
    rows = []
    for axis, word in enumerate(("roll", "pitch")):
        found = relations.relate(time_m, torque[:, axis : axis + 1], time_d, turning[:, axis : axis + 1], 0.2)
        if found is None or found.axes_correlation < 0.2:
            continue
        both, figures = f"{name}, rate_b", {"correlation": found.correlation, "delay_s": found.delay}
        wrong = found.axes.startswith("-") and found.axes_correlation > found.correlation + _CLEARLY
        text = f"{word} turns {'against' if wrong else 'with'} the motors, {1e3 * found.delay:.1f} ms later"
        text += f", correlation {found.axes_correlation if wrong else found.correlation:.2f}"
        text += ": order of the motors, or a sign" if wrong else ""
        rows.append(Row("frames", both, "bad" if wrong else "ok", text, figures))
    return rows


def _cable(log: FlightLog) -> list[Row]:
    if "pos_w" not in log or "payload_pos_w" not in log:
        return []
    (time_q, q), (time_p, p) = _valid(log["pos_w"]), _valid(log["payload_pos_w"])
    if len(time_q) < 20 or len(time_p) < 20:
        return []
    inside = (time_p > time_q[0]) & (time_p < time_q[-1])
    if "attached" in log:
        inside &= log["attached"].hold(time_p).astype(bool)
    gap = p[inside] - relations.on_grid(time_q, q, time_p[inside])
    length = np.linalg.norm(gap, axis=1)
    if len(length) < 20:
        return [Row("frames", "pos_w, payload_pos_w", "bad", "vehicle and payload were never measured at one time")]
    middle, spread = float(np.median(length)), float(np.percentile(length, 90) - np.percentile(length, 10))
    above = float(np.mean(gap[:, 2] > 0.5 * middle))
    figures = {"median_m": middle, "p10_to_p90_m": spread, "payload_above_share": above}
    text = f"{middle:.4f} m apart (10 to 90 %: {1e3 * spread:.1f} mm)"
    if above > 0.5:
        return [Row("frames", "pos_w, payload_pos_w", "bad", text + ", the payload above: bodies exchanged, or z down", figures)]
    if not 0.02 < middle < 20.0:
        return [Row("units", "pos_w, payload_pos_w", "bad", text + ": no cable", figures)]
    return [Row("frames", "pos_w, payload_pos_w", "warn" if spread > 0.1 * middle else "ok", text, figures)]


def _same(log: FlightLog) -> list[Row]:
    """Two measurements of one quantity on different clocks: the delay between them, and whether it holds."""
    rows: list[Row] = []
    for first, second in (("pos_w", "est_pos_w"), ("pos_w", "mocap_pos_w"), ("vel_w", "est_vel_w")):
        if first not in log or second not in log:
            continue
        (time_a, a), (time_b, b) = _valid(log[first]), _valid(log[second])
        if not (_usable(time_a, a, MOVES) and _usable(time_b, b, MOVES)):
            continue
        rows += _compared(relations.relate(time_a, a, time_b, b), first, second)
        if "bad" not in {row.verdict for row in rows}:
            rows += _drift(time_a, a, time_b, b, f"{first}, {second}")
    return rows


def _drift(time_a: np.ndarray, a: np.ndarray, time_b: np.ndarray, b: np.ndarray, both: str, piece: float = 5.0) -> list[Row]:
    delays = []
    for start in np.arange(time_a[0], time_a[-1] - piece, piece):
        near_a = (time_a >= start) & (time_a < start + piece)
        near_b = (time_b >= start - 1.0) & (time_b < start + piece + 1.0)
        if np.sum(near_a) < 50 or np.sum(near_b) < 50 or np.max(np.std(a[near_a], axis=0)) < MOVES:
            continue
        found = relations.relate(time_a[near_a], a[near_a], time_b[near_b], b[near_b])
        if found is not None and found.correlation > 0.8 and found.delay_sd < _DELAY_KNOWN:
            delays.append((start, found.delay))
    if len(delays) < 3:
        return []
    late = np.array([delay for _, delay in delays])
    spread = float(np.ptp(late))
    figures = {"delays_s": late.tolist(), "from_s": [float(start) for start, _ in delays]}
    text = f"the delay runs from {1e3 * np.min(late):+.1f} to {1e3 * np.max(late):+.1f} ms over {len(late)} pieces of {piece:.0f} s"
    return [Row("delay", both, "warn" if spread > 0.01 else "ok", text, figures)]
