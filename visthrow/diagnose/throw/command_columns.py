"""Commands that did not come: what a window would have shown had the command before stayed for one
period more.

A radio link loses commands or brings them late, and the vehicle goes on with what it has; the log
holds what was sent. Each window is flown once for each of its commands, with the one before in its
place."""

from collections.abc import Mapping, Sequence

import numpy as np

from visthrow.diagnose.models.quadrotor.flyer_windows import find_acting
from visthrow.diagnose.throw.initial_states import States
from visthrow.diagnose.throw.replay import (
    BATCH,
    KNOT_SPACING,
    Lane,
    ReplayedFlights,
    Simulation,
    grouped,
)


def without_each_command(
    flights: ReplayedFlights,
    windows: Sequence[int],
    delay: float,
    simulation: Simulation,
    states: States,
) -> list[np.ndarray]:
    """Change of windows' samples by each of their commands that the one before takes the place of.

    ``windows``: their numbers; ``delay``: of the commands [s], the same in all settings: it says
    which of them act in a window; ``simulation``: of one setting. Returns for each of these
    windows, shape (N, T), with the T commands that differ from the one before.
    """
    commands = {w: _acting(flights, w, delay) for w in windows}
    lanes = [1 + len(numbers) for numbers in commands.values()]
    columns = []
    for part in grouped(windows, lanes, BATCH):
        columns += _flown(flights, {w: commands[w] for w in part}, simulation, states)
    return columns


def _acting(flights: ReplayedFlights, w: int, delay: float) -> np.ndarray:
    """Numbers of the commands that act in a window and differ from the one before."""
    c = flights.cuts[w]
    f = flights.flights[c.flight]
    return find_acting(f.command_time, f.command, delay, c.start, c.end)


def _flown(
    flights: ReplayedFlights,
    commands: Mapping[int, np.ndarray],
    simulation: Simulation,
    states: States,
) -> list[np.ndarray]:
    """Fly a few windows: a lane with all commands, then one without each of them, which leaves the
    first at the knot before.
    """
    lanes = []
    first = {}
    rows_kept = 0
    for w, numbers in commands.items():
        c = flights.cuts[w]
        acts = flights.flights[c.flight].command_time[numbers]
        acts = acts + simulation.settings[0].plant.vehicle.queue.delay
        last = flights.knots[w] - 2  # behind it is the end
        resume = rows_kept + np.clip((acts - c.start) // KNOT_SPACING, 0, last).astype(int)
        skip = flights.first_command[c.flight] + numbers
        whole = first[w] = len(lanes)
        lanes.append(Lane(w, 0, w, keep=rows_kept, rough=True))
        lanes += [
            Lane(w, 0, w, resume=row, parent=whole, rough=True, skip=number)
            for row, number in zip(resume, skip)
        ]
        rows_kept += int(flights.knots[w])
    seen = flights.fly(simulation, states, lanes).seen
    return [flights.differences(seen, w, first[w], len(commands[w])) for w in commands]
