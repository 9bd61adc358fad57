"""The paper's ablations as hidden defects: a model that lacks a block is compared with flights of a
plant that has it.

The shipped policy throws on the reference plant, which has every block. The same flights are
diagnosed with four models, each without one block. The diagnosis must name that block. Nothing is
trained. Throws that the diagnosis did not use measure what the name gains.

    python -m bench.ablations                 all four; minutes on two cores
    python -m bench.ablations no_motor_lag    one of them
    python -m bench.ablations --show          the committed record
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench import start
from bench.loop import PLANT, add_arguments, explain_logs, named_sizes, record_flight
from visthrow.common.compute_device import resolve
from visthrow.common.errors import DiagnoseError
from visthrow.common.storage import write_json
from visthrow.logs.flightlog import FlightLog, FlightRecorder
from visthrow.task import load_experiment, plant_of
from visthrow.throws.flight_loop import Decision, Flight, FlightObserver, Phase, Policies, hover
from visthrow.throws.loading import Loaded, load_policy
from visthrow.throws.plants import Snapshot, make_plant
from visthrow.throws.reference_protocol import place_in_hover

POSES = ("pos_w", "quat_wb", "payload_pos_w")  # channels that are recorded

LACKS = {
    "no_aerodynamics": "aerodynamics",
    "no_motor_lag": "motor_lag",
    "simple_controller": "controller_kind",
    "rigid_cable": "rope_flexible",
}
"""Ablation, as in ``configs/train/state_NAME.toml`` -> the entry of the catalogue that gives the
block back.
"""

COMMITTED = Path(__file__).parent / "loops" / "ablations" / "record.json"
"""The committed record of the last round."""

SETTLED = 2.4
AFTERWARDS = 0.7
"""Hover before the policy takes over, of which a log keeps the last part; flown on after the last
landing [s].
"""

NEAR = 1.0
FAR = 1.9
"""Distances of the targets, which lie all around [m]."""


@dataclass(frozen=True)
class Ablations:
    """One round over models that lack a block.

    Attributes:
        folder: of flights, verdicts and the record; existing files are kept.
        names: of :data:`LACKS`.
        policy: shipped name or file.
        flights: to be diagnosed.
        held: further throws, held out from the diagnosis.
        device: of the diagnosis.
    """

    folder: Path
    names: Sequence[str] = tuple(LACKS)
    policy: str = "state"
    flights: int = 12
    held: int = 3
    device: str = "cpu"

    def run(self, say: Callable[[str], None]) -> dict[str, Any]:
        """Fly, diagnose with each model, compare on the held-out throws; returns the record.

        Raises:
            DiagnoseError: An ablation that does not exist.
        """
        strange = [name for name in self.names if name not in LACKS]
        if strange:
            raise DiagnoseError(f"no ablation {', '.join(strange)}; there are {', '.join(LACKS)}")
        logs = self._fly_throws(say)
        results = [
            self._one(name, logs, lambda line, name=name: say(f"{name}: {line}"))
            for name in self.names
        ]
        record = {
            "policy": self.policy,
            "flights": self.flights,
            "held": self.held,
            "ablations": results,
        }
        write_json(self.folder / "record.json", record)
        return record

    def _fly_throws(self, say: Callable[[str], None]) -> list[Path]:
        """Logs of throws at targets all around, by the policy as it was trained, on the plant that
        has everything.

        Logs of the held-out throws hold their landing points.
        """
        count = self.flights + self.held
        paths = [self.folder / "flights" / f"flight_{i:02d}.npz" for i in range(count)]
        if all(path.exists() for path in paths):
            return paths
        rng = np.random.default_rng(0)
        angle = rng.uniform(-np.pi, np.pi, count)
        distance = rng.uniform(NEAR, FAR, count)
        goals = np.column_stack(
            (distance * np.cos(angle), distance * np.sin(angle), np.zeros(count))
        )
        for i, (path, log) in enumerate(
            zip(paths, throws(load_policy(self.policy), PLANT, goals, 0))
        ):
            recording = record_flight(log, np.random.default_rng(i))
            landing = {"landing": log["landing"]} if i >= self.flights else {}
            FlightLog({**recording.channels, **landing}, recording.meta).save(path)
        say(f"flown: {count}")
        return paths

    def _one(self, name: str, logs: Sequence[Path], say: Callable[[str], None]) -> dict[str, Any]:
        base = f"state_{name}"
        subfolder = self.folder / name
        subfolder.mkdir(parents=True, exist_ok=True)
        verdict = explain_logs(
            logs[: self.flights], base, subfolder / "verdict.json", self.device, say
        )
        theta = named_sizes(verdict)
        findings = verdict.get("findings", ())
        record = {
            "model": base,
            "lacks": LACKS[name],
            "overall": verdict["overall"],
            "named": theta,
        }
        record |= {
            "seconds": verdict.get("seconds"),
            "reasons": verdict.get("reasons", []),
            "threshold": verdict.get("threshold"),
        }
        record["nats"] = {f["name"]: f["nats"] for f in findings if f["name"] in theta}
        kept = subfolder / "held.json"
        if not kept.exists():
            write_json(
                kept, measure_held_back(base, theta, LACKS[name], logs[self.flights :], self.device)
            )
            say("weighed on the throws that were held back")
        return record | {"held": json.loads(kept.read_text())}


class FlightLogs(FlightObserver):
    """A recorder of each vehicle: poses and commands at the beginning of each period."""

    def __init__(self, count: int, meta: dict[str, Any]) -> None:
        self.recorders = [FlightRecorder(meta) for _ in range(count)]

    def before(self, flight: Flight, snapshot: Snapshot, sent: Decision) -> None:
        state = flight.now
        for e, recorder in enumerate(self.recorders):
            poses = {name: getattr(state, name)[e] for name in POSES}
            recorder.add(state.time, **poses)
            release = float(sent.release[e])
            recorder.add(state.time, command=sent.command[e], release_command=release)


def throws(loaded: Loaded, plant_name: str, goals_w: np.ndarray, seed: int) -> list[FlightLog]:
    """Throw at goals, one vehicle each, side by side: one vehicle costs nearly as much as thirty.

    All hover for the same time first; :func:`visthrow.throws.recorded.fly` waits for the swing to
    become quiet.

    Args:
        loaded: policy and experiment, whose plant it is.
        plant_name: of :data:`visthrow.throws.plants.PLANTS`.
        goals_w: on the ground [m], shape (E, 3).
        seed: of plant and starts.

    Returns:
        A log each with poses, commands, the release's command and the landing; ``meta["times"]`` as
        of that function.

    Raises:
        DiagnoseError: A throw failed.
    """
    plant = make_plant(plant_name, loaded.experiment, len(goals_w), seed)
    rng = np.random.default_rng(seed)
    home = place_in_hover(plant, loaded.experiment, rng)
    meta = {"policy": loaded.name, "plant": plant.name}
    recording = FlightLogs(len(goals_w), meta)
    flight = Flight(plant, Policies([loaded], goals_w), recording, home)
    landed = 0

    def is_over(flight: Flight) -> bool:
        nonlocal landed
        landed += not flight.open.any()
        return landed > round(AFTERWARDS / plant.period) or bool(flight.failed.any())

    flight.run([hover(SETTLED), Phase(True, is_over)])
    if flight.failed.any():
        raise DiagnoseError(
            f"throws {np.flatnonzero(flight.failed)} did not come down"
            f" ({', '.join({c for c in flight.failures if c})}); can the policy fly this plant?"
        )
    landing = plant.landing
    end = plant.time - plant.period
    for recorder, point, when in zip(recording.recorders, landing.point_w, landing.time):
        recorder.add(float(when), landing=point)
        recorder.meta["times"] = {"policy_start": flight.begin, "landing": float(when), "end": end}
    return [recorder.log() for recorder in recording.recorders]


def measure_held_back(
    base: str, theta: Mapping[str, float], lacks: str, logs: Sequence[Path], device: str
) -> dict[str, Any]:
    """Likelihood and landing errors of a verdict on held-out throws.

    Returns:
        ``before``, ``after``: nats by which the throws are explained worse by the model as it was,
        and with what was named, than by the model with the block that it lacks; see
        :func:`bench.diagnose.shortfalls.shortfalls`. ``landing_before``, ``landing_after``,
        ``landing_whole``: mean distance of predicted and seen landings [m], open loop from a second
        before the separation; None where one never comes down.
    """
    from bench.diagnose.shortfalls import shortfalls
    from visthrow.diagnose.throw.throw_model import ThrowModel

    sizes: list[Mapping[str, float]] = [{}, theta, {lacks: 1.0}]
    plant = plant_of(load_experiment(base))
    only = sorted({lacks, *theta})
    model = ThrowModel([FlightLog.load(path) for path in logs], plant, device=device, only=only)
    (before, after, _), samples = shortfalls(model, sizes)
    losses = {"before": before, "after": after, "samples": samples}
    for who, theta_ in zip(("before", "after", "whole"), sizes):
        off = model.landings(theta_).errors
        losses[f"landing_{who}"] = (
            float(np.mean(off)) if len(off) and np.isfinite(off).all() else None
        )
    return losses


def read(path: Path | None = None) -> dict[str, Any]:
    """Record of a round: a file, the folder of one, or without any the committed one.

    Raises:
        DiagnoseError: There is none.
    """
    file = COMMITTED if path is None else path / "record.json" if path.is_dir() else path
    if not file.exists():
        raise DiagnoseError(
            f"{file}: no such record; expected what `python -m bench.ablations` left"
        )
    return json.loads(file.read_text())


def table(record: Mapping[str, Any]) -> str:
    """Markdown table of a round."""
    lines = [
        f"{record['flights']} throws of '{record['policy']}' diagnosed, {record['held']} held back",
        "",
        (
            "| the model lacks | named | verdict | held back: nats short of the whole model |"
            " predicted landing off by [mm] | [s] |"
        ),
        "|---|---|---|---|---|---|",
    ]
    for r in record["ablations"]:
        names = (
            ", ".join(
                f"{n} {size:+.3g} ({r['nats'][n]:.0f} nats)" for n, size in r["named"].items()
            )
            or "nothing"
        )
        held = r["held"]
        off = " -> ".join(
            "-" if (x := held[f"landing_{who}"]) is None else f"{1e3 * x:.0f}"
            for who in ("before", "after")
        )
        worth = f"{held['before']:.0f} -> {held['after']:.0f}"
        right = (
            "named"
            if set(r["named"]) == {r["lacks"]}
            else "named, with others"
            if r["lacks"] in r["named"]
            else "not named"
        )
        took = f"{r['seconds']:.0f}" if r["seconds"] else "-"
        lines.append(
            f"| {r['lacks']} ({r['model']}) | {names} | {r['overall']}, {right} | {worth} | {off} |"
            f" {took} |"
        )
    return "\n".join(lines)


def run(args: argparse.Namespace) -> None:
    """Name the blocks that models lack, or show what was named."""
    if args.show is not None:
        print("\n\n".join(table(read(place)) for place in args.show or (None,)))
        return
    one = Ablations(
        Path(args.out) / "ablations",
        args.names or tuple(LACKS),
        args.policy,
        args.flights,
        args.held,
        resolve(args.diagnose_on),
    )
    print("\n" + table(one.run(lambda line: print(f"  {line}", flush=True))))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    add_arguments(parser)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(LACKS)} (default: all)"
    )
    parser.add_argument(
        "--held", type=int, default=Ablations.held, help="throws held back (default: 3)"
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
