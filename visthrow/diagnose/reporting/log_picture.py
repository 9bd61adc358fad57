"""A picture of a log: its channels over time with gaps, and the verdict on each."""

from pathlib import Path

import numpy as np

from visthrow.common.storage import atomic_write
from visthrow.logs.check.rows import worst
from visthrow.logs.check.run import Checked
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.view import style
from visthrow.view.parts import png_of

CHANNELS_DRAWN = 10  # largest number of channels in a picture
_FIRST = (
    "pos_w",
    "vel_w",
    "quat_wb",
    "rate_b",
    "acc_b",
    "payload_pos_w",
    "command",
    "motor_command",
    "battery_voltage",
)
_POINTS = 4000
_SHADE = {"ok": style.COLOURS[2], "warn": style.COLOURS[4], "bad": style.COLOURS[1]}


def draw(log: FlightLog, checked: Checked, path: str | Path) -> None:
    """Draw the channels of a checked log and write the picture."""
    ordered = dict.fromkeys((*_FIRST, *log.channels))
    names = [name for name in ordered if name in log and len(log[name].time) > 1][:CHANNELS_DRAWN]
    rows = max(len(names), 1)
    size = (9, 1.1 + 1.25 * rows)
    figure, axes = style.subplots(rows, 1, size, sharex=True, layout=None)
    for axis, name in zip(axes[:, 0], names):
        _channel(axis, log[name])
        concern = [row for row in checked.rows if name in row.channel.replace(",", " ").split()]
        label = f"{name}\n[{log[name].unit}]"
        axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
        axis.spines["left"].set(color=_SHADE[worst(concern)], linewidth=4)
    axes[-1, 0].set_xlabel("time [s]")
    legend = "left bar: green ok, yellow warn, red bad; x, y, z: blue, red, green"
    axes[0, 0].set_title(f"{checked.name}: {checked.verdict} ({legend})", loc="left", fontsize=10)
    figure.tight_layout()
    atomic_write(path, png_of(figure))


def _channel(axis, channel: Channel) -> None:
    step = max(1, len(channel.time) // _POINTS)
    valid = channel.valid[:, None]
    values = np.where(valid, channel.rows, np.nan)[::step]
    time = channel.time[::step]
    periods = np.diff(time)
    gaps = np.flatnonzero(periods > 5 * np.median(periods)) + 1
    values = np.insert(values, gaps, np.nan, axis=0)
    time = np.insert(time, gaps, np.nan)
    for column, colour in zip(values.T[:4], style.COLOURS):
        axis.plot(time, column, lw=0.8, color=colour)
    axis.grid(True, axis="y")
    axis.tick_params(labelsize=8)
