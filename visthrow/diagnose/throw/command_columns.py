"""Commands that did not come: what a window would have shown had the command before stayed for one
period more.

A radio link loses commands or brings them late, and the vehicle goes on with what it has; the log
holds what was sent. Each window is flown once for each of its commands, with the one before in its
place."""

from collections.abc import Sequence

import numpy as np

from sim.kernels.replay.lanes import Recording
from visthrow.diagnose.throw.initial_states import States
from visthrow.diagnose.throw.replay import BATCH, KNOT_SPACING, Lane, ReplayedFlights, Simulation


def without_each_command(
    flights: ReplayedFlights,
    windows: Sequence[int],
    count: float,
    simulation: Simulation,
    states: States,
) -> list[np.ndarray]:
    """Change of windows' samples by each of their commands that the one before takes the place of.

    ``windows``: their numbers; ``count``: delay of the commands by which those that act in a window
    are told [s]: their number is the same in all settings; ``simulation``: of one setting. Returns
    for each of these windows, shape (N, T), with the T commands that differ from the one before.
    """
    commands = [_acting(flights, w, count) for w in windows]
    columns = []
    first = 0
    while first < len(windows):
        fits = int(
            np.searchsorted(
                np.cumsum([1 + len(command_times) for command_times in commands[first:]]),
                BATCH,
                "right",
            )
        )
        part = slice(first, first + max(fits, 1))
        columns += _flown(flights, windows[part], commands[part], simulation, states)
        first = part.stop
    return columns


def _acting(flights: ReplayedFlights, w: int, delay: float) -> np.ndarray:
    """Numbers of the commands that act in a window and differ from the one before."""
    c = flights.cuts[w]
    f = flights.flights[flights.cuts[w].flight]
    acts = f.command_time + delay
    during = (np.append(acts[1:], np.inf) > c.start) & (acts < c.end)
    changed = np.append(False, np.any(np.diff(f.command, axis=0) != 0.0, axis=1))
    return np.flatnonzero(during & changed)


def _flown(
    flights: ReplayedFlights,
    windows: Sequence[int],
    commands: Sequence[np.ndarray],
    simulation: Simulation,
    states: States,
) -> list[np.ndarray]:
    """Fly a few windows: a lane with all commands, then one without each of them, which leaves the
    first at the knot before.
    """
    lanes = []
    times = []
    sent = []
    run = []
    rows_kept = 0
    for w, command_times in zip(windows, commands):
        f = flights.flights[flights.cuts[w].flight]
        part = slice(
            max(command_times.min(initial=1) - 1, 0),
            command_times.max(initial=len(f.command_time) - 2) + 2,
        )
        acts = f.command_time[command_times] + simulation.settings[0].plant.vehicle.queue.delay
        knots = np.clip(
            (acts - flights.cuts[w].start) // KNOT_SPACING, 0, flights.knots[w] - 2
        ).astype(int)  # the last is the end
        whole = len(lanes)
        run.append(Lane(whole, 0, w, keep=rows_kept, rough=True))
        run += [
            Lane(whole + 1 + i, 0, w, resume=rows_kept + int(knot), parent=whole, rough=True)
            for i, knot in enumerate(knots)
        ]
        rows_kept += int(flights.knots[w])
        for k in (None, *command_times.tolist()):
            flown = f.command[part].copy()
            if k is not None:
                flown[k - part.start] = f.command[k - 1]
            lanes.append(w)
            times.append(f.command_time[part])
            sent.append(flown)
    ends = np.cumsum([len(command_times) for command_times in times])
    lane_table = np.array(lanes)
    fields = {name: values[lane_table] for name, values in flights.recording.windows.items()}
    fields |= {"command_first": np.append(0, ends[:-1]), "command_last": ends}
    data = flights.recording.data | {
        "command_time": np.concatenate(times),
        "command": np.concatenate(sent),
    }
    measured = (
        flights.repeated(lane_table).fly(simulation, states, run, Recording(fields, data)).seen
    )
    columns = []
    first = 0
    for w, command_times in zip(windows, commands):
        part = measured[: int(flights.rows[w]), first : first + len(command_times) + 1]
        columns.append(np.moveaxis(part[:, 1:] - part[:, :1], 1, 2).reshape(-1, len(command_times)))
        first += len(command_times) + 1
    return columns
