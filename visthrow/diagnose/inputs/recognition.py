"""Recognition of channels among a table's groups of columns, by names, values and physics."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.errors import ConfigError, LogError
from visthrow.common.rotations import matrix_of_quat, rotate_back, tilt_deg
from visthrow.diagnose.inputs.columns import HINTS, NAMES, PATTERNS, Group, moves, rises, split_unit
from visthrow.diagnose.inputs.unit_evidence import (
    LENGTHS,
    NO_ATTITUDE,
    SURE,
    THRUSTS,
    Attitude,
    PathReading,
    readings,
    select_rising,
    turn_to,
)
from visthrow.logs.check import physics, relations
from visthrow.logs.check.thrust_checks import IDLE_PULSE
from visthrow.logs.flightlog import STANDARD_CHANNELS, Channel
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.table_to_log import find_lost_rows, make_channel
from visthrow.logs.samples import Samples
from visthrow.logs.unit_names import UNITS, fitting_units, nearest_unit

Y_UP = "x,-z,y"
"""This project's axes in those of Motive's world, whose y is up."""
NED = "x,-y,-z"
"""This project's axes in those of an autopilot: north, east, down; its body's are forward, right,
down.
"""
_MOTOR_UNITS = ((5000.0, "1/65535"), (150.0, "1/1000"), (2.0, "%"), (-np.inf, "1"))
"""Unit of motor commands by the value that their largest exceeds."""
# range of motors' pulses [us]; commands that start from 0, such as DShot's, go below it
_LEAST_PULSE = 800.0
_LARGEST_PULSE = 2300.0
# correlation of a path's derivative with a channel that proves, and that suggests, a relation
_FIRMLY = 0.8
_BELONGS = 0.6
_REACH = 0.2  # largest delay to try [s]
_SPAN = 0.1  # span over which a path is differentiated [s]
_COARSE = 0.02  # step of the grid on which many pairs are compared [s]
_COMPARED = 1000  # rows at which the distance of two paths is compared
_LARGEST_THRUST = 5000.0  # in any unit; larger values are counts to 65535, as a Crazyflie's
_TURN = 7.0  # angles beyond a full turn in radians are in degrees
_UNUSUAL = 1.0  # nats against an unusual order or unusual axes
_TILTED = 10.0  # nats against an attitude that is tilted, or that tilts the mean force
_PACK = (2.5, 60.0)  # voltage of any vehicle's battery [V]
_FRAMES = {"w": "world", "wb": "world", "b": "body", "c": "camera"}
"""Suffix of a channel's name -> its frame."""
_MOTIONS = {"quat_wb", "rate_b", "acc_b", "motor_command", "vel_w"}


@dataclass
class Recognised:
    """A recognised channel and the reason for its recognition."""

    entry: ChannelMap
    channel: Channel
    group: Group
    why: str


@dataclass(frozen=True)
class Path:
    """A path in metres, z up."""

    group: Group
    unit: str
    pos_w: ndarray  # shape (T, 3)
    why: str

    @property
    def usual_name(self) -> str:
        """Name of the channel that the columns' names suggest."""
        if self.group.matches("estimate"):
            return "est_pos_w"
        return "mocap_pos_w" if self.group.matches("capture") else "pos_w"


class Recognition:
    """Assignment of channels to a table's groups of columns.

    Attributes:
        questions: What neither names nor physics determine.
    """

    def __init__(self, time: ndarray, groups: list[Group], settings: dict[str, str]):
        """Keep the groups that change; ``time``: stamps [s]; ``settings``: the table's header."""
        self.time = time
        self.settings = settings
        self.questions: list[str] = []
        for group in groups:
            group.values = np.where(find_lost_rows(group.values)[:, None], np.nan, group.values)
        self._groups = [group for group in groups if moves(group.values)]  # not yet a channel
        self._found: dict[str, Recognised] = {}

    def channels(self) -> list[Recognised]:
        """Recognise all channels, the vehicle's attitude and path first."""
        self._quaternions()
        self._find_other_attitudes()
        self._positions()
        self._velocities()
        self._rates()
        self._forces()
        self._motors()
        self._single_columns()
        self._thrust()
        self._ask_what_is_open()
        return list(self._found.values())

    def _open(self, size: int, targets: bool = False) -> list[Group]:
        """Return unassigned groups of ``size`` columns; ``targets``: whether to include set-
        points.
        """
        return [
            group
            for group in self._groups
            if len(group.columns) == size and (targets or not group.matches("target"))
        ]

    def _find_hints(self, kind: str) -> list[Group]:
        """Return unassigned groups of three columns whose names hint at a kind."""
        return [group for group in self._open(3) if group.hints_at(kind)]

    def _take(self, name: str, group: Group, unit: str, why: str, **options: Any) -> bool:
        """Make a channel of a group, unless its unit contradicts the channel's quantity.

        ``options``: of the :class:`ChannelMap`. Returns whether the channel was made."""
        if name in self._found:
            return False
        values = group.values
        held = bool((values[1:] == values[:-1]).all(1).mean() > 0.5)
        frame = "" if name in STANDARD_CHANNELS else _FRAMES.get(name.rpartition("_")[2], "")
        entry = ChannelMap(name, group.columns, unit, frame=frame, held=held, **options)
        try:
            channel, _ = make_channel(self.time, values, entry, "table")
        except (ConfigError, LogError):
            return False
        self._groups.remove(group)
        why += "; its values are held between measurements" if held else ""
        self._found[name] = Recognised(entry, channel, group, why)
        return True

    def _quaternions(self) -> None:
        for group in self._open(4):
            length = np.nanmedian(np.linalg.norm(group.values, axis=1))
            if group.stem == "motor" or not 0.95 < length < 1.05:
                continue
            name = "quat_wb"
            if group.matches("not_vehicle"):
                name = "marker_quat_c" if group.matches("camera") else "payload_quat_wb"
            elif name in self._found and group.matches("estimate"):
                name = "est_quat_wb"
            largest = np.nanmean(np.abs(group.values), 0).argmax()
            order = "xyzw" if _has_letters(group) or largest == 3 else "wxyz"
            why = "four columns of length 1"
            self._take(name, group, "1", why, kind="quaternion", order=order)

    def _find_other_attitudes(self) -> None:
        """Recognise attitudes as rotation matrices, rotation vectors or angles."""
        for group in self._open(9):
            if group.matches("rotation") and not group.matches("not_vehicle"):
                self._take("quat_wb", group, "1", "nine columns of a rotation", kind="matrix")
        for group in self._open(3):
            vector = group.matches("rotvec") and not group.matches("not_vehicle")
            if not vector and not (group.hints_at("euler") and self._smooth(group)):
                continue
            unit = _angle_unit(group)
            kind = "rotvec" if vector else "euler"
            words = "three angles" if vector else "roll, pitch, yaw"
            why = f"{words} up to {group.reach:.3g} {unit}"
            if self._take("quat_wb", group, unit, why, kind=kind) and vector:
                self.questions.append(
                    f"are {group.listed} a rotation vector (Vicon's angle-axis), as assumed, or"
                    ' roll, pitch and yaw (kind = "euler")?'
                )

    def _attitudes(self) -> list[Attitude]:
        """Return all possible readings of the columns of the vehicle's attitude."""
        if "quat_wb" not in self._found:
            return [NO_ATTITUDE]
        entry = self._found["quat_wb"].entry
        group = self._found["quat_wb"].group
        motive = "Format Version" in self.settings
        open_unit = entry.kind == "euler" and not group.unit and entry.unit == "rad"
        open_order = entry.kind == "quaternion" and not _has_letters(group)
        units = ("rad", "deg") if open_unit else (entry.unit,)
        orders = ("wxyz", "xyzw") if open_order else (entry.order,)
        worlds = ("", Y_UP if self.settings else NED)
        readings_of_columns = [(entry.columns, group.values, axes) for axes in worlds]
        named_nose_up = False
        if entry.kind == "euler":
            roll, pitch, yaw = entry.columns
            negated = group.values * [1.0, -1.0, 1.0]
            readings_of_columns.append(((roll, f"-{pitch}", yaw), negated, ""))
            named_nose_up = bool(PATTERNS["nose_up"].search(pitch))
        ways = []
        for unit, order, reading in product(units, orders, readings_of_columns):
            columns, values, axes = reading
            tried = replace(
                entry, columns=columns, unit=unit, order=order, axes=axes, body_axes=axes
            )
            channel = make_channel(self.time, values, tried, "table")[0]
            if not np.any(channel.valid):
                continue
            nose_up = columns != entry.columns
            unusual = (order != entry.order) + (bool(axes) != motive)
            doubt = _UNUSUAL * (unusual + (nose_up != named_nose_up))
            doubt += _TILTED * (physics.median_tilt(channel.samples().values) > physics.STEEPEST)
            doubt += _TILTED * self._leans_by_accelerometers(channel, axes)
            words = [unit] * open_unit + [f"order {order}"] * open_order
            words.append(f"axes {axes or 'x,y,z'}" + " and pitch negated" * nose_up)
            ways.append(Attitude(tried, channel, doubt, ", ".join(words)))
        return ways

    def _leans_by_accelerometers(self, attitude: Channel, axes: str) -> bool:
        """Return whether every accelerometer's mean force, which is vertical over a flight, is
        tilted by this attitude.

        ``axes``: of the body."""
        attitudes = attitude.samples()
        groups = self._find_hints("acc_b")
        for group in groups:
            force_b = self._samples(group)
            turn = matrix_of_quat(attitudes.attitudes(force_b.time))
            force_w = turn @ (force_b.values @ turn_to(axes))[..., None]
            if tilt_deg(force_w.mean(0)[:, 0]) < physics.TURNED:
                return False
        return bool(groups)

    def _positions(self) -> None:
        smooth = [g for g in self._open(3) if self._smooth(g) and g.unit not in ("deg", "rad")]
        groups = [g for g in smooth if g.hints_at("position") or g.unit in LENGTHS]
        unnamed = [g for g in smooth if not any(hint.search(g.stem) for hint in HINTS.values())]
        if not groups and unnamed:  # no name hints at a position
            groups = unnamed
            listed = "; ".join(group.listed for group in groups)
            self.questions.append(f"are these positions? Their names do not tell: {listed}")
        slopes = groups + [g for g in smooth if g.hints_at("velocity")]
        groups = self._drop_derivatives(groups, slopes)
        for group in [g for g in groups if g.matches("camera")]:
            unit = readings(self.time, group.values, _lengths(group), [NO_ATTITUDE])[0].unit
            why = "three columns that move smoothly, named after a camera"
            self._take("marker_pos_c", group, unit, why)
        paths = self._paths([g for g in groups if not g.matches("camera")])
        pay = self._payload(paths, unnamed)
        if pay is not None:
            upper, lower, why = pay
            paths = [path for path in paths if path.group is not lower.group]
        paths.sort(key=lambda path: path.group.matches("load"))
        if pay is not None and upper is not None and not upper.group.matches("estimate"):
            paths.sort(key=lambda path: path is not upper)  # the payload hangs below it
        for path in paths:
            wide = np.nanmax(np.nanstd(path.group.values, axis=0))
            smoothly = f"three columns that move smoothly, by {wide:.3g} {path.unit} (sd)"
            if not self._take_path("pos_w", path, smoothly):
                self._take_path(path.usual_name, path, smoothly)
        if len(paths) > 1:
            listed = "; ".join(path.group.listed for path in paths)
            self.questions.append(
                f"several positions ({listed}): which is the vehicle's, and by which sensor? The"
                " first is taken"
            )
        if pay is not None:
            self._take_path("payload_pos_w", lower, why)

    def _take_path(self, name: str, path: Path, why: str) -> bool:
        """Make a channel of a path; see :meth:`_take`."""
        return self._take(name, path.group, path.unit, why + path.why, axes=self._up())

    def _up(self) -> str:
        """Return the world's axes, as in the attitude."""
        return self._found["quat_wb"].entry.axes if "quat_wb" in self._found else ""

    def _body(self) -> str:
        """Return the axes of measurements on board: an autopilot's if its attitude has them."""
        return NED if self._up() == NED else ""

    def _paths(self, groups: list[Group]) -> list[Path]:
        """Choose the units of paths and the reading of the attitude together, by tilt, free fall
        and the size of a hall; ask about those that remain ambiguous.
        """
        attitudes = self._attitudes()
        ranked = [readings(self.time, group.values, _lengths(group), attitudes) for group in groups]
        alone = [PathReading("", way, way.doubt, "") for way in attitudes]
        deciding = min(ranked, key=lambda listed: listed[0].doubt, default=alone)
        if "quat_wb" in self._found:
            self._settle_attitude(sorted(deciding, key=lambda reading: reading.doubt))
        paths = []
        for group, listed in zip(groups, ranked):
            if listed is not deciding:
                listed = [r for r in listed if r.attitude is deciding[0].attitude]
            best, *others = listed
            rivals = [r.words for r in others if r.doubt < best.doubt + SURE]
            if rivals:
                reach = np.nanmax(np.abs(group.values))
                self.questions.append(
                    f"{group.listed} reach {reach:.3g} from the origin: {best.words} is a guess;"
                    f" {' and '.join(rivals)} would do as well"
                )
            paths.append(self._path(group, best.unit, "" if group.unit else f"; {best.why}"))
        return paths

    def _path(self, group: Group, unit: str, why: str = "") -> Path:
        """Return the path of a group whose columns are in a unit."""
        return Path(group, unit, UNITS[unit][1] * group.values @ turn_to(self._up()), why)

    def _settle_attitude(self, ranked: list[PathReading]) -> None:
        """Take the likeliest reading of the attitude; ask if no path determines it."""
        best, *others = ranked
        rivals = [r for r in others if r.attitude is not best.attitude]
        recognised = self._found["quat_wb"]
        recognised.entry = best.attitude.entry
        recognised.channel = best.attitude.channel
        if not rivals:
            return
        nats = rivals[0].doubt - best.doubt
        if nats >= SURE:
            recognised.why += f"; {best.attitude.words} by gravity, {nats:.0f} nats"
        elif not best.unit:
            listed = " and ".join(r.attitude.words for r in rivals)
            self.questions.append(
                f"attitude {', '.join(best.attitude.entry.columns)}: {best.attitude.words} is a"
                f" guess; {listed} would do as well"
            )

    def _payload(
        self, paths: list[Path], unnamed: list[Group]
    ) -> tuple[Path | None, Path, str] | None:
        """Find the payload: a path, or an unnamed group, at a constant distance below another path.

        Returns the upper path, the payload's path and the reason; the upper one is None if the only
        path is a payload by its name.
        """
        best = None
        rows = slice(None, None, max(1, len(self.time) // _COMPARED))
        nameless = [group for group in unnamed if group not in [path.group for path in paths]]
        for upper in paths:
            for lower in paths + [self._path(group, upper.unit) for group in nameless]:
                gap = lower.pos_w[rows] - upper.pos_w[rows]
                length = np.linalg.norm(gap, axis=1)
                middle = np.nanmedian(length)
                spread = np.nanstd(length) / max(middle, 1e-9)
                hangs = spread < 0.1 and np.nanmedian(gap[:, 2]) < -0.3 * middle
                if 0.05 < middle < 20.0 and hangs and (best is None or spread < best[0]):
                    why = f"keeps {middle:.3f} m from another path, below it"
                    best = spread, upper, lower, why
        if best is not None:
            return best[1:]
        if len(paths) == 1 and PATTERNS["not_vehicle"].search(" ".join(paths[0].group.columns)):
            return None, paths[0], "the only path, whose name is not of a vehicle"
        return None

    def _smooth(self, group: Group) -> bool:
        values = group.values[np.isfinite(group.values).all(1)]
        if len(values) < 50:
            return False
        width = values.std(0).max()
        step = np.diff(values, axis=0).std(0).max()
        return bool(step < 0.3 * width)

    def _drop_derivatives(self, groups: list[Group], paths: list[Group]) -> list[Group]:
        """Return the groups that are no derivative of another path.

        All pairs are compared in one matrix product, because captures may have many markers."""
        grid = np.arange(np.nanmin(self.time), np.nanmax(self.time), _COARSE)
        if not groups or len(grid) < 25:
            return groups
        laid = {g: _interpolate(self._samples(g), grid) for g in groups + paths}
        slopes = [_normalise(np.gradient(laid[path], axis=0)) for path in paths]
        values = [_normalise(laid[group]) for group in groups]
        firm = np.array(slopes) @ np.array(values).T > _FIRMLY
        return [
            group
            for group, column in zip(groups, firm.T)
            if group.unit in LENGTHS  # a length is no velocity, despite a correlation
            or not any(hit and path is not group for hit, path in zip(column, paths))
        ]

    def _samples(self, group: Group) -> Samples:
        return select_rising(self.time, group.values)

    def _best(
        self, derived: Samples, groups: list[Group]
    ) -> tuple[relations.Relation, Group] | None:
        """Return the group that correlates best with a derived signal, and their relation; None if
        none does.
        """
        best = None
        for group in groups:
            relation = relations.relate(derived, self._samples(group), reach=_REACH)
            least = best[0].correlation if best else _BELONGS
            if relation is not None and relation.correlation > least:
                best = relation, group
        return best

    def _velocities(self) -> None:
        for name in ("pos_w", "payload_pos_w", "est_pos_w"):
            if name not in self._found:
                continue
            path = self._found[name]
            slope = self._samples(path.group).derivative(_SPAN)
            best = self._best(slope, [g for g in self._open(3) if g.unit not in LENGTHS])
            in_world = best[0].correlation if best else 0.0
            turned = name == "pos_w" and self._body_velocity(in_world)
            if turned or best is None:
                continue
            relation, group = best
            ratio = relation.scale / UNITS[path.entry.unit][1]
            unit, _ = nearest_unit(ratio, ("m/s", "cm/s", "mm/s"))
            why = f"the derivative of {name}, correlation {relation.correlation:.2f},"
            why += f" {relation.scale:.3g} of its unit a second"
            self._take(name.replace("pos", "vel"), group, unit, why, axes=self._up())

    def _body_velocity(self, in_world: float) -> bool:
        """Make a channel of a velocity in the body's axes, if it follows the path better than one
        in the world's axes.

        ``in_world``: correlation of the best velocity in the world's axes. Returns whether the
        channel was made."""
        if "quat_wb" not in self._found:
            return False
        time, slope = self._found["pos_w"].channel.samples().derivative(_SPAN)
        attitude = self._found["quat_wb"].channel.samples()
        turned = Samples(time, rotate_back(attitude.attitudes(time), slope))
        best = self._best(turned, self._find_hints("velocity"))
        if best is None:
            return False
        relation, group = best
        independent = 0.5 * np.ptp(time) / _REACH
        unlike = max(1.0 - relation.correlation**2, 1e-6)
        nats = independent * np.log((1.0 - in_world**2) / unlike)
        if nats < SURE or relation.correlation < _FIRMLY:
            return False
        unit = group.unit if group.unit.endswith("/s") else "m/s"
        why = f"the derivative of pos_w in the body's axes, {nats:.0f} nats over the world's"
        return self._take("vel_b", group, unit, why)

    def _rates(self) -> None:
        groups = self._find_hints("rate_b")
        if not groups:
            return
        derived = Samples(np.empty(0), np.empty((0, 3)))
        if "quat_wb" in self._found:
            derived = self._found["quat_wb"].channel.samples().rates()
        related = [relations.relate(derived, self._samples(g), reach=_REACH) for g in groups]
        scores = [0.0 if r is None else r.axes_correlation for r in related]
        score = max(scores)
        group = groups[scores.index(score)]
        why = f"99 % within {group.reach:.3g}"
        guess = "deg/s" if group.reach > 30.0 else "rad/s"
        unit = NAMES["usual_units"].get(group.columns[0], guess)
        unit = group.unit if group.unit.endswith("/s") else unit
        if score > _BELONGS:
            times = _size(self._samples(group)) / max(_size(derived), 1e-6)
            unit = "deg/s" if times > 7.0 else "rad/s"
            why = f"the rates of the attitude, correlation {score:.2f}, ratio {times:.3g}"
        elif not group.unit:
            self.questions.append(
                f"are the rates {group.listed} in rad/s or deg/s? '{unit}' is assumed, without an"
                " attitude to compare with"
            )
        self._take("rate_b", group, unit, why, axes=self._body())

    def _forces(self) -> None:
        for group in self._find_hints("acc_b"):
            size = np.nanmedian(np.linalg.norm(group.values, axis=1))
            for unit in fitting_units(size / physics.GRAVITY, ("m/s^2", "g", "mg"), 0.8, 1.25):
                why = f"a median norm of {size:.3g}: gravity in {unit}"
                self._take("acc_b", group, unit, why, axes=self._body())

    def _motors(self) -> None:
        order = "front left, front right, rear left, rear right"
        for group in [g for g in self._open(4) if g.stem == "motor"]:
            high = np.nanpercentile(group.values, 99)
            words = " ".join(group.columns)
            if group.unit in ("rpm", "rad/s") or PATTERNS["speed"].search(words):
                unit = group.unit or ("rpm" if "rpm" in words.lower() else "rad/s")
                why = f"four rotors' speeds up to {high:.5g} {unit}"
                self._take("motor_speed", group, unit, why)
                self.questions.append(
                    f"rotors {group.listed}: order them {order}; are they electrical revolutions"
                    " (divide by pole pairs)?"
                )
                continue
            unit = next(unit for above, unit in _MOTOR_UNITS if high > above)
            why = f"four motors up to {high:.5g}"
            offset = 0.0
            turning = group.values[group.values > 0.0]
            pulses = high < _LARGEST_PULSE and len(turning) > 0
            if pulses and np.percentile(turning, 1) > _LEAST_PULSE:
                why += f": pulses in us, {IDLE_PULSE:.0f} for a stopped motor"
                offset = -IDLE_PULSE
            if self._take("motor_command", group, unit, why, offset=offset):
                self.questions.append(
                    f"motors {group.listed}: order them {order} (Crazyflie: 4, 1, 3, 2; Betaflight:"
                    " 4, 2, 3, 1; PX4: 3, 1, 2, 4). Are they commands, or speeds?"
                )

    def _single_columns(self) -> None:
        for group in self._open(1):
            if group.matches("battery"):
                units = (group.unit,) if group.unit in ("V", "mV") else ("V", "cV", "mV")
                for unit in fitting_units(group.middle, units, *_PACK):
                    why = f"a median of {group.middle:.4g}: a battery in {unit}"
                    self._take("battery_voltage", group, unit, why)
            elif group.matches("angle") and "quat_wb" not in self._found:
                unit = _angle_unit(group)
                why = f"an angle, by its name; a median of {group.middle:.3g}"
                if self._take("angle", group, unit, why) and not group.unit:
                    self.questions.append(
                        f"angle '{group.stem}': deg or rad? '{unit}' is assumed, by its range"
                    )

    def _thrust(self) -> None:
        """Recognise the collective thrust.

        Commands have priority, and words over letters, since "t" may be a temperature."""
        groups = []
        for group in self._open(1, targets=True):
            if PATTERNS["thrust"].search(split_unit(group.stem)[0]):
                groups.append(group)
        groups.sort(key=lambda group: (len(group.stem) == 1, not group.matches("target")))
        for group in groups:
            if group.middle <= _LARGEST_THRUST and not rises(group.values[:, 0]):
                unit = group.unit if group.unit in THRUSTS else "N"
                self._take("thrust_command", group, unit, f"a median of {group.middle:.4g}")

    def _ask_what_is_open(self) -> None:
        known = self._found.keys()
        columns = [column for group in self._groups for column in group.columns]
        outputs = [c for c in columns if PATTERNS["motor"].match(split_unit(c)[0])]
        if len(outputs) > 4 and not known & {"motor_command", "motor_speed"}:
            self.questions.append(
                f"which four of {', '.join(outputs)} are the motors? None is used"
            )
        if "quat_wb" in known and not known & {"pos_w", "rate_b"}:
            attitude = self._found["quat_wb"]
            if attitude.entry.kind == "euler" and not attitude.group.unit:
                self.questions.append(
                    f"are {attitude.group.listed} angles, as assumed, or body rates? The motion"
                    " does not tell"
                )
        if "pos_w" in known and not known & _MOTIONS:
            self.questions.append(
                "only pos_w moves: if it is a payload or a ball, rename it to payload_pos_w"
            )
        for group in [g for g in self._open(1) if g.matches("split")]:
            values = np.unique(group.values[np.isfinite(group.values)])
            if 1 < len(values) <= 64 and np.all(values == np.round(values)):
                self.questions.append(
                    f"'{group.stem}' has {len(values)} values: one log for each? [table.split]"
                    f' column = "{group.stem}"'
                )


def _lengths(group: Group) -> tuple[str, ...]:
    """Return the units that a path may have: the named one, or all."""
    return (group.unit,) if group.unit in LENGTHS else LENGTHS


def _angle_unit(group: Group) -> str:
    """Return the unit of angles: the named one, else by their range."""
    if group.unit in ("deg", "rad"):
        return group.unit
    return "deg" if group.reach > _TURN else "rad"


def _has_letters(group: Group) -> bool:
    """Return whether the names of a quaternion's columns state which is w."""
    return any("w" in split_unit(column)[0].lower()[-3:] for column in group.columns)


def _normalise(values: ndarray) -> ndarray:
    """Return values minus their column's mean, as one vector of length 1; zeros if all are
    constant.
    """
    centred = (values - values.mean(0)).ravel()
    return centred / max(np.linalg.norm(centred), 1e-300)


def _interpolate(samples: Samples, grid: ndarray) -> ndarray:
    """Return a group's values at the times of a grid; zeros if it has fewer than 100 samples."""
    if len(samples.time) < 100:
        return np.zeros((len(grid), 3))
    return samples.at(grid)


def _size(samples: Samples) -> float:
    """Return the root mean square about the means of the columns."""
    return np.sqrt(samples.values.var(0).mean())
