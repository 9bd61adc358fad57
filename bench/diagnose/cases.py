"""Cases whose right answer follows from another answer: symmetries of sealed worlds, mixed-up logs,
the model altered.

    python -m bench.diagnose.cases mirror=10 swap=10 idempotence=10 scramble=10 --jobs 8 --ledger
    cases.jsonl

Each case has its own world, on a plant that shares no code with the package; the tool runs in a
separate process, as in :mod:`bench.diagnose.sealed`."""

import argparse
import json
import multiprocessing as mp
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.diagnose import altered
from bench.diagnose.sealed import (
    ALIKE,
    WITHOUT_TESTS,
    _pin_worker,
    flight_log,
    model_of,
    named_causes,
)
from bench.worlds.world import FLOORS, ONE_SIDED, PLANTS, Recipe, fly_recipe, record_flights
from visthrow.diagnose.reporting.explain_cli import REFUSED
from visthrow.logs.flightlog import FlightLog

SIZE = dict(free=4, free_seconds=6.0, throws=6)
"""Flights of a case: fewer than those of the bank, since each is explained twice."""
NEAR = 4.0
"""Deviations within which two estimates of one size must agree."""
BASE = "train/state.toml"


def environment() -> dict[str, str]:
    """Environment of a process that finds the package from any folder."""
    root = Path(__file__).resolve().parents[2]
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    }


def command_for(
    count: int, recipe: Recipe, action: str = "explain", plant: str | None = None
) -> list[str]:
    """Arguments of the command for a number of logs in a folder, with the world's null model."""
    command = [
        "diagnose",
        action,
        *[f"flight_{i:02d}.npz" for i in range(count)],
        "--device",
        "cpu",
        "--json",
        "said.json",
    ]
    command += [
        "--out",
        "out",
        *(["--no-report"] if action == "explain" else []),
        *(["--plant", plant] if plant else []),
    ]
    for item in model_of(recipe):
        command += ["--set", item]
    return command


def tool(folder: Path, *arguments: str, timeout: float = 1500.0) -> str:
    """Run ``visthrow`` in a separate process, in a folder, without access to the tests; returns its
    output.

    Raises:
        RuntimeError: It failed.
    """
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TESTS, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=environment(),
        check=False,
    )
    if done.returncode not in (0, REFUSED):
        raise RuntimeError(
            f"visthrow {' '.join(arguments)} ended with"
            f" {done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}"
        )
    return done.stdout


def explain_logs(
    folder: Path,
    logs: Sequence[FlightLog],
    recipe: Recipe,
    plant: str | None = None,
    action: str = "explain",
    more: Sequence[str] = (),
) -> dict:
    """The tool's JSON about logs.

    Args:
        folder: to work in; gets a folder of logs.
        logs: of the flights.
        recipe: of the world, for the model that is its null.
        plant: a configuration file on top of which that is done; None for the shipped one.
        action: ``explain`` or ``plan``.
        more: arguments; a plan's JSON gets the references' text under ``tables``, by file.
    """
    place = Path(tempfile.mkdtemp(dir=folder))
    for i, log in enumerate(logs):
        log.save(place / f"flight_{i:02d}.npz")
    tool(place, *command_for(len(logs), recipe, action, plant), *more)
    answer = json.loads((place / "said.json").read_text())
    return answer | {"tables": {path.name: path.read_text() for path in place.glob("out/*.csv")}}


def names(verdict: dict) -> set[str]:
    """Names of the sizes that a verdict sets."""
    return set(verdict.get("theta") or {})


def is_right(verdict: dict, name: str) -> bool:
    """Whether one cause is named: this one, alone or in a class that holds it, or one that such
    flights hardly distinguish from it.
    """
    groups = named_causes(verdict)
    near = {name}.union(*(a for a in ALIKE if name in a))
    return len(groups) == 1 and bool(groups[0] & near)


def size_is(verdict: dict, name: str, size: float) -> bool:
    """Whether a named effect has this size within its deviation; true where another of its class
    was named.
    """
    findings = [
        f for f in verdict["findings"] if f["name"] == name and f["verdict"] in ("FOUND", "CLASS")
    ]
    return all(abs(f["estimate"] - size) < NEAR * max(f["sd"], f["floor"]) for f in findings)


def same(one: dict, other: dict, sizes: Callable[[dict], dict] = lambda theta: theta) -> bool:
    """Whether two verdicts agree on effects, sizes and the overall verdict."""
    expected = sizes(one.get("theta") or {})
    came = other.get("theta") or {}
    sd = {f["name"]: max(f["sd"], f["floor"]) for f in other["findings"]}
    return (
        one["overall"] == other["overall"]
        and set(expected) == set(came)
        and all(abs(came[name] - size) < sd[name] for name, size in expected.items())
    )


def write_config(theta: dict[str, float], path: Path) -> str:
    """Write the configuration in which the model has these effects; the path as text."""
    from visthrow.diagnose.apply import patch
    from visthrow.task import load_experiment

    experiment = load_experiment("state")
    zero = [[0.0] * len(theta) for _ in theta]
    path.write_text(patch.text(BASE, experiment, theta, zero, 1, ()))
    return str(path)


def logs_of(recipe: Recipe) -> list[FlightLog]:
    """Fly a world."""
    return [flight_log(record) for record in record_flights(recipe, fly_recipe(recipe))]


def hidden_effect(recipe: Recipe) -> tuple[str, float]:
    """The one effect of a world."""
    return next(iter(recipe.effects.items()))


def _bare(recipe: Recipe) -> Recipe:
    return Recipe(**{**asdict(recipe), "effects": {}, "floors": 0.0})


def mirror(recipe: Recipe, folder: Path) -> dict:
    """A nominal world and a model with the recipe's effects: the diagnosis must find the opposite
    correction.
    """
    name, size = hidden_effect(recipe)
    verdict = explain_logs(
        folder, logs_of(_bare(recipe)), recipe, write_config(recipe.effects, folder / "model.toml")
    )
    return {"passed": is_right(verdict, name) and size_is(verdict, name, -size), "said": verdict}


def swap(recipe: Recipe, folder: Path) -> dict:
    """The effect is in world and model: nothing may be found."""
    verdict = explain_logs(
        folder, logs_of(recipe), recipe, write_config(recipe.effects, folder / "model.toml")
    )
    return {"passed": verdict["overall"] == "NO EFFECT", "said": verdict}


def idempotence(recipe: Recipe, folder: Path) -> dict:
    """An effect that ``apply`` writes into the configuration must not be found again."""
    logs = logs_of(recipe)
    first = explain_logs(folder, logs, recipe)
    (folder / "first.json").write_text(json.dumps(first))
    tool(folder, "diagnose", "apply", "first.json", "--out", "extended.toml", "--plants", "1")
    again = (
        explain_logs(folder, logs, recipe, str(folder / "extended.toml")) if names(first) else first
    )
    return {
        "passed": bool(names(first)) and again["overall"] == "NO EFFECT",
        "said": again,
        "before": first,
    }


def scramble(recipe: Recipe, folder: Path) -> dict:
    """Commands of one flight with poses of another: nothing may be named."""
    verdict = explain_logs(folder, altered.scramble_poses(logs_of(recipe)), recipe)
    return {
        "passed": (
            not names(verdict) and verdict["overall"] in ("DATA INCONSISTENT", "OUT OF DOMAIN")
        ),
        "said": verdict,
    }


def flip(recipe: Recipe, _: Path) -> dict:
    """Residuals of every other flight with the opposite sign: no common cause remains."""
    from visthrow.diagnose.reporting import diagnosis_report as report
    from visthrow.diagnose.select import diagnose_flights
    from visthrow.diagnose.throw.throw_model import ThrowModel
    from visthrow.task import load_experiment, plant_of

    experiment = load_experiment("state", model_of(recipe))
    model = ThrowModel(logs_of(recipe), plant_of(experiment))
    verdict = report.to_json(diagnose_flights.explain(altered.Flipped(model, recipe.seed)))
    return {"passed": not names(verdict), "said": verdict}


def _twice(
    recipe: Recipe,
    folder: Path,
    change: Callable[[list[FlightLog]], list[FlightLog]],
    sizes=lambda theta: theta,
) -> dict:
    logs = logs_of(recipe)
    first = explain_logs(folder, logs, recipe)
    second = explain_logs(folder, change(logs), recipe)
    is_found = any(
        is_right(first, name) for name in recipe.effects
    )  # an effect missed here must be missed in the transformed logs, too
    return {
        "passed": same(first, second, sizes),
        "found": is_found,
        "said": second,
        "before": first,
    }


def turn(recipe: Recipe, folder: Path) -> dict:
    """The hall's axes turned by 90 deg and moved: wind turns with them, other sizes stay."""

    def sizes(theta):
        quarter = {"wind_x": ("wind_y", 1.0), "wind_y": ("wind_x", -1.0)}
        quarter |= {
            name.replace("wind", "frame_tilt"): (to.replace("wind", "frame_tilt"), s)
            for name, (to, s) in quarter.items()
        }
        return {
            quarter.get(n, (n, 1))[0]: quarter.get(n, (n, 1))[1] * size for n, size in theta.items()
        }

    return _twice(
        recipe,
        folder,
        lambda logs: [altered.turn_hall(log, 0.5 * np.pi, (2.0, -1.0, 0.0)) for log in logs],
        sizes,
    )


def leftright(recipe: Recipe, folder: Path) -> dict:
    """Mirrored flights must give the mirrored verdict."""
    return _twice(
        recipe,
        folder,
        lambda logs: [altered.mirror_flight(log) for log in logs],
        altered.mirror_theta,
    )


def permute(recipe: Recipe, folder: Path) -> dict:
    """Flights in another order."""
    order = np.random.default_rng(recipe.seed).permutation(recipe.free + recipe.throws)
    return _twice(recipe, folder, lambda logs: [logs[i] for i in order])


def shift(recipe: Recipe, folder: Path) -> dict:
    """All clocks of each flight set forward, each by its own time."""
    return _twice(
        recipe,
        folder,
        lambda logs: [altered.later(log, 1234.5 + 77.7 * i) for i, log in enumerate(logs)],
    )


def copy(recipe: Recipe, folder: Path) -> dict:
    """A flight handed over twice, its clock set forward, counts once."""
    out = _twice(recipe, folder, lambda logs: [*logs, altered.later(logs[-1], 50.0)])
    sd = [
        {f["name"]: f["sd"] for f in verdict["findings"]}
        for verdict in (out["before"], out["said"])
    ]
    alike = all(
        abs(sd[1][name] / sd[0][name] - 1.0) < 0.02 for name in names(out["said"]) if name in sd[0]
    )
    copied = out["said"].get("duplicates")
    return out | {"passed": bool(out["passed"] and alike and copied), "copied": copied}


KINDS = {
    f.__name__: f
    for f in (mirror, swap, idempotence, scramble, flip, turn, leftright, permute, shift, copy)
}


@dataclass(frozen=True)
class Task:
    """A case to be run."""

    kind: str
    recipe: Recipe
    until: float


def draw(kind: str, seed: int, floors: float = 15.0) -> Recipe:
    """World of a case: an effect and a plant from a seed; no effect where logs are damaged, the
    pair's effect in a pair.
    """
    from bench.diagnose.bad import BAD
    from bench.diagnose.degenerate import PAIRS

    rng = np.random.default_rng(seed)
    if kind == "scramble" or kind in BAD:
        return Recipe(seed, str(rng.choice(PLANTS)), **SIZE)
    if kind in PAIRS:
        pair = PAIRS[kind]
        return Recipe(
            seed,
            str(rng.choice(("rod", "string"))),
            {pair.effect: pair.size * float(rng.choice(pair.signs))},
            **SIZE,
        )
    name = str(rng.choice(list(FLOORS)))
    sign = 1.0 if name in ONE_SIDED else float(rng.choice([-1.0, 1.0]))
    return Recipe(
        seed, str(rng.choice(PLANTS)), {name: sign * floors * FLOORS[name]}, floors, **SIZE
    )


def brief(verdict: dict) -> dict:
    """The part of a verdict that the ledger keeps."""
    findings = [f for f in verdict["findings"] if f["verdict"] in ("FOUND", "CLASS")]
    keep = ("name", "verdict", "estimate", "sd", "partners")
    return {
        "overall": verdict["overall"],
        "reasons": verdict.get("reasons"),
        "theta": verdict.get("theta"),
        "findings": [{k: f[k] for k in keep} for f in findings],
        "seconds": verdict.get("seconds"),
    }


def run_case(task: Task) -> dict | None:
    """One case: a line of the ledger; None where it is too late to begin."""
    if time.time() > task.until:
        return None
    begin = time.perf_counter()
    line = {"kind": task.kind, "recipe": asdict(task.recipe), "truth_sha256": task.recipe.digest()}
    try:
        with tempfile.TemporaryDirectory() as name:
            line |= run_kind(task.kind)(task.recipe, Path(name))
    except Exception:  # a case that fails is a line of the ledger that says how
        line |= {"passed": False, "error": traceback.format_exc()[-2000:]}
    line |= {key: brief(line[key]) for key in ("said", "before") if key in line}
    return line | {"seconds": round(time.perf_counter() - begin, 1)}


def run_kind(kind: str) -> Callable[[Recipe, Path], dict]:
    """The function of a kind of case."""
    from bench.diagnose.bad import BAD
    from bench.diagnose.degenerate import PAIRS

    return KINDS[kind] if kind in KINDS else {**PAIRS, **BAD}[kind].run


def main() -> None:
    """Run cases and append them to a ledger; cases in the ledger are skipped."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("cases", nargs="+", metavar="KIND=COUNT", help=f"of {', '.join(KINDS)}")
    parser.add_argument(
        "--seed", type=int, help="of the first; drawn by the system where not given"
    )
    parser.add_argument("--ledger", type=Path, default=Path("cases.jsonl"))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--slot",
        type=int,
        default=0,
        help="which of the machine's cores the first job takes (default: 0)",
    )
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no case later than this")
    args = parser.parse_args()
    first = int.from_bytes(os.urandom(4), "little") if args.seed is None else args.seed
    print(f"first seed {first}", flush=True)
    until = time.time() + 60.0 * args.minutes
    tasks = []
    for k, (kind, count) in enumerate(item.split("=") for item in args.cases):
        tasks += [
            (i, Task(kind, draw(kind, first + 10_000 * k + 10 * i), until))
            for i in range(int(count))
        ]
    done = set()
    if args.ledger.exists():
        done = {
            (line["kind"], line["truth_sha256"])
            for line in map(json.loads, args.ledger.read_text().splitlines())
        }
    tasks = [
        task for _, task in sorted(tasks, key=lambda item: item[0])
    ]  # one of each kind before the second of any
    tasks = [task for task in tasks if (task.kind, task.recipe.digest()) not in done]
    tally: dict[str, Counter] = {}
    context = mp.get_context("spawn")
    with context.Pool(args.jobs, _pin_worker, (context.Value("i", args.slot),)) as pool:
        for line in pool.imap_unordered(run_case, tasks):
            if line is None:
                continue
            with args.ledger.open("a") as out:
                out.write(json.dumps(line) + "\n")
            tally.setdefault(line["kind"], Counter()).update(
                ["cases"] + ["passed"] * bool(line["passed"])
            )
            answer = line.get("said", {})
            outcome = (
                answer.get("overall"),
                answer.get("theta"),
                line["seconds"],
                line.get("error", ""),
            )
            world = line["recipe"]["plant"], line["recipe"]["effects"]
            print("ok  " if line["passed"] else "FAIL", line["kind"], *world, *outcome, flush=True)
    for kind, count in tally.items():
        print(f"{kind}: {count['passed']} of {count['cases']}")


if __name__ == "__main__":
    main()
