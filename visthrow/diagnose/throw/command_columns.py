"""Commands that did not come: what a window would have shown had the command before stayed for one
period more.

A radio link loses commands or brings them late, and the vehicle goes on with what it has; the log
holds what was sent. Each window is flown once for each of its commands, with the one before in its
place."""

from collections.abc import Mapping, Sequence

from numpy import ndarray

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
) -> list[ndarray]:
    """Change of windows' samples by each of their commands that the one before takes the place of.

    ``windows``: their numbers; ``delay``: of the commands [s], the same in all settings: it says
    which of them act in a window; ``simulation``: of one setting. Returns for each of these
    windows, shape (N, T), with the T commands that differ from the one before.
    """
    commands = {}
    for w in windows:
        c = flights.cuts[w]
        f = flights.flights[c.flight]
        commands[w] = find_acting(f.command_time, f.command, delay, c.start, c.end)
    lanes = [1 + len(numbers) for numbers in commands.values()]
    columns = []
    for part in grouped(windows, lanes, BATCH):
        columns += _flown(flights, {w: commands[w] for w in part}, simulation, states)
    return columns


def _flown(
    flights: ReplayedFlights,
    commands: Mapping[int, ndarray],
    simulation: Simulation,
    states: States,
) -> list[ndarray]:
    """Fly a few windows: a lane with all commands, then one without each of them, which leaves the
    first at the knot before.
    """
    (setting,) = simulation.settings
    lanes: list[Lane] = []
    parents = []
    first_knot = 0
    for w, numbers in commands.items():
        flight = flights.cuts[w].flight
        acts = flights.flights[flight].command_time[numbers] + setting.plant.vehicle.queue.delay
        last = flights.knots[w] - 2  # behind it is the end
        before = (acts - flights.cuts[w].start) // KNOT_SPACING
        knot = before.clip(0, last).astype(int)
        parent = len(lanes)
        parents.append(parent)
        lanes.append(Lane(w, 0, w, keep=first_knot, rough=True))
        for row, number in zip(first_knot + knot, flights.first_command[flight] + numbers):
            lanes.append(Lane(w, 0, w, resume=row, parent=parent, rough=True, skip=number))
        first_knot += int(flights.knots[w])
    seen = flights.fly(simulation, states, lanes).seen
    columns = []
    for parent, (w, numbers) in zip(parents, commands.items()):
        columns.append(flights.differences(seen, w, parent, len(numbers)))
    return columns
