"""Checks of several logs, with their verdicts and the table for the user."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from visthrow.logs.check import excitation, physics, relations, signals, thrust_checks
from visthrow.logs.check.rows import NOTHING, KnownVehicle, Row, Verdict, worst
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.readers.vehicles import Vehicle

_ALIKE = 0.2  # share of common samples above which two logs are copies
_ONE_PAYLOAD = 0.005  # largest difference of the paths of the same payload in two logs [m]
_MOST_PAIRED = 12
# difference of the logarithm of thrust over force that a battery's charge alone does not cause
_OTHER_SCALE = 0.08
_MOVING = ("pos", "rate", "acc", "quat", "vel", "angle", "thrust", "motor")


@dataclass(frozen=True)
class Checked:
    """The rows of one log."""

    name: str
    rows: tuple[Row, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the rows, without those on questions that cannot be answered."""
        return worst([row for row in self.rows if row.topic != "answers"])


def check(logs: Sequence[FlightLog], vehicle: KnownVehicle = NOTHING) -> list[Checked]:
    """Check logs one by one, and check their common samples, payloads and masses."""
    common = [*_copies(logs), *_compare_shared_payloads(logs), *_masses(logs, vehicle)]
    checked = []
    for i, log in enumerate(logs):
        shared = [row for number, row in common if number == i]
        checked.append(Checked(label(log, i), (*_look(log, vehicle), *shared)))
    return checked


CONTRADICT = ("vehicle", "frames", "units", "delay", "thrust", "excited")
"""Topics whose bad rows exclude a log from the diagnosis: its channels are not of one flight and
clock.
"""


def contradictions(results: Sequence[Checked], unread: frozenset[str] = frozenset()) -> list[str]:
    """Return the reasons not to diagnose logs: their channels contradict each other, or nothing
    moved.

    ``unread``: channels that the model does not read, and names of overruled rows (topic and
    channel). Bad rows on one of them are no reason."""
    reasons = []
    for checked in results:
        ignored = unread - _find_agreeing(checked, unread)
        for row in checked.rows:
            refuses = row.topic in CONTRADICT or "never overlap" in row.text
            about = {row.name, *re.findall(r"\w+", row.channel)}
            if row.verdict == "bad" and refuses and ignored.isdisjoint(about):
                reasons.append(f"{checked.name}: {row.name}: {row.text}")
    return reasons


def _find_agreeing(checked: Checked, unread: frozenset[str]) -> set[str]:
    """Return the velocities that agree with a position that the model reads. A contradiction to
    such a velocity also contradicts the position.
    """
    bad = {row.channel for row in checked.rows if row.verdict == "bad"}
    velocities = set()
    for channel in {row.channel for row in checked.rows} - bad:
        pair = re.fullmatch(r"d\((\w+)\)/dt, (\w+)", channel)
        if pair and pair[1] not in unread:
            velocities.add(pair[2])
    return velocities


def copies(results: Sequence[Checked]) -> dict[int, int]:
    """Return the copies among logs: number of the log -> number of the earlier log with the same
    samples.
    """
    return {
        i: row.figures["copy_of"]
        for i, checked in enumerate(results)
        for row in checked.rows
        if row.topic == "duplicates"
    }


def label(log: FlightLog, number: int) -> str:
    """Return the name of a log for the user."""
    source = Path(str(log.meta.get("source", f"log {number + 1}"))).name
    part = log.meta.get("part")
    return f"{source}:{part}" if part else source


def _look(log: FlightLog, vehicle: KnownVehicle) -> Iterator[Row]:
    if not log.channels:
        yield Row("clock", "", "bad", "no channel at all")
        return
    log = _cut_at_landing(log)
    yield from _reader(log)
    for name, channel in log.channels.items():
        yield from signals.look(name, channel, log.notes(name))
    yield from _clocks(log)
    usable = {}
    for name, channel in log.channels.items():
        samples = channel.samples()
        if len(samples.time) < signals.FEW_SAMPLES:
            continue
        if name.endswith("quat_wb") and not np.all(np.any(samples.values, axis=1)):
            yield Row("values", name, "bad", "holds quaternions of length 0")
        else:
            usable[name] = channel
    kind = str(log.meta.get("vehicle", ""))
    if kind and not Vehicle(kind).rotors_alone:
        text = f"of a {kind}: only its channels are looked at; expected a vehicle of rotors"
        yield Row("vehicle", "", "bad", text)
        return
    whole = FlightLog(usable, log.meta)
    yield from physics.look(whole, vehicle)
    yield from thrust_checks.look(whole, vehicle)
    yield from excitation.look(whole)


def _cut_at_landing(log: FlightLog) -> FlightLog:
    """Return the log without the payload's samples after its landing."""
    if "landing" not in log or not len(log["landing"].time):
        return log
    channels = dict(log.channels)
    for name in channels.keys() & {"payload_pos_w", "payload_vel_w", "cable_points_w"}:
        channels[name] = channels[name].only(channels[name].time <= log["landing"].time[0])
    return FlightLog(channels, log.meta)


def _reader(log: FlightLog) -> Iterator[Row]:
    """Yield rows on the notes of a log's reader."""
    corrupt = log.meta.get("corrupt", 0)
    dropped = log.meta.get("dropped", 0)
    if corrupt or dropped:
        text = f"{corrupt} damaged stretches, {dropped} frames lost with them"
        yield Row("gaps", "", "warn", text, {"corrupt": corrupt, "dropped": dropped})
    if log.meta.get("complete") is False:
        yield Row("gaps", "", "warn", "ends without its end marker: cut short", {})
    if log.meta.get("damaged"):
        yield Row("gaps", "", "warn", "damaged stretches in the file", {})
    for part in log.meta.get("left_out", ()):
        yield Row("gaps", "", "warn", f"left out: {part}")
    for name in log.channels:
        notes = log.notes(name)
        if flagged := notes.get("invalid by the source"):
            text = (
                f"{100 * flagged / len(log[name].time):.0f} % of the samples are not valid by the"
                f" autopilot's own word ({notes['flagged']})"
            )
            yield Row("values", name, "warn", text, {"flagged": flagged})
        if resets := notes.get("resets"):
            text = f"the estimate was reset {resets} times: it jumps there"
            yield Row("values", name, "warn", text, {"resets": resets})


def _clocks(log: FlightLog) -> Iterator[Row]:
    clocks: dict[str, list[str]] = {}
    for name in log.channels:
        clock = str(log.notes(name).get("clock", "main"))
        clocks.setdefault(clock, []).append(name)
    if len(clocks) > 1:
        listed = "; ".join(f"{name}: {', '.join(channels)}" for name, channels in clocks.items())
        text = f"{len(clocks)} clocks: {listed}"
        yield Row("clock", "", "ok", text, {"clocks": len(clocks)})
    times = [c.time for c in log.channels.values() if len(c.time) > 1]
    if times and max(time[0] for time in times) > min(time[-1] for time in times):
        text = "channels that never overlap in time: different clocks, or different flights"
        yield Row("clock", "", "bad", text)


def _copies(logs: Sequence[FlightLog]) -> Iterator[tuple[int, Row]]:
    """Yield the number of each log that is a copy of an earlier one, and a row on it."""
    prints = [_prints(log) for log in logs]
    for i, j in combinations(range(len(logs)), 2):
        fewer = max(min(len(prints[i]), len(prints[j])), 1)
        shared = len(prints[i] & prints[j]) / fewer
        if shared > _ALIKE:
            text = (
                f"shares {100 * shared:.0f} % of its samples with {label(logs[i], i)}: a copy"
                " counts once"
            )
            yield j, Row("duplicates", "", "bad", text, {"copy_of": i, "shared": shared})


def _masses(logs: Sequence[FlightLog], vehicle: KnownVehicle) -> Iterator[tuple[int, Row]]:
    """Yield the number of each log whose ratio of thrust to force differs from the median, and a
    row on it: another battery, vehicle, payload or thrust map.
    """
    carried = [thrust_checks.mass_of(log, vehicle) for log in logs]
    known = [mass for mass in carried if mass is not None]
    middle = np.median(known) if known else 0.0
    for i, mass in enumerate(carried):
        if mass is not None and abs(np.log(mass / middle)) > _OTHER_SCALE:
            text = (
                f"thrust over force {mass:.4g} kg, {mass / middle:.3g} times that of the flights'"
                " middle: the thrust's scale differs from flight to flight"
            )
            yield i, Row("thrust", "", "warn", text, {"mass_kg": mass, "middle_kg": middle})


def _compare_shared_payloads(logs: Sequence[FlightLog]) -> Iterator[tuple[int, Row]]:
    """Compare the clocks of several vehicles that carry one payload."""
    paths = {}
    for i, log in enumerate(logs):
        path = log.samples("payload_pos_w", 101)
        if path is not None and len(paths) < _MOST_PAIRED:
            paths[i] = path
    for (first, a), (second, b) in combinations(paths.items(), 2):
        if not (physics.is_usable(a, physics.MOVES) or physics.is_usable(b, physics.MOVES)):
            continue
        # on a straight path, an offset of positions looks like a delay; velocities have no offset
        relation = relations.relate(a.derivative(), b.derivative())
        if relation is None or relation.delay_sd > physics.DELAY_KNOWN:
            continue
        late_time = a.time + relation.delay
        common = (late_time > b.time[0]) & (late_time < b.time[-1])
        difference = a.values[common] - b.at(late_time[common])
        off = np.sqrt(np.mean(difference**2)) if np.any(common) else np.inf
        if off < _ONE_PAYLOAD:
            text = f"the payload of {label(logs[first], first)} to {1e3 * off:.1f} mm, "
            text += f"this clock {1e3 * relation.delay:+.1f} ms behind"
            text += f" (sd {1e3 * relation.delay_sd:.1f} ms)"
            figures = {
                "with": first,
                "delay_s": relation.delay,
                "delay_sd_s": relation.delay_sd,
                "rms_m": off,
            }
            yield second, Row("clock", "payload_pos_w", "warn", text, figures)


def _prints(log: FlightLog) -> set[bytes]:
    """Return fingerprints of a log: short sequences of samples, without their time stamps."""
    prints: set[bytes] = set()
    for name, channel in log.channels.items():
        moving = any(word in name for word in _MOVING) and channel.values.dtype.kind != "b"
        if not moving or len(channel.values) < 8:
            continue
        rows = channel.rows
        changed = np.flatnonzero(np.any(rows[1:] != rows[:-1], axis=1))
        first = changed[:: max(1, len(changed) // 2000)]
        first = first[first + 4 <= len(rows)]
        runs = rows[first[:, None] + np.arange(4)].reshape(-1, 4 * rows.shape[1])
        ordered = np.sort(runs, axis=1)  # NaN last
        steps = (ordered[:, 1:] != ordered[:, :-1]) & ~np.isnan(ordered[:, :-1])
        prints.update(run.tobytes() for run in runs[np.sum(steps, axis=1) > 2])
    return prints


def table(checked: Checked, all_rows: bool = False) -> str:
    """Return the table of a log's rows; ``all_rows``: also those on noise, clocks and gaps without
    a fault.
    """
    marks = {"ok": "ok  ", "warn": "WARN", "bad": "BAD "}
    lines = [f"{checked.name}: {checked.verdict}"]
    visible = [
        row
        for row in checked.rows
        if all_rows or row.verdict != "ok" or row.topic not in ("noise", "clock", "gaps")
    ]
    width = max((len(row.channel) for row in visible), default=0)
    for row in visible:
        lines.append(
            f"  {marks[row.verdict]} {row.topic:<10} {row.channel:<{min(width, 34)}}  {row.text}"
        )
    return "\n".join(lines)
