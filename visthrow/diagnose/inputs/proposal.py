"""Proposal of a mapping: what the columns of a foreign table are, by their names, their values and
physics.

Names say which columns belong together and hint at what they are; values say the units (a
quaternion has length 1, a resting accelerometer 9.81 m/s^2 or 1 g); physics decides: a velocity is
the derivative of a position, rates are those of the attitude, a payload keeps its distance. What
none of them tells becomes a question."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from visthrow.common.errors import ConfigError, LogError
from visthrow.common.rotations import rotate_back
from visthrow.common.toml_text import tables_beside
from visthrow.diagnose.inputs import unit_evidence
from visthrow.logs.axes import turn_of
from visthrow.logs.check import physics, relations, thrust_checks
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.mapping import ChannelMap, TableMap, TimeColumn
from visthrow.logs.readers.table import Table, logs_of, lost_rows, make_channel
from visthrow.logs.readers.text_table import unit_of
from visthrow.logs.unit_names import UNITS

_SPLIT = re.compile(r"[^A-Za-z0-9]+|(?<=[a-z])(?=[A-Z])|(?<=\D)(?=\d)|(?<=\d)(?=\D)")
_NAMES = tables_beside(__file__, "column_names.toml")
_SUFFIX = _NAMES["units"]
_ENDINGS = _NAMES["components"]
_HINTS = _NAMES["hints"]


def _pattern(name: str) -> re.Pattern[str]:
    return re.compile(_NAMES["patterns"][name], re.IGNORECASE)


_TIME = _pattern("time")
_TARGET = _pattern("target")
_NOT_VEHICLE = _pattern("not_vehicle")
_LOAD = _pattern("load")
_THRUST = _pattern("thrust")
_ESTIMATE = _pattern("estimate")
_CAPTURE = _pattern("capture")
_COMPONENT = _pattern("component")
_MOTOR = _pattern("motor")
UPS = ("", "x,-z,y")
"""Axes of a world whose z is up, and of one whose y is, as Motive's."""
_MOTOR_UNITS = ((5000.0, "1/65535"), (150.0, "1/1000"), (2.0, "%"), (-np.inf, "1"))
"""Unit of commands of motors by what they exceed."""
# Of a path's derivative with what may be it: correlations that settle it, and that suggest it,
_FIRMLY = 0.8
_BELONGS = 0.6
_REACH = 0.2  # delays that are tried [s]
_LATEST = 0.15  # the longest delay that counts [s]
_SPAN = 0.1  # over which a path is differentiated [s]
_COARSE = 0.02  # step of the grid on which many pairs are compared [s]
_COMPARED = 1000  # rows on which the distance of two paths is judged
_LARGEST_THRUST = 5000.0  # in any unit: what is larger counts to 65535, as a Crazyflie's
_TURN = 7.0  # above a full turn in radians: degrees


@dataclass
class Group:
    """Columns that belong together."""

    stem: str  # what their names share
    columns: tuple[str, ...]
    values: np.ndarray  # shape (T, number of columns)
    unit: str = ""  # that the names end in, "" where they do not


@dataclass
class MappingProposal:
    """A mapping, why, and what is left to ask."""

    mapping: TableMap | None
    flyer: dict | None = (
        # parameters of the flying model as far as the log tells them, None where it cannot fly one
        None
    )
    why: dict[str, str] = field(default_factory=dict)  # by channel
    questions: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # columns that no channel takes, and parts


def propose(
    table: Table, source: str, mass: float | None = None, time_unit: str | None = None
) -> MappingProposal:
    """Propose a mapping of the columns of a table, or of the tables of a recording.

    ``source``: what messages call it; ``mass``: of the vehicle alone [kg], where it was weighed;
    ``time_unit``: of the stamps, where it is known. Raises LogError: no column holds numbers that
    change.
    """
    numbers = {
        name: cells.astype(float) for name, cells in table.items() if cells.dtype.kind in "fiub"
    }
    numbers = {name: np.where(np.isfinite(cells), cells, np.nan) for name, cells in numbers.items()}
    if not any(_moves(cells[:, None]) for cells in numbers.values()):
        raise LogError(f"{source}: none of its {len(table)} columns holds numbers that change")
    proposal = MappingProposal(None)
    channels = {}
    clocks = {}
    for topic, part in _tables(numbers).items():
        if len(next(iter(part.values()))) < 50:
            continue
        clock, time = _clock(part, proposal, time_unit)
        columns = {
            name: cells
            for name, cells in part.items()
            if name != clock.column and len(cells) == len(time)
        }
        settings = getattr(table, "settings", {})
        mine = _Chooser(time, _groups(columns), proposal, settings).channels()
        for entry in mine:
            if entry.name in channels:
                proposal.questions.append(
                    f"'{entry.name}' is also {', '.join(entry.columns)}: which one?"
                )
            else:
                channels[entry.name] = replace(entry, clock=topic)
        if mine:
            clocks[topic] = clock
    used = {column for entry in channels.values() for column in entry.columns}
    used |= {clock.column for clock in clocks.values()}
    proposal.left_out = [name for name in table if name not in used] + getattr(
        table, "left_out", []
    )
    if not channels:
        proposal.questions.append(
            "no column looks like a position, an attitude, rates, forces or motors: which columns"
            " are they?"
        )
        return proposal
    first, *remaining = clocks
    entries = tuple(
        replace(c, clock="" if c.clock == first else c.clock) for c in channels.values()
    )
    proposal.mapping = TableMap(
        clocks[first], entries, {name: clocks[name] for name in remaining} or None
    )
    _corrected(table, source, proposal, mass)
    return proposal


def _tables(numbers: Table) -> dict[str, Table]:
    """Columns by the table that they are of: what stands before a colon."""
    tables: dict[str, Table] = {}
    for name, cells in numbers.items():
        tables.setdefault(name.rpartition(":")[0], {})[name] = cells
    return tables


def _clock(
    numbers: Table, proposal: MappingProposal, stated_unit: str | None
) -> tuple[TimeColumn, np.ndarray]:
    """The column of stamps and its unit, or evenly spaced rows."""
    rising = [name for name, cells in numbers.items() if _rises(cells)]
    named = [name for name in rising if _TIME.search(name)]
    named.sort(key=lambda name: "frame" in name.lower())  # frames only where nothing is a time
    name = next(iter(named or rising), None)
    if name is None:
        count = max(map(len, numbers.values()))
        proposal.questions.append(
            "no column rises as a clock does: how far are the rows apart? row_period = 0.01 [s] is"
            " a guess"
        )
        return TimeColumn(row_period=0.01), 0.01 * np.arange(count)
    steps = np.diff(numbers[name])
    step = float(np.median(steps[steps > 0.0]))  # several rows may bear one stamp
    suffix = stated_unit or _split_unit(name)[1] or _SUFFIX.get(_words(name)[-1], "")
    rate = re.search(r"(\d+) ?hz", name, re.IGNORECASE)
    if rate and f"1/{rate[1]} s" in UNITS:
        suffix = f"1/{rate[1]} s"
    fitting = [unit for unit in ("s", "ms", "us", "ns") if 2e-4 <= step * UNITS[unit][1] <= 0.25]
    unit = suffix if suffix in UNITS and UNITS[suffix][0] == "s" else fitting[0] if fitting else "s"
    if not suffix and len(fitting) != 1:
        proposal.questions.append(
            f"time '{name}': a step of {step:g} fits the units {', '.join(fitting) or 'of none'};"
            f" '{unit}' is a guess"
        )
    if not named:
        proposal.questions.append(f"is '{name}', the first column that rises, the time?")
    proposal.why["time"] = f"rises by {step:g} a row, {1.0 / (step * UNITS[unit][1]):.4g} Hz"
    return TimeColumn(name, unit), numbers[name] * UNITS[unit][1]


def _moves(values: np.ndarray) -> bool:
    """Whether rows of numbers, shape (T, columns), differ."""
    whole = values[np.all(np.isfinite(values), axis=1)]
    return len(whole) > 0 and bool(np.any(np.ptp(whole, axis=0) > 0.0))


def _normalised(values: np.ndarray) -> np.ndarray:
    """Return numbers about their column's mean as one vector of length 1, zeros where none move."""
    centred = (values - np.mean(values, axis=0)).ravel()
    return centred / max(float(np.linalg.norm(centred)), 1e-300)


def _rises(cells: np.ndarray) -> bool:
    steps = np.diff(cells[np.isfinite(cells)])
    return len(steps) > 10 and bool(np.all(steps >= 0.0)) and float(np.mean(steps > 0.0)) > 0.3


def _words(name: str) -> list[str]:
    last = re.split(r"[^A-Za-z0-9]+", name.rstrip(")]} "))[-1].lower()
    return (
        [last]
        if last in _SUFFIX
        else [word.lower() for word in _SPLIT.split(name) if word] or [last]
    )


_BRACKETS = re.compile(r"^(.+?)\s*[\[(]\s*([^\d\[\]()][^\[\]()]*|)\s*[\])]$")
_NUMBERED = re.compile(r"^(.*?)[._\[]?([0-8])\]?$")


def _split_unit(name: str) -> tuple[str, str]:
    """A name without the unit in brackets at its end, and that unit; "" where it has none."""
    match = _BRACKETS.match(name)
    if match is None:
        return name, ""
    unit = unit_of(match[2])
    unit_name = next(
        (u for u in (match[2], unit or "", _SUFFIX.get(unit or "", "")) if u in UNITS), ""
    )
    return (match[1], unit_name) if unit_name or unit is not None else (name, "")


def _groups(numbers: Table) -> list[Group]:
    """Columns in threes (x, y, z or roll, pitch, yaw) and fours (a quaternion's, motors'), then
    single ones.
    """
    parts: dict[tuple[str, str], dict[str, str]] = {}
    motors: dict[tuple[str, str], list[str]] = {}
    digits: dict[tuple[str, str], dict[int, str]] = {}
    for name in numbers:
        base, unit = _split_unit(name)
        motor, match, digit = (r.match(base) for r in (_MOTOR, _COMPONENT, _NUMBERED))
        if motor:
            motors.setdefault((motor[1] + (motor[3] or ""), unit), []).append(name)
        if digit:
            digits.setdefault((digit[1], unit), {})[int(digit[2])] = name
        if match:
            family = _NAMES["families"].get(match[2].lower(), "")
            key = (match[1] + family, unit or _SUFFIX.get((match[3] or "").lower(), ""))
            parts.setdefault(key, {}).setdefault(_ENDINGS[match[2].lower()], name)
    listed = [("motor", unit, names) for (_, unit), names in motors.items() if len(names) == 4]
    listed += [
        (stem, unit, [columns[i] for i in sorted(columns)])
        for (stem, unit), columns in digits.items()
        if sorted(columns) in ([*range(9)], [1, 2, 3, 4])
    ]
    for (stem, unit), columns in parts.items():
        letters = "xyzw" if set("xyzw") <= columns.keys() else "xyz"
        if set(letters) <= columns.keys():
            listed.append((stem, unit, [columns[letter] for letter in letters]))
    listed += [("", "", names) for names in _without_names(numbers)]
    groups = []
    used = set()
    for stem, unit, names in listed:
        if not used & set(names):
            values = np.column_stack([numbers[name] for name in names])
            groups.append(Group(stem, tuple(names), values, unit))
            used |= set(names)
    return groups + [
        Group(
            name,
            (name,),
            numbers[name][:, None],
            _split_unit(name)[1] or _SUFFIX.get(_words(name)[-1], ""),
        )
        for name in numbers
        if name not in used
    ]


def _without_names(numbers: Table) -> list[list[str]]:
    """Neighbours in a table without a header: four of length 1, and threes of the others."""
    names = list(numbers)
    if not names or not all(name.startswith("column ") for name in names):
        return []
    groups = []
    i = 0
    run = []
    while i < len(names):
        four = np.column_stack([numbers[name] for name in names[i : i + 4]])
        length = np.linalg.norm(four, axis=1)
        if four.shape[1] == 4 and np.nanmax(np.abs(length - 1.0)) < 0.05:
            groups.append(names[i : i + 4])
            i += 4
            run = []
            continue
        run.append(names[i])
        i += 1
        if len(run) == 3:
            groups.append(run)
            run = []
    return groups


def _angle_unit(group: Group) -> str:
    """Return the unit of angles, as named, else by how far they reach."""
    if group.unit in ("deg", "rad"):
        return group.unit
    return "deg" if np.nanpercentile(np.abs(group.values), 99) > _TURN else "rad"


class _Chooser:
    """Decides which group is which channel."""

    def __init__(
        self,
        time: np.ndarray,
        groups: list[Group],
        proposal: MappingProposal,
        settings: dict[str, str],
    ) -> None:
        self.time = time
        self.found = proposal
        self.ask = proposal.questions.append
        self.settings = settings
        for group in groups:
            group.values = np.where(lost_rows(time, group.values)[:, None], np.nan, group.values)
        self.groups = [g for g in groups if _moves(g.values)]
        self.taken: set[int] = set()
        self.attitudes: dict[
            str, Channel
        ] = {}  # the vehicle's, by the units that its angles may be in
        self.made: dict[str, tuple[ChannelMap, Channel]] = {}
        self.unproven = ""  # angles that nothing but their name calls angles
        self.by: dict[
            tuple[str, ...], str
        ] = {}  # what says the unit of a path that no name says, by its columns

    def channels(self) -> list[ChannelMap]:
        """All that are recognised, the vehicle's path first."""
        self._quaternions()
        self._turns()
        self._angles()
        if not self.attitudes and "quat_wb" in self.made:
            entry, channel = self.made["quat_wb"]
            self.attitudes = {entry.unit: channel}
        self._positions()
        self._settle_turns()
        self._ask_angles()
        self._velocities()
        self._rates()
        self._forces()
        self._inputs()
        if self.unproven and not self.made.keys() & {"pos_w", "rate_b"}:
            self.ask(
                f"are {self.unproven} angles, as taken, or body rates? Nothing in the motion says"
            )
        if "pos_w" in self.made and not self.made.keys() & {
            "quat_wb",
            "rate_b",
            "acc_b",
            "motor_command",
            "vel_w",
        }:
            self.ask(
                "nothing but pos_w moves: if that is a payload or a ball, call it payload_pos_w"
            )
        for group in self._open(1):
            values = np.unique(group.values[np.isfinite(group.values)])
            whole = 1 < len(values) <= 64 and np.all(values == np.round(values))
            if whole and re.search(r"ball|track|body|id$|test|run|flight", group.stem):
                ask = f'[table.split] column = "{group.stem}"'
                self.ask(f"'{group.stem}' has {len(values)} values: one log for each? {ask}")
        return [entry for entry, _ in self.made.values()]

    def _open(self, size: int, targets: bool = False) -> list[Group]:
        return [
            g
            for g in self.groups
            if id(g) not in self.taken
            and g.values.shape[1] == size
            and (targets or not _TARGET.search(g.stem))
        ]

    def _take(self, name: str, group: Group, unit: str, why: str, **options: Any) -> None:
        """Make a channel of a group, unless its units contradict what the name stands for;
        ``options``: of its :class:`ChannelMap`.
        """
        entry = ChannelMap(name, group.columns, unit, **options)
        values = group.values
        if np.mean(np.all(values[1:] == values[:-1], axis=1)) > 0.5:
            entry = replace(entry, held=True)
            why += "; its values are held between measurements"
        try:
            channel, _ = make_channel(self.time, values, entry, "table")
        except (ConfigError, LogError):
            return
        self.taken.add(id(group))
        self.made[name] = (entry, channel)
        self.found.why[name] = why

    def _hinted(self, group: Group, kind: str) -> bool:
        stem = group.stem.lower()
        return bool(re.search(_HINTS[kind], stem)) and not any(
            re.search(pattern, stem)
            for name, pattern in _HINTS.items()
            if name not in (kind, "position")
        )

    def _quaternions(self) -> None:
        for group in self._open(4):
            if (
                group.stem == "motor"
                or not 0.95 < np.nanmedian(np.linalg.norm(group.values, axis=1)) < 1.05
            ):
                continue
            foreign = _NOT_VEHICLE.search(group.stem)
            name = (
                ("payload_quat_wb" if "cam" not in group.stem.lower() else "marker_quat_c")
                if foreign
                else "quat_wb"
            )
            if name in self.made:
                name = "est_quat_wb" if name == "quat_wb" and "est" in group.stem.lower() else ""
            if not name:
                continue
            lettered = any("w" in _split_unit(c)[0].lower()[-3:] for c in group.columns)
            largest = int(np.argmax(np.nanmean(np.abs(group.values), axis=0)))
            order = "xyzw" if lettered or largest == 3 else "wxyz"
            frame = "" if name == "quat_wb" else "camera" if name == "marker_quat_c" else "world"
            self._take(
                name,
                group,
                "1",
                "four columns of length 1",
                kind="quaternion",
                order=order,
                frame=frame,
            )

    def _turns(self) -> None:
        """Attitudes as rotation matrices or rotation vectors, column after column."""
        for size, kind, words in ((9, "matrix", r"rot"), (3, "rotvec", r"(^|[._])r$|helical")):
            for group in self._open(size):
                if "quat_wb" in self.made or not re.search(words, group.stem, re.IGNORECASE):
                    continue
                if _NOT_VEHICLE.search(group.stem):
                    continue
                unit = group.unit if group.unit in ("deg", "rad") else "rad"
                why = "nine columns of a rotation" if size == 9 else f"three angles in {unit}"
                self._take("quat_wb", group, "1" if size == 9 else unit, why, kind=kind)
                if size == 3 and "quat_wb" in self.made:
                    listed = ", ".join(group.columns)
                    self.ask(
                        f"are {listed} a rotation vector (Vicon's angle-axis), as taken, or roll,"
                        ' pitch and yaw (kind = "euler")?'
                    )

    def _settle_turns(self) -> None:
        """Order of a quaternion that no name says, and which axis is up, by what the lean does."""
        if not {"quat_wb", "pos_w"} <= self.made.keys():
            return
        entry = self.made["quat_wb"][0]
        place, path = self.made["pos_w"]
        named = entry.kind != "quaternion" or any("w" in c.lower() for c in entry.columns)
        group = next(g for g in self.groups if g.columns == entry.columns)
        orders = (entry.order,) if named else ("wxyz", "xyzw")
        motive = "Format Version" in self.settings
        ups = UPS if motive or self.settings else UPS[:1]
        scores = {}
        for order in orders:
            for axes in ups:
                tried = replace(entry, order=order, axes=axes, body_axes=axes)
                quat = make_channel(self.time, group.values, tried, "table")[0]
                turned = path.values @ (turn_of(axes).T if axes else np.eye(3))
                scores[order, axes] = unit_evidence.lean_misfit(
                    path.time, np.where(path.valid[:, None], turned, np.nan), quat
                )
        ranked = sorted(scores, key=lambda name: scores[name][0])
        best = ranked[0]
        nats = scores[best][1] * (
            np.log(scores[ranked[1]][0] / scores[best][0]) if len(ranked) > 1 else 0.0
        )
        sure = len(ranked) == 1 or (np.isfinite(nats) and nats > 10.0)
        if not sure:
            best = (entry.order, UPS[1] if motive else "")
        order, axes = best
        entry = replace(entry, order=order, axes=axes, body_axes=axes)
        self.made["quat_wb"] = entry, make_channel(self.time, group.values, entry, "table")[0]
        points = next(g for g in self.groups if g.columns == place.columns)
        place = replace(place, axes=axes)
        self.made["pos_w"] = place, make_channel(self.time, points.values, place, "table")[0]
        if len(ranked) > 1 and sure:
            words = f"axes {axes or 'x,y,z'}" if named else f"order {order}, axes {axes or 'x,y,z'}"
            self.found.why["quat_wb"] += f"; {words} by gravity, {nats:.0f} nats"
        elif len(ranked) > 1:
            question = (
                "" if named else f"is the order of {', '.join(entry.columns)} {order}, as taken? "
            )
            question += f"which axis is up? '{axes or 'x,y,z'}' is taken; " if len(ups) > 1 else ""
            self.ask(question + "nothing in the motion says")

    def _positions(self) -> None:
        smooth = [g for g in self._open(3) if self._smooth(g)]
        smooth = [g for g in smooth if g.unit not in ("deg", "rad")]
        groups = [g for g in smooth if self._hinted(g, "position") or g.unit in ("mm", "cm", "m")]
        others = [
            g
            for g in smooth
            if not any(re.search(pattern, g.stem.lower()) for pattern in _HINTS.values())
        ]
        if not groups:  # no name speaks of a place
            groups = others
            listed = "; ".join(", ".join(group.columns) for group in groups)
            if groups:
                self.ask(f"are these positions? Names do not say: {listed}")
        moving = [g for g in smooth if self._hinted(g, "velocity")] + groups
        derived = self._derivatives(moving, groups)
        groups = [group for group, is_rate in zip(groups, derived) if not is_rate]
        for group in [g for g in groups if "cam" in g.stem.lower()]:
            unit = self._length_unit(group)
            if unit and "marker_pos_c" not in self.made:
                self._take(
                    "marker_pos_c",
                    group,
                    unit,
                    "three columns that move smoothly; their name speaks of a camera",
                    frame="camera",
                )
        units = {
            g.columns: self._length_unit(g)
            for g in sorted(groups, key=lambda g: not g.unit)
            if "cam" not in g.stem.lower()
        }
        paths = [(g, units[g.columns]) for g in groups if units.get(g.columns)]
        pay = self._payload(paths, others)
        vehicles = [(g, u) for g, u in paths if pay is None or g is not pay[1]]
        vehicles.sort(key=lambda path: bool(_LOAD.search(path[0].stem)))
        if pay is not None and not _ESTIMATE.search(getattr(pay[0], "stem", "")):
            vehicles.sort(key=lambda path: path[0] is not pay[0])  # the payload hangs below it
        for group, unit in vehicles:
            usual = "mocap_pos_w" if _CAPTURE.search(group.stem) else "pos_w"
            usual = "est_pos_w" if _ESTIMATE.search(group.stem) else usual
            first = usual == "pos_w" or group is vehicles[0][0]
            names = ["pos_w"] * first + [usual]
            name = next((n for n in names if n not in self.made), "")
            if name:
                wide = float(np.nanmax(np.nanstd(group.values, axis=0)))
                why = f"three columns that move smoothly, by {wide:.3g} {unit} (sd)"
                why += self.by.get(group.columns, "")
                self._take(name, group, unit, why, frame="" if name == "pos_w" else "world")
        if len(vehicles) > 1:
            listed = "; ".join(", ".join(g.columns) for g, _ in vehicles)
            self.ask(
                f"several positions ({listed}): which is the vehicle's, and by which sensor? The"
                " first is taken"
            )
        if pay is not None:
            _, group, unit, why = pay
            self._take("payload_pos_w", group, unit, why + self.by.get(group.columns, ""))

    def _length_unit(self, group: Group) -> str:
        """Unit of a position: as named, else by physics, else that in which it stays in a hall; ""
        where it does not move.
        """
        named = group.unit if group.unit in unit_evidence.LENGTHS else ""
        if (
            not np.nanmax(
                np.ptp(group.values[np.all(np.isfinite(group.values), axis=1)], axis=0), initial=0.0
            )
            > 0.0
        ):
            return named
        fit, reach = unit_evidence.by_hall(group.values)
        leans = unit_evidence.by_lean(
            self.time, group.values, self.attitudes, [named] if named else unit_evidence.LENGTHS
        )
        if len(leans) > 1:
            leans = [lean for lean in leans if lean[0] in fit] or leans
        if len(leans) > 1:
            leans = [
                lean for lean in leans if unit_evidence.USUAL[0] < lean[2] < unit_evidence.USUAL[1]
            ] or leans
        if len(leans) == 1:
            angle = leans[0][1]
            self._settle_angles(
                angle,
                f"{angle} by gravity: {group.columns[0]} and its neighbours accelerate as they"
                " lean",
            )
        if named:
            return named
        if len(leans) == 1:
            self.by[group.columns] = (
                f"; {leans[0][0]} by gravity: it accelerates by {leans[0][2]:.2g} times what its"
                " lean makes"
            )
            return leans[0][0]
        if unit := unit_evidence.by_fall(self.time, group.values):
            self.by[group.columns] = f"; {unit} by gravity: a part of it falls freely"
            return unit
        if leans:
            return self._guess_pair(group, leans)
        unit = next(iter(fit), "m")
        self.by[group.columns] = f"; {unit} by the size of a hall: {reach:.3g} from the origin"
        if len(fit) != 1:
            alternatives = (
                f"{' and '.join(fit[1:])} fit a hall too" if fit else "no unit fits a hall"
            )
            self.ask(
                f"{', '.join(group.columns)} reach {reach:.3g} from the origin: '{unit}' is a "
                f"guess;"
                f" {alternatives}"
            )
        return unit

    def _guess_pair(self, path: Group, leans: list[unit_evidence.Lean]) -> str:
        """Ask which units of a path and of the angles go together, where gravity allows several.

        Returns the path's of the likeliest.
        """
        unit, angle, ratio = min(leans, key=lambda lean: abs(np.log(lean[2])))
        listed = ", ".join(path.columns)
        angles = ", ".join(self.made["quat_wb"][0].columns)
        pairs = " or ".join(
            f"{unit_name} and {leaning} ({times:.2g} times)" for unit_name, leaning, times in leans
        )
        self.ask(
            f"{listed} and the angles {angles}: are they in {pairs}? So many times what its lean"
            f" makes it accelerates, and all of these may be; '{unit}' and '{angle}' are a guess"
        )
        self._settle_angles(angle, f"{angle} is a guess")
        self.by[path.columns] = (
            f"; {unit} is a guess: it accelerates by {ratio:.2g} times what its lean makes"
        )
        return unit

    def _settle_angles(self, unit: str, why: str) -> None:
        """Take a unit of the vehicle's angles."""
        if len(self.attitudes) > 1:
            entry = replace(self.made["quat_wb"][0], unit=unit)
            self.attitudes = {unit: self.attitudes[unit]}
            self.made["quat_wb"] = (entry, self.attitudes[unit])
            self.found.why["quat_wb"] += f"; {why}"

    def _ask_angles(self) -> None:
        if len(self.attitudes) > 1:
            entry = self.made["quat_wb"][0]
            listed = ", ".join(entry.columns)
            self.ask(
                f"angles {listed}: {entry.unit} is taken; are they in"
                f" {' or '.join(self.attitudes)}?"
            )

    def _payload(
        self, paths: list[tuple[Group, str]], others: list[Group]
    ) -> tuple[Group | None, Group, str, str] | None:
        """Find the path below another one that keeps its distance from it, or what nothing names
        and does so in its unit.

        Returns that other one, the path, its unit and the reason.
        """
        candidates = []
        rows = slice(None, None, max(1, len(self.time) // _COMPARED))
        for upper, a in paths:
            for lower, b in [*paths, *((group, a) for group in others)]:
                if upper is lower:
                    continue
                gap = lower.values[rows] * UNITS[b][1] - upper.values[rows] * UNITS[a][1]
                length = np.linalg.norm(gap, axis=1)
                middle = np.nanmedian(length)
                spread = np.nanstd(length)
                if (
                    0.05 < middle < 20.0
                    and spread < 0.1 * middle
                    and np.nanmedian(gap[:, 2]) < -0.3 * middle
                ):
                    candidates.append((spread / middle, upper, lower, b, middle))
        best = min(candidates, key=lambda candidate: candidate[0], default=None)
        if best is not None:
            return *best[1:4], f"keeps {best[4]:.3f} m from another path, below it"
        if len(paths) == 1 and _NOT_VEHICLE.search(" ".join(paths[0][0].columns)):
            return None, *paths[0], "the only path, and its name speaks of no vehicle"
        return None

    def _smooth(self, group: Group) -> bool:
        values = group.values[np.all(np.isfinite(group.values), axis=1)]
        if len(values) < 50:
            return False
        moves = np.std(values, axis=0)
        steps = np.std(np.diff(values, axis=0), axis=0)
        return bool(np.max(moves) > 0.0 and np.max(steps) < 0.3 * np.max(moves))

    def _slope(self, group: Group) -> tuple[np.ndarray, np.ndarray]:
        """Return times at which a group's derivative is known, and it; few or none of a short
        one.
        """
        time, values = unit_evidence.rising(self.time, group.values)
        return relations.derivative(time, values, _SPAN) if len(time) >= 100 else (time, values)

    def _relation(self, path: Group, rate: Group, threshold: float) -> relations.Relation | None:
        if rate.unit in unit_evidence.LENGTHS:
            return None  # a length is no velocity, whatever it goes with
        relation = self._compared(*self._slope(path), rate)
        if relation is None or relation.correlation <= threshold:
            return None
        return relation if abs(relation.delay) < _LATEST else None

    def _derivatives(self, paths: list[Group], rates: list[Group]) -> list[bool]:
        """Tell which groups are the derivative of another path.

        Captures of many markers have thousands of pairs: all are correlated on one coarse grid, by
        one matrix product a delay.
        """
        grid = np.arange(np.nanmin(self.time), np.nanmax(self.time), _COARSE)
        steps = round(_REACH / _COARSE)
        count = len(grid) - 2 * steps
        if not rates or count < 25:
            return [False] * len(rates)
        slopes = [self._on_grid(path, grid, slope=True)[steps : steps + count] for path in paths]
        slopes = np.array([_normalised(slope) for slope in slopes])
        values = [self._on_grid(rate, grid) for rate in rates]
        scores = []
        for start in range(2 * steps + 1):
            moved = [_normalised(path[start : start + count]) for path in values]
            scores.append(slopes @ np.array(moved).T)
        late = np.abs(np.argmax(scores, axis=0) - steps) * _COARSE
        firm = (np.max(scores, axis=0) > _FIRMLY) & (late < _LATEST)
        return [
            rate.unit not in unit_evidence.LENGTHS  # a length is no velocity
            and any(hit and path is not rate for hit, path in zip(column, paths))
            for rate, column in zip(rates, firm.T)
        ]

    def _on_grid(self, group: Group, grid: np.ndarray, slope: bool = False) -> np.ndarray:
        """Return a group's values, or their slope, at times of a grid; zeros where too few are
        known.
        """
        if slope:
            time, values = self._slope(group)
        else:
            time, values = unit_evidence.rising(self.time, group.values)
        if len(time) < 100:
            return np.zeros((len(grid), group.values.shape[1]))
        return relations.on_grid(time, values, grid)

    def _compared(
        self, stamps: np.ndarray, derived: np.ndarray, group: Group
    ) -> relations.Relation | None:
        """Relate a group's columns to what was derived of other ones; None where too few are
        known.
        """
        time, values = unit_evidence.rising(self.time, group.values)
        if min(len(stamps), len(time)) < 100:
            return None
        return relations.relate(stamps, derived, time, values, reach=_REACH)

    def _velocities(self) -> None:
        for name in ("pos_w", "payload_pos_w", "est_pos_w"):
            if name not in self.made:
                continue
            entry = self.made[name][0]
            path = next(g for g in self.groups if g.columns == entry.columns)
            candidates = [
                (r.correlation, g, r)
                for g in self._open(3)
                if (r := self._relation(path, g, _BELONGS)) is not None
            ]
            if name == "pos_w" and self._body_velocity(path, candidates):
                continue
            if not candidates:
                continue
            _, group, relation = max(candidates, key=lambda candidate: candidate[0])
            size = UNITS[entry.unit][1] / relation.scale
            unit = min(("m/s", "cm/s", "mm/s"), key=lambda u: abs(np.log(size / UNITS[u][1])))
            velocity_name = name.replace("pos", "vel")
            why = (
                f"the derivative of {name}, correlation {relation.correlation:.2f},"
                f" {relation.scale:.3g} of its unit a second"
            )
            self._take(
                velocity_name,
                group,
                unit,
                why,
                frame="world" if velocity_name == "est_vel_w" else "",
            )

    def _body_velocity(self, path: Group, world: list) -> bool:
        """Take a velocity that is the path's in the body's axes rather than in the world's."""
        attitude = self.made.get("quat_wb", (None, None))[1]
        if attitude is None or len(attitude.time) < 100:
            return False
        stamps, derived = self._slope(path)
        if len(stamps) < 100:
            return False
        turned = rotate_back(relations.attitude_at(*attitude.samples(), stamps), derived)
        best = max((correlation for correlation, *_ in world), default=0.0)
        for group in self._open(3):
            if not self._hinted(group, "velocity"):
                continue
            relation = self._compared(stamps, turned, group)
            if relation is None or relation.correlation < _FIRMLY:
                continue
            clear = 0.5 * np.ptp(stamps) / relations.INDEPENDENT
            nats = clear * np.log((1.0 - best**2) / max(1.0 - relation.correlation**2, 1e-6))
            if nats > 10.0:
                unit = group.unit if group.unit.endswith("/s") else "m/s"
                why = (
                    f"the derivative of pos_w in the body's axes, {nats:.0f} nats over the world's"
                )
                self._take("vel_b", group, unit, why, frame="body")
                return True
        return False

    def _angles(self) -> None:
        for group in self._open(3):
            if (
                "quat_wb" in self.made
                or not self._hinted(group, "euler")
                or not self._smooth(group)
            ):
                continue
            largest = float(np.nanpercentile(np.abs(group.values), 99))
            unit = _angle_unit(group)
            self._take(
                "quat_wb", group, unit, f"roll, pitch, yaw up to {largest:.3g} {unit}", kind="euler"
            )
            if "quat_wb" in self.made and not group.unit:
                self.unproven = ", ".join(group.columns)
            if "quat_wb" in self.made and largest <= _TURN and not group.unit:
                entry, radians = self.made["quat_wb"]
                degrees, _ = make_channel(
                    self.time, group.values, replace(entry, unit="deg"), "table"
                )
                self.attitudes = {unit: radians, "deg": degrees}
                tilt = physics.median_tilt(radians)
                if tilt > physics.STEEPEST:
                    self._settle_angles(
                        "deg", f"deg: in rad half of the time tilted by more than {tilt:.0f} deg"
                    )

    def _rates(self) -> None:
        attitude = self.made.get("quat_wb", (None, None))[1]
        ranked = []
        for group in (g for g in self._open(3) if self._hinted(g, "rate_b")):
            relation = None
            times = 1.0
            if attitude is not None and len(attitude.time) > 100:
                stamps, derived = relations.rates_of(*attitude.samples())
                good = np.all(np.isfinite(group.values), axis=1)
                relation = self._compared(stamps, derived, group)
                times = float(
                    np.sqrt(
                        np.mean(np.var(group.values[good], axis=0))
                        / max(np.mean(np.var(derived, axis=0)), 1e-12)
                    )
                )
            ranked.append(
                (relation.axes_correlation if relation is not None else 0.0, group, times)
            )
        if not ranked:
            return
        score, group, times = max(ranked, key=lambda candidate: candidate[0])
        largest = float(np.nanpercentile(np.abs(group.values), 99))
        unit = group.unit if group.unit.endswith("/s") else "deg/s" if largest > 30.0 else "rad/s"
        why = f"99 % within {largest:.3g}"
        if score > _BELONGS:
            unit = "deg/s" if times > 7.0 else "rad/s"
            why = f"the rates of the attitude, correlation {score:.2f}, {times:.3g} times"
        elif not group.unit:
            listed = ", ".join(group.columns)
            if group.columns == ("gyro.x", "gyro.y", "gyro.z"):
                unit = "deg/s"
                why += "; a Crazyflie's gyro.x is in deg/s"
            self.ask(
                f"are the rates {listed} in rad/s or deg/s? '{unit}' is taken: no attitude says"
            )
        self._take("rate_b", group, unit, why)

    def _forces(self) -> None:
        for group in self._open(3):
            size = float(np.nanmedian(np.linalg.norm(group.values, axis=1)))
            unit = next(
                (
                    u
                    for u in ("m/s^2", "g", "mg")
                    if 0.8 < size * UNITS[u][1] / physics.GRAVITY < 1.25
                ),
                "",
            )
            if unit and self._hinted(group, "acc_b") and "acc_b" not in self.made:
                self._take(
                    "acc_b",
                    group,
                    unit,
                    f"a middle size of {size:.3g}: gravity in {unit}",
                    frame="body",
                )

    def _rotor_speeds(self, group: Group, high: float) -> bool:
        """Take four motors as speeds where their names or unit say so."""
        words = " ".join(group.columns)
        if group.unit not in ("rpm", "rad/s") and not re.search(
            r"rpm|speed|omega|rad_?s", words, re.IGNORECASE
        ):
            return False
        named = group.unit in ("rpm", "rad/s")
        unit = group.unit if named else "rpm" if re.search("rpm", words, re.IGNORECASE) else "rad/s"
        self._take("motor_speed", group, unit, f"four rotors' speeds up to {high:.5g} {unit}")
        self.ask(
            f"rotors {', '.join(group.columns)}: order them front left, front right, rear left,"
            " rear right; are they electrical revolutions (divide by pole pairs)?"
        )
        return True

    def _inputs(self) -> None:
        for group in self._open(4):
            if group.stem == "motor" and "motor_command" not in self.made:
                high = float(np.nanpercentile(group.values, 99))
                if self._rotor_speeds(group, high):
                    continue
                unit = next(unit for above, unit in _MOTOR_UNITS if high > above)
                self._take("motor_command", group, unit, f"four motors up to {high:.5g}")
                self.ask(
                    f"motors {', '.join(group.columns)}: order them front left, front right, rear"
                    " left, rear right (Crazyflie: 4, 1, 3, 2; Betaflight: 4, 2, 3, 1; PX4: 3, 1,"
                    " 2, 4). Are they commands, or speeds?"
                )
        for group in self._open(1):
            stem = group.stem.lower()
            middle = float(np.nanmedian(group.values))
            if (
                re.search(r"vbat|volt|batt", stem)
                and "battery_voltage" not in self.made
                and middle > 0.0
            ):
                units = (group.unit,) if group.unit in ("V", "mV") else ("V", "cV", "mV")
                unit = next((u for u in units if 2.5 < middle * UNITS[u][1] < 60.0), "")
                if unit:
                    self._take(
                        "battery_voltage",
                        group,
                        unit,
                        f"a middle of {middle:.4g}: a pack in {unit}",
                    )
            elif (
                re.search(r"theta|angle", stem)
                and "angle" not in self.made
                and not self.made.keys() & {"quat_wb"}
            ):
                unit = _angle_unit(group)
                self._take("angle", group, unit, f"an angle, by its name; a middle of {middle:.3g}")
                if not group.unit:
                    self.found.questions.append(
                        f"angle '{group.stem}': '{unit}' is taken by its reach: deg or rad?"
                    )
        self._thrust()

    def _thrust(self) -> None:
        """Take the collective thrust, a command before what else bears its name."""
        groups = [g for g in self._open(1, targets=True) if _THRUST.search(_split_unit(g.stem)[0])]
        groups = [g for g in groups if not _rises(g.values[:, 0])]  # f of frames, t of times
        groups.sort(key=lambda g: (len(g.stem) == 1, not _TARGET.search(g.stem)))
        for group in groups:  # a word before a letter, which may be of a temperature
            middle = float(np.nanmedian(group.values))
            if middle > _LARGEST_THRUST or "thrust_command" in self.made:
                continue
            unit = group.unit if group.unit in unit_evidence.THRUSTS else "N"
            self._take("thrust_command", group, unit, f"a middle of {middle:.4g}")


def _corrected(table: Table, source: str, proposal: MappingProposal, weighed: float | None) -> None:
    """Read the table by the proposal, hold it against physics, and turn axes that another set
    explains; mirrors are asked about.
    """
    for _ in range(3):
        log = logs_of(table, proposal.mapping, source)[0]
        full = FlightLog({n: c for n, c in log.channels.items() if np.sum(c.valid) >= 50}, log.meta)
        wrong = [row for row in physics.look(full) if row.verdict == "bad"]
        turns = [
            row
            for row in wrong
            if row.topic == "frames" and "axes" in row.figures and row.channel.endswith("rate_b")
        ]
        if not turns or "a mirror image" in turns[0].text:
            break
        row = turns[0]
        entries = [
            replace(c, axes=row.figures["axes"]) if c.name == "rate_b" else c
            for c in proposal.mapping.channels
        ]
        if entries == list(proposal.mapping.channels):
            break
        proposal.mapping = replace(proposal.mapping, channels=tuple(entries))
        proposal.why["rate_b"] += f"; axes by physics: {row.text}"
    proposal.questions += [f"physics speaks against {row.channel}: {row.text}" for row in wrong]
    full = _weighed(full, proposal, weighed)
    proposal.flyer = _flyer(full, proposal, weighed)
    if weighed is not None and proposal.flyer is None:
        proposal.questions.append(
            "--mass is not used: a flying model needs a thrust or motors, an attitude and a"
            " position; not all are found"
        )


def _weighed(log: FlightLog, proposal: MappingProposal, weighed: float | None) -> FlightLog:
    """Hold the thrust against the mass.

    Returns the log with its thrust in the unit in which it carries what was weighed. Raises
    LogError: see :func:`_unit_by_mass`.
    """
    entry = next((c for c in proposal.mapping.channels if c.name == "thrust_command"), None)
    carried = _carried(log)
    if entry is None or carried is None:
        if weighed is not None and weighed >= 1e3 * unit_evidence.LIGHTEST:
            text = (
                f"the vehicle weighs {weighed:g} kg? Nothing in the log is in newtons, to compare;"
                f" for grams write {weighed / 1e3:g}"
            )
            proposal.questions.append(text)
        return log
    named = _SUFFIX.get(_words(entry.columns[0])[-1]) == entry.unit
    units = (entry.unit,) if named else unit_evidence.THRUSTS
    one = carried / UNITS[entry.unit][1]  # if a number of its column were a newton
    if weighed is None:
        if not named:
            masses = ", ".join(f"{one * UNITS[unit][1]:.3g} kg in {unit}" for unit in units)
            proposal.questions.append(
                f"thrust '{entry.columns[0]}': newtons of all motors together, as taken? It carries"
                f" {masses}"
            )
        return log
    unit = _unit_by_mass(log, proposal, entry, one, weighed, units)
    if unit == entry.unit:
        return log
    mine = [replace(c, unit=unit) if c is entry else c for c in proposal.mapping.channels]
    proposal.mapping = replace(proposal.mapping, channels=tuple(mine))
    channel = log[entry.name]
    times = UNITS[unit][1] / UNITS[entry.unit][1]
    return FlightLog(
        {**log.channels, entry.name: replace(channel, values=times * channel.values)}, log.meta
    )


def _unit_by_mass(
    log: FlightLog,
    proposal: MappingProposal,
    entry: ChannelMap,
    one: float,
    weighed: float,
    units: Sequence[str],
) -> str:
    """Find the unit in which a thrust carries what was weighed, and say why or ask; the one that it
    has where none does.

    ``one``: what a number of its column carries if it is a newton [kg]. Raises LogError: in grams
    it fits, in kilograms it does not.
    """
    unit = unit_evidence.by_mass(one, weighed, units)
    in_grams = (
        unit_evidence.by_mass(one, 1e-3 * weighed, units)
        if weighed >= 1e3 * unit_evidence.LIGHTEST
        else ""
    )
    if not unit and in_grams:
        raise LogError(
            f"--mass {weighed:g} is {weighed:g} kg, but the thrust '{entry.columns[0]}' carries"
            f" {one * UNITS[in_grams][1]:.3g} kg in {in_grams}: grams? Expected kilograms: --mass"
            f" {weighed / 1e3:g}"
        )
    if not unit:
        carried = one * UNITS[entry.unit][1]
        proposal.questions.append(
            f"thrust '{entry.columns[0]}' carries {carried:.3g} kg in {entry.unit}, and the vehicle"
            f" weighs {weighed:g} kg: no unit explains that; is it of one motor, of another"
            " vehicle, or no force?"
        )
        return entry.unit
    whole = one * UNITS[unit][1]
    proposal.why[entry.name] += f"; {unit} by the mass: it carries {whole:.4g} kg"
    if np.log(whole / weighed) > thrust_checks.MASS_WARN and "payload_pos_w" not in log:
        proposal.questions.append(
            f"thrust '{entry.columns[0]}' carries {whole:.4g} kg, and the vehicle weighs"
            f" {weighed:g} kg: does a load hang below? The model has none; map its position as"
            " payload_pos_w and add [flyer.cable]"
        )
    if in_grams:
        proposal.questions.append(
            f"the vehicle weighs {weighed:g} kg and '{entry.columns[0]}' is in {unit}, or"
            f" {weighed:g} g and {in_grams}?"
        )
    return unit


def _carried(log: FlightLog) -> float | None:
    """Return the mass that a thrust in newtons carries, by the accelerometer or at the usual thrust
    of the flight [kg]; None without a thrust.
    """
    if (mass := thrust_checks.mass_of(log)) is not None or "thrust_command" not in log:
        return mass
    total = log["thrust_command"].samples()[1]
    usual = _usual(total) if len(total) else 0.0
    return usual / physics.GRAVITY if usual > 0.0 else None


def _usual(total: np.ndarray) -> float:
    """Middle of a thrust while it flies."""
    return float(np.median(total[total > 0.5 * np.percentile(total, 90)]))


def _driving(log: FlightLog, proposal: MappingProposal) -> str:
    """The input that the force follows best, "" where that cannot be told."""
    inputs = [name for name in thrust_checks.INPUTS if name in log]
    scores = {name: s for name in inputs if (s := thrust_checks.follows(log, name)) is not None}
    if len(inputs) < 2 or not scores:
        return ""
    best = max(scores, key=scores.__getitem__)
    listed = ", ".join(f"{name} {score:.2f}" for name, score in scores.items())
    proposal.questions.append(
        f"which of {', '.join(inputs)} drives the vehicle? The force follows '{best}' best"
        f" (correlations: {listed})"
    )
    return best


def _flyer(log: FlightLog, proposal: MappingProposal, weighed: float | None) -> dict | None:
    """A flying model to begin with: thrust scaled so that it carries the vehicle, the rest as of a
    small quadrotor at rest air.
    """
    applied = thrust_checks.thrust_of(log, KnownVehicle(thrust_input=_driving(log, proposal)))
    if applied is None or not {"quat_wb", "pos_w"} <= log.channels.keys():
        return None
    if np.median(applied[2]) <= 0.0:
        return None
    mass = thrust_checks.mass_of(log)
    gap = None
    if "payload_pos_w" in log:
        time, pos = log["pos_w"].samples()
        time_p, pos_p = log["payload_pos_w"].samples()
        gap = float(np.median(np.linalg.norm(pos_p - relations.on_grid(time, pos, time_p), axis=1)))
    name, _, total = applied
    motors = 1 if name in ("thrust_command", "throttle") else 4
    hover = _usual(total) / motors
    share = 0.85 if gap else 1.0  # of the vehicle in what flies, until both are weighed
    whole = weighed / share if weighed else mass or 1.0
    first = 1.0 if mass else whole * physics.GRAVITY / motors / hover
    payload = (1.0 - share) * whole
    if weighed is None:
        why = "stands for any, and the thrust is scaled to it"
        why = "is what its thrust carries" if mass else why
        proposal.questions.append(
            f"what does the vehicle weigh? {whole:.4g} kg {why}; call map again with --mass KG"
        )
    if gap:
        proposal.questions.append(f"what does the payload weigh? {payload:.3g} kg is a guess")
    volts = log["battery_voltage"].values if "battery_voltage" in log else [1.0]
    power = [0.0, 0.0, first / hover] if name == "motor_speed" else [0.0, first, 0.0]
    period = float(np.median(np.diff(log["pos_w"].time)))
    table = {
        "input": name,
        "position": "pos_w",
        "attitude": "quat_wb",
        "mass": round(whole * share, 5),
        "gravity": 9.81,
        "thrust_map": [float(f"{x:.4g}") for x in power],
        "motor_time_constant": 0.03,
        "command_delay": 0.0,
        "reference_voltage": float(np.round(np.median(volts), 2)),
        "voltage_coefficient": 0.0,
        "drag_xy": 0.0,
        "drag_z": 0.0,
        "lowest": 0.3,
        "window": 1.0,
        "step": 0.02,
        "every": max(1, round(0.03 / period)),
        "most_windows": 24,
    }
    if gap:
        table["cable"] = {"length": round(gap, 4), "mass": round(payload, 5)}
    return table
