"""The loop closed: an effect hidden in the reference plant, flights, diagnosis, training in the
extended model, flights again.

Every stage writes a file into the folder of its effect and is skipped where the file exists, so an
interrupted loop resumes; independent stages run in parallel. Three policies fly the same throws:
the original one, one trained in the model extended by the diagnosis, and the oracle, trained in a
model with the hidden effect.

    python -m bench.loop --hide motor_tau=0.02
        a slower motor; minutes on a GPU, hours on a CPU
    python -m bench.loop --base state_no_motor_lag \\
        --policy runs/state_no_motor_lag-1/policy.npz --hide motor_lag=1
    python -m bench.loop --show
        the committed loops
    python -m bench.loop --show runs/loop/* --picture loops.png
"""

import argparse
import concurrent.futures
import dataclasses
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench import start
from sim.cores import cores
from visthrow import config
from visthrow.common import mocap, statistics, toml_text, workers
from visthrow.common.compute_device import resolve
from visthrow.common.errors import ConfigError, DiagnoseError
from visthrow.common.storage import atomic_write, write_json
from visthrow.diagnose.apply.patch import extend
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.paper.results import DIGITS
from visthrow.task import Experiment, load_experiment
from visthrow.throws.loading import Loaded, load_policy
from visthrow.throws.recorded import fly
from visthrow.throws.reference_protocol import Throwing

PLANT = "reference"
"""The reference plant without extras: the diagnosis finds the hidden effect, or is wrong."""

NOISE = {"pos_w": 5e-4, "quat_wb": np.radians(0.2), "payload_pos_w": 8e-4}
"""Of the recordings: motion capture [m], [rad], [m]."""

BEFORE = 1.5
AFTER = 0.6
"""Times of a flight that are kept before the policy starts and after the landing [s]."""

BATCH = 20
"""Throws that share a process: of 200, ten cores fly each policy's at once.

Other sizes would be other throws.
"""

THROW_SEED = 20_000
"""Of the throws that judge; the flights that are diagnosed have the seeds from 0."""

COMMITTED = Path(__file__).parent / "loops"
"""The committed records of loops."""

WHO = ("before", "after", "oracle")
"""The policies that are compared."""

POLICY = "policy.npz"
CHECKPOINT = "checkpoint.pt"
SUMMARY = "summary.json"
"""Names of files in a training's folder, as in :mod:`visthrow.training.trainer`, which is slow to
import.
"""

RECORD = "record.json"
"""File of a finished loop in its folder."""

CONTRACT = ("vehicle", "rope", "release", "air", "laws", "observation.latency")
"""Parts of a policy's contract that a hidden effect breaks."""


@dataclass(frozen=True)
class Loop:
    """One hidden effect, from flights to flights.

    Attributes:
        hidden: effect of the catalogue -> its size.
        base: config of ``configs/train`` that the policy was trained with and that is diagnosed.
        policy: shipped name or file of the original policy.
        flights: to be diagnosed.
        throws: of each policy on the plant, in the end.
        target: of those throws, along x [m].
        device: of the trainings; where the diagnosis names nothing or fails, there is none after
            it, and "after" is "before".
        diagnose_on: device of the diagnosis.
        processes: for flights and throws.
        changes: ``key=value`` of the trainings, such as fewer iterations for a trial.
    """

    hidden: Mapping[str, float]
    folder: Path
    base: str = "state"
    policy: str = "state"
    flights: int = 12
    throws: int = 200
    target: float = 2.0
    device: str = "cpu"
    diagnose_on: str = "cpu"
    processes: int = 2
    changes: tuple[str, ...] = ()

    def run(self, say: Callable[[str], None]) -> dict[str, Any]:
        """Run the loop, or resume an earlier run; returns the record."""
        nominal = load_experiment(self.base)
        truth = extend(nominal, self.hidden)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._config("hidden", truth)
        begin = time.perf_counter()
        seconds = {}

        def report(line: str) -> None:
            say(f"{time.perf_counter() - begin:4.0f} s: {line}")

        def time_stage(name: str, stage: Callable[..., Any], *args: Any) -> Any:
            start = time.perf_counter()
            result = stage(*args, report)
            seconds[name] = round(time.perf_counter() - start, 1)
            return result

        def oracle() -> dict[str, Any]:
            time_stage("training of the oracle", self._train, "oracle")
            return time_stage(
                "throws of the oracle", self._throws, "oracle", str(self.folder / "oracle" / POLICY)
            )

        with concurrent.futures.ThreadPoolExecutor(3) as stages:
            knowing = stages.submit(oracle)
            logs = time_stage("flights", self._flights, truth)
            blind = stages.submit(time_stage, "throws before", self._throws, "before", self.policy)
            verdict = time_stage("diagnosis", self._diagnose, logs)
            theta = named_sizes(verdict)
            report(f"named: {', '.join(f'{n} {v:.4g}' for n, v in theta.items()) or 'nothing'}")
            throws = dict.fromkeys(WHO)
            if theta:
                self._config("extended", extend(nominal, theta))
                time_stage("training", self._train, "extended")
                throws["after"] = time_stage(
                    "throws after", self._throws, "after", str(self.folder / "extended" / POLICY)
                )
            throws |= {"before": blind.result(), "oracle": knowing.result()}
            throws["after"] = throws["after"] or throws["before"]
        record = {
            "base": self.base,
            "hidden": dict(self.hidden),
            "named": theta,
            "overall": verdict["overall"],
        }
        record |= {
            "target": self.target,
            "flights": self.flights,
            "throws": throws,
            "seconds": seconds,
        }
        record["recovered"] = estimate_recovered_share(throws)
        write_json(self.folder / RECORD, record)
        return record

    def _config(self, name: str, experiment: Experiment) -> None:
        text = toml_text.dumps(config.to_dict(experiment, defaults=False))
        atomic_write(self.folder / f"{name}.toml", text)

    def _train(self, name: str, say: Callable[[str], None]) -> None:
        """Train a policy in a process of its own; the oracle's model is the hidden one."""
        flown = self.folder / f"throws_{'after' if name == 'extended' else name}.json"
        if (self.folder / name / SUMMARY).exists() or flown.exists():
            return
        source = self.folder / ("hidden.toml" if name == "oracle" else f"{name}.toml")
        command = [
            sys.executable,
            "-m",
            "visthrow.cli",
            "train",
            str(source),
            "--out",
            str(self.folder / name),
        ]
        command += ["--device", self.device, "--seed", "1"]
        if (self.folder / name / CHECKPOINT).exists():
            command.append("--resume")
        else:  # one that was interrupted before its first checkpoint begins anew
            shutil.rmtree(self.folder / name, ignore_errors=True)
        for change in self.changes:
            command += ["--set", change]
        with (self.folder / f"{name}.log").open("w") as log:
            status = subprocess.run(
                command, stdout=log, stderr=subprocess.STDOUT, check=False
            ).returncode
        if status != 0:
            tail = (self.folder / f"{name}.log").read_text()[-600:]
            raise DiagnoseError(f"the training '{name}' failed: {tail}")
        say(f"trained: {name}")

    def _flights(self, truth: Experiment, say: Callable[[str], None]) -> list[Path]:
        """Throws of the policy at targets all around, on the plant with the hidden effect."""
        return fly_all(
            self.folder / "flights",
            self.policy,
            self.base,
            truth,
            self.flights,
            self.processes,
            say,
        )

    def _diagnose(self, logs: list[Path], say: Callable[[str], None]) -> dict[str, Any]:
        return explain_logs(logs, self.base, self.folder / "verdict.json", self.diagnose_on, say)

    def _throws(self, name: str, policy: str, say: Callable[[str], None]) -> dict[str, Any]:
        path = self.folder / f"throws_{name}.json"
        if not path.exists():
            loaded = [load_policy(policy, str(self.folder / "hidden.toml"), allow=CONTRACT)]
            with Throwing(
                loaded, (self.target,), self.throws, PLANT, THROW_SEED, self.processes, size=BATCH
            ) as throwing:
                result = throwing.results(show=False)[0][0]
            kept = {"error": result.error, "duration": result.duration}
            kept = {name: np.round(values, DIGITS).tolist() for name, values in kept.items()}
            write_json(path, kept | {"success": np.asarray(result.success, dtype=bool).tolist()})
        throws = json.loads(path.read_text())
        error = landing_errors(throws)
        say(
            f"thrown: {name}, {len(error)} landed"
            + (f", {np.mean(error):.3f} m" if len(error) else "")
        )
        return throws


def read(places: Sequence[Path] = ()) -> list[dict[str, Any]]:
    """Records of finished loops.

    Args:
        places: folders of loops, or records; without any, the committed records.

    Raises:
        DiagnoseError: a folder without a record, or no committed ones.
    """
    files = [place if place.suffix == ".json" else place / RECORD for place in places] or sorted(
        COMMITTED.glob("*.json")
    )
    if not files:
        raise DiagnoseError(
            f"{COMMITTED}: no records of loops; name folders of loops that went round,"
            " runs/loop/motor_tau_0.02"
        )
    for file in files:
        if not file.exists():
            raise DiagnoseError(
                f"{file}: no such record; expected the folder of a loop that went round,"
                " runs/loop/motor_tau_0.02"
            )
    return [json.loads(file.read_text()) for file in files]


def landing_errors(throws: Mapping[str, Any]) -> np.ndarray:
    """Landing errors of the throws that came down [m]."""
    return np.array(throws["error"], dtype=float)[np.array(throws["success"], dtype=bool)]


def estimate_recovered_share(
    throws: Mapping[str, Any], draws: int = 4000, seed: int = 0
) -> dict[str, float]:
    """Share of the landing error that the hidden effect costs which the diagnosis wins back, with
    its 95 % interval.

    ``(before - after) / (before - oracle)`` of the mean errors; bootstrap over throws, each policy
    by itself."""
    rng = np.random.default_rng(seed)
    errors = {name: landing_errors(throws[name]) for name in WHO}
    if any(len(e) < 2 for e in errors.values()):
        return {"share": float("nan"), "low": float("nan"), "high": float("nan")}

    def share(mean: Mapping[str, Any]) -> Any:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.divide(mean["before"] - mean["after"], mean["before"] - mean["oracle"])

    again = {n: e[rng.integers(0, len(e), (draws, len(e)))].mean(1) for n, e in errors.items()}
    low, high = np.quantile(share(again), [0.025, 0.975])
    return {
        "share": float(share({n: e.mean() for n, e in errors.items()})),
        "low": float(low),
        "high": float(high),
    }


def named_sizes(verdict: Mapping[str, Any]) -> dict[str, float]:
    """Sizes that a verdict sets in the model."""
    return {name: float(value) for name, value in verdict.get("theta", {}).items()}


def fly_all(
    folder: Path,
    policy: str,
    base: str,
    truth: Experiment,
    count: int,
    processes: int,
    say: Callable[[str], None],
) -> list[Path]:
    """Fly a policy that was trained in ``base`` on the reference plant of ``truth``; flights that
    are there are not flown again.
    """
    paths = [folder / f"flight_{i:02d}.npz" for i in range(count)]
    todo = [(i, path) for i, path in enumerate(paths) if not path.exists()]
    text = toml_text.dumps(config.to_dict(truth, defaults=False))
    for k, _ in enumerate(
        workers.run_tasks(partial(_fly_one, policy, base, text), todo, processes), 1
    ):
        say(f"flown: {k} of {len(todo)}")
    return paths


def explain_logs(
    logs: Sequence[Path], plant: str, answer: Path, device: str, say: Callable[[str], None]
) -> dict[str, Any]:
    """Verdict of ``visthrow diagnose explain`` on logs, run in a separate process and written to
    ``answer``.
    """
    if not answer.exists():
        command = [sys.executable, "-m", "visthrow.cli", "diagnose", "explain", *map(str, logs)]
        command += ["--plant", plant, "--no-report", "--device", device, "--json", str(answer)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not answer.exists():
            say(f"the diagnosis failed: {(done.stdout + done.stderr)[-600:]}")
            return {"overall": "ERROR", "theta": {}}
    verdict = json.loads(answer.read_text())
    say(f"diagnosed: {verdict['overall']}")
    return verdict


def _fly_one(policy: str, base: str, text: str, flight: tuple[int, Path]) -> None:
    """Fly one throw of a policy that was trained in ``base``, by its number, and save its
    recording.
    """
    number, path = flight
    shipped = load_policy(policy, base)
    truth = config.loads(Experiment, text, (), name="the hidden world")
    rng = np.random.default_rng(number)
    angle = rng.uniform(-np.pi, np.pi)
    distance = rng.uniform(1.0, 1.9)
    goal = np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0])
    record_flight(fly(Loaded(shipped.name, shipped.policy, truth), goal, PLANT, number), rng).save(
        path
    )


def record_flight(log: FlightLog, rng: np.random.Generator) -> FlightLog:
    """A simulated flight as motion capture and the radio's log record it: noisy poses, commands,
    the battery's voltage, no true states.
    """
    start = log.meta["times"]["policy_start"] - BEFORE
    end = log.meta["times"].get("landing", log.meta["times"]["end"])
    channels = {
        name: _cut(log[name], start, end + AFTER)
        for name in ("command", "release_command", "battery_voltage", "pos_w", "quat_wb")
    }
    channels["payload_pos_w"] = _cut(log["payload_pos_w"], start, end)
    measured = mocap.add_mocap_noise(
        {name: channels[name].values for name in ("pos_w", "payload_pos_w", "quat_wb")}, NOISE, rng
    )
    channels |= {
        name: dataclasses.replace(channels[name], values=values)
        for name, values in measured.items()
    }
    return FlightLog(channels, {"policy": log.meta["policy"], "plant": log.meta["plant"]})


def _cut(channel: Channel, start: float, end: float) -> Channel:
    keep = (channel.time >= start) & (channel.time <= end)
    return channel.only(keep)


def describe_hidden(record: Mapping[str, Any]) -> str:
    """The hidden effects and the model, as text for tables."""
    base = record.get("base", "state")
    return ", ".join(f"{n} {v:+.4g}" for n, v in record["hidden"].items()) + (
        "" if base == "state" else f" ({base})"
    )


def table(records: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of loops: mean landing errors in millimetres with 95 % intervals."""
    lines = [
        "| hidden | named | before [mm] | after [mm] | oracle [mm] | won back |",
        "|---|---|---|---|---|---|",
    ]
    for r in records:
        names = ", ".join(f"{n} {v:+.4g}" for n, v in r["named"].items()) or "nothing"
        errors = {name: landing_errors(throws) for name, throws in r["throws"].items()}
        cells = []
        for name in WHO:
            count = f" ({len(errors[name])} of {len(r['throws'][name]['error'])} landed)"
            whole = len(errors[name]) == len(r["throws"][name]["error"])
            cells.append(
                (statistics.mean(1e3 * errors[name]).text(0) if len(errors[name]) else "-")
                + ("" if whole else count)
            )
        share = r["recovered"]
        if share["share"] is None or np.isnan(share["share"]):  # JSON has no NaN
            won = "-"
        elif statistics.difference(errors["before"], errors["oracle"]).low <= 0.0:
            won = "nothing was lost"
        else:
            won = (
                f"{100 * share['share']:.0f} % [{100 * share['low']:.0f},"
                f" {100 * share['high']:.0f}]"
            )
        lines.append(f"| {describe_hidden(r)} | {names} | {' | '.join(cells)} | {won} |")
    return "\n".join(lines)


def picture(records: Sequence[Mapping[str, Any]]) -> bytes:
    """Mean landing errors with intervals, a group a loop, as PNG."""
    from visthrow.paper.report.charts import Mark, marks

    rows = [
        Mark(
            describe_hidden(r),
            statistics.mean(1e3 * landing_errors(r["throws"][name])),
            WHO.index(name),
        )
        for r in records
        for name in WHO
        if len(landing_errors(r["throws"][name]))
    ]
    return marks(rows, "landing error on the plant [mm]", WHO, log=True)


def run(args: argparse.Namespace) -> None:
    """Run the loop for the effects, all hidden at once, or show records."""
    if args.show is not None:
        records = read(args.show)
        print(table(records))
        if args.picture:
            atomic_write(args.picture, picture(records))
        return
    hidden = {}
    for item in args.hide:
        name, _, size = item.partition("=")
        try:
            hidden[name] = float(size)
        except ValueError:
            raise ConfigError(
                f"--hide {item}; expected EFFECT=SIZE, such as motor_tau=0.02"
            ) from None
    if not hidden:
        raise ConfigError(
            "nothing to hide; name an effect, such as --hide motor_tau=0.02, or say --show"
        )
    parts = [f"{n}_{v:g}" for n, v in hidden.items()]
    folder = Path(args.out) / "-".join(parts if args.base == Loop.base else [args.base, *parts])
    record = Loop(
        hidden,
        folder,
        args.base,
        args.policy,
        flights=args.flights,
        throws=args.throws,
        device=resolve(args.device),
        diagnose_on=resolve(args.diagnose_on),
        processes=args.processes or cores(),
        changes=tuple(args.changes),
    ).run(lambda line: print(f"  {line}", flush=True))
    print("\n" + table([record]))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what loops and ablations share."""
    parser.add_argument(
        "--policy", default=Loop.policy, metavar="NAME", help="shipped, or a file (default: state)"
    )
    parser.add_argument(
        "--show",
        type=Path,
        nargs="*",
        metavar="FOLDER",
        help="run nothing, show these (default: those committed)",
    )
    parser.add_argument(
        "--flights", type=int, default=Loop.flights, help="that are diagnosed (default: 12)"
    )
    parser.add_argument(
        "--diagnose-on",
        default="cpu",
        metavar="NAME",
        help="device of the diagnosis (default: cpu)",
    )
    parser.add_argument("--out", default="runs/loop", metavar="FOLDER", help="(default: runs/loop)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    add_arguments(parser)
    parser.add_argument(
        "--hide",
        action="append",
        default=[],
        metavar="EFFECT=SIZE",
        help="of the catalogue; may be repeated",
    )
    parser.add_argument(
        "--base",
        default=Loop.base,
        metavar="NAME",
        help="of configs/train: what is diagnosed (default: state)",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="with --show: draw them, a PNG"
    )
    parser.add_argument(
        "--throws", type=int, default=Loop.throws, help="of each policy in the end (default: 200)"
    )
    parser.add_argument(
        "--processes", type=int, help="for flights and throws (default: one a core)"
    )
    parser.add_argument("--device", default="auto", metavar="NAME", help="of the trainings")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="changes",
        metavar="KEY=VALUE",
        help="in the trainings",
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
