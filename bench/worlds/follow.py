"""A proposed manoeuvre flown in a world: a reference table, what it adds to the commands, and the
record of that flight.
"""

import csv
import io
from dataclasses import dataclass, replace

import numpy as np

from bench.worlds.fly import fly
from bench.worlds.numbers import hide
from bench.worlds.pilot import Tracker
from bench.worlds.world import GUSTS, Recipe, build_world, record_flights

ALONE = 1.5
"""Before a flight without payload: it drops, and the vehicle comes to rest [s]."""


@dataclass(frozen=True)
class Table:
    """Rows of a reference, 50 a second; the first row is held until ``begin``."""

    place: np.ndarray  # [m], shape (N, 3)
    speed: np.ndarray  # [m/s], shape (N, 3)
    yaw: np.ndarray  # [rad], shape (N,)
    added: np.ndarray  # to the commanded rates [rad/s], shape (N, 3)
    factor: np.ndarray  # on the commanded thrust, shape (N,)
    release_command: np.ndarray  # shape (N,)
    payload: bool = True

    @property
    def begin(self) -> float:
        """When the first row is flown [s]."""
        return 0.0 if self.payload else ALONE

    @property
    def seconds(self) -> float:
        """Of the whole flight."""
        return self.begin + 0.02 * len(self.yaw)

    @property
    def release(self) -> float:
        """When the release is commanded [s]; infinite where it is not."""
        rows = np.flatnonzero(self.release_command > 0.5)
        if not self.payload:
            return 0.0
        return self.begin + 0.02 * rows[0] if len(rows) else np.inf

    def row(self, t: float) -> int:
        """Of a time."""
        return int(np.clip(round((t - self.begin) / 0.02), 0, len(self.yaw) - 1))

    def at(self, t: float):
        """Place, speed, acceleration and heading at a time."""
        i = self.row(t)
        last = min(i + 1, len(self.yaw) - 1)
        push = (self.speed[last] - self.speed[max(i - 1, 0)]) / (
            0.02 * max(last - max(i - 1, 0), 1)
        )
        return self.place[i], self.speed[i], push, self.yaw[i]


def table_of(text: str, payload: bool) -> Table:
    """Read a reference from CSV with units in its header."""
    rows = list(csv.reader(io.StringIO(text)))
    names = [name.split(" [")[0] for name in rows[0]]
    value = dict(zip(names, np.array(rows[1:], dtype=float).T))
    columns = [
        np.column_stack([value[name] for name in group])
        for group in (
            ("x_w", "y_w", "z_w"),
            ("vx_w", "vy_w", "vz_w"),
            ("added rate_x_b", "added rate_y_b", "added rate_z_b"),
        )
    ]
    return Table(
        columns[0],
        columns[1],
        value["yaw"],
        columns[2],
        value["thrust factor"],
        value["release"],
        payload,
    )


class Follower(Tracker):
    """The tracking pilot with lower gains, so that a vehicle without payload stays calm; it adds
    the table's rates and thrust.

    An integral corrects the height for the air's and the battery's effects on the thrust, as any
    autopilot's does."""

    gains = 2.0, 2.4, 4.5
    patience = 1.0
    lead = 0.0  # accelerations of a table are too rough to derive body rates

    def command(self, t: float, x, v, q, hanging) -> np.ndarray:
        """See :meth:`bench.worlds.pilot.Tracker.command`."""
        out = super().command(t, x, v, q, hanging)
        for row, table in zip(out, self.references):
            i = table.row(t)
            row[0] *= table.factor[i]
            row[1:] += table.added[i]
        return out


def follow(recipe: Recipe, tables: list[Table], seed: int) -> list[dict]:
    """Fly tables in a world, all of them in step, and record each as
    :func:`bench.worlds.world.record_flights` does.

    A flight without payload drops it first; its record begins afterwards and shows neither payload
    nor release."""
    rng = np.random.default_rng([recipe.seed, seed])
    known = hide({})
    pilot = Follower(tables, known.mass, known.ball_mass + known.rope_mass, rng)
    flown = fly(
        recipe.plant,
        [build_world(recipe)] * len(tables),
        pilot.command,
        tables,
        max(t.seconds for t in tables),
        [recipe.gusts * g for g in GUSTS],
        int(rng.integers(2**31)),
        rng.uniform(0.0, 0.4, len(tables)),
    )
    out = record_flights(replace(recipe, seed=int(rng.integers(2**31))), [flown])
    return [_trim(record, table) for record, table in zip(out, tables)]


def _trim(record: dict, table: Table) -> dict:
    in_window = (record["time"] >= table.begin) & (record["time"] < table.seconds)
    sent = (record["sent_time"] >= table.begin - 1e-9) & (
        record["sent_time"] < table.seconds - 1e-9
    )
    record = record | {name: record[name][in_window] for name in ("time", "pos", "quat", "ball")}
    record |= {name: record[name][sent] for name in ("sent_time", "sent", "volt")}
    return (
        record
        if table.payload
        else record | {"ball": np.full_like(record["ball"], np.nan), "release": None}
    )
