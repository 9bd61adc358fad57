"""The mapping file: for each channel, the table's columns, their unit, axes and clock."""

from dataclasses import dataclass, field, replace
from typing import Literal

from visthrow.common.errors import ConfigError, suggest
from visthrow.config.bounds import Bounded, NotNegative
from visthrow.logs.axes import turn_of
from visthrow.logs.flightlog import FRAMES, STANDARD_CHANNELS
from visthrow.logs.unit_names import to_si

_WIDTH = {"quaternion": 4, "euler": 3, "rotvec": 3, "matrix": 9}
"""Kind of an attitude -> number of its columns."""
_KINDS = (*_WIDTH, "vector")
_ORDERS = ("xyzw", "wxyz")


@dataclass(frozen=True)
class TimeColumn(Bounded):
    """A clock: a column of time stamps, or evenly spaced rows.

    Raises ConfigError: neither or both are given, or the unit is not one of time.
    """

    column: str = ""  # of the stamps; "": rows are evenly spaced
    unit: str = "s"  # of the stamps
    row_period: NotNegative = 0.0  # time between two rows [s], if there is no column
    # added to the times [s], for streams with different clocks; `diagnose check` reports the value
    offset: float = 0.0
    # file name -> offset that is added to the times of that flight only [s]
    offsets: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.column) == (self.row_period > 0.0):
            raise ConfigError("time: give either a column or a row_period above 0 s")
        if to_si(self.unit, "time")[0] != "s":
            raise ConfigError(f"time: unit '{self.unit}'; expected a unit of time")


@dataclass(frozen=True)
class ChannelMap(Bounded):
    """Columns of one channel.

    Raises ConfigError: a kind, order, unit, frame, number of columns or order of axes that the
    channel cannot have.
    """

    # of the channel: one of visthrow.logs.flightlog.STANDARD_CHANNELS, or any other
    name: str
    columns: tuple[str, ...]  # "-pitch": the column "pitch", negated
    unit: str  # of the columns
    # euler: roll, pitch, yaw; the yaw rotation comes first. rotvec: axis times angle. matrix: nine
    # numbers, column by column
    kind: Literal["vector", "quaternion", "euler", "rotvec", "matrix"] = "vector"
    order: Literal["xyzw", "wxyz"] = "xyzw"  # of a quaternion's columns
    # our x, y, z in the source's axes, such as "x,-y,-z" for north-east-down; "": unchanged
    axes: str = ""
    body_axes: str = ""  # of an attitude: our body's x, y, z in the source's body axes
    frame: str = ""  # of a channel without a standard name; "": none
    scale: float = 1.0  # factor on the column, applied before the unit
    offset: float = 0.0  # added after the factor, in the column's unit
    # the table repeats the last value between measurements; repetitions are removed
    held: bool = False
    clock: str = ""  # name of a further clock of the mapping; "": the main one

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"channel '{self.name}'"
        to_si(self.unit, where)
        if not self.columns:
            raise ConfigError(f"{where}: no columns")
        # the loader checks these words, but not if a program creates the object
        for what, word, known in (("kind", self.kind, _KINDS), ("order", self.order, _ORDERS)):
            if word not in known:
                raise ConfigError(f"{where}: {what} '{word}'; {suggest(word, known)}")
        count = len(self.columns)
        width = _WIDTH.get(self.kind, count)
        if count != width:
            raise ConfigError(f"{where}: {self.kind} of {count} columns; expected {width}")
        if self.frame and self.frame not in FRAMES:
            raise ConfigError(f"{where}: frame '{self.frame}'; {suggest(self.frame, FRAMES)}")
        for axes in (self.axes, self.body_axes):
            if axes:
                try:
                    turn_of(axes)
                except ValueError as error:
                    raise ConfigError(f"{where}: {error}") from error
        spec = STANDARD_CHANNELS.get(self.name)
        if spec is None:
            return
        ours = "1" if self.kind != "vector" else to_si(self.unit, where)[0]
        if ours not in spec.unit.split(", "):
            kinds = f"; expected kind, one of {', '.join(_KINDS)}" if "quat" in self.name else ""
            raise ConfigError(
                f"{where}: unit '{self.unit}' is of the kind '{ours}'; the channel is in"
                f" '{spec.unit}'{kinds}"
            )


@dataclass(frozen=True)
class Split(Bounded):
    """The rule that splits one table into several logs."""

    column: str = ""  # each of its values makes a log; "": one log
    gap: NotNegative = 0.0  # shortest time without rows at which a new log begins [s]; 0: never
    shortest: NotNegative = 0.0  # shorter logs are dropped [s]


@dataclass(frozen=True)
class TableMap:
    """Mapping of a table's columns to channels.

    Raises ConfigError: two channels have the same name, or a clock is not defined.
    """

    time: TimeColumn
    channels: tuple[ChannelMap, ...]
    clocks: dict[str, TimeColumn] | None = None  # further clocks, by name
    split: Split | None = None

    def __post_init__(self) -> None:
        names: set[str] = set()
        for channel in self.channels:
            if channel.name in names:
                raise ConfigError(f"channel '{channel.name}' is mapped twice")
            names.add(channel.name)
            if channel.clock and channel.clock not in (self.clocks or {}):
                hint = suggest(channel.clock, self.clocks or {})
                raise ConfigError(f"channel '{channel.name}': no clock '{channel.clock}'; {hint}")

    @property
    def columns(self) -> set[str]:
        """Names of the columns that clocks and channels use."""
        clocks = [self.time, *(self.clocks or {}).values()]
        channels = [c.removeprefix("-") for channel in self.channels for c in channel.columns]
        return {clock.column for clock in clocks} | set(channels)

    def entry(self, name: str) -> ChannelMap | None:
        """Return the mapping of a channel; None if there is none."""
        return next((channel for channel in self.channels if channel.name == name), None)

    def with_entry(self, entry: ChannelMap) -> "TableMap":
        """Return a copy in which an entry replaces the one of the same name."""
        channels = [entry if c.name == entry.name else c for c in self.channels]
        return replace(self, channels=tuple(channels))
