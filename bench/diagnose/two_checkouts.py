"""Answer the worlds of banks with two checkouts of the project, and compare the answers.

    python -m bench.diagnose.two_checkouts answer --trees OLD NEW --jobs 40 --ledger two.jsonl \\
        --banks bench/diagnose/banks/confirm.txt \\
        --foreign bench/diagnose/banks/foreign-confirm.txt
    python -m bench.diagnose.two_checkouts compare two.jsonl

With one tree only that one answers, as the new one. Each world is flown once, by this checkout, and
its logs are handed to both tools in processes of their own, on the same core one after the other.
Worlds come in an order that the seeds fix, so that whatever was answered before the time is over is
a balanced part of the banks.
"""

import argparse
import json
import multiprocessing as mp
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy.stats import beta

from bench.diagnose import foreign, sealed
from bench.diagnose.ledger import RANDOM
from bench.worlds.world import Recipe
from visthrow.common.errors import VisthrowError

FOREIGN = """
import json, sys
from pathlib import Path
from bench.diagnose import foreign
from visthrow.diagnose.inputs.setup import MODELS
from visthrow.diagnose.reporting.diagnosis_report import to_json
from visthrow.logs.flightlog import FlightLog
try:
    from visthrow.diagnose.select.diagnose_flights import explain
except ImportError:  # of an older checkout
    from visthrow.diagnose.select.search import explain
vehicle, seed = sys.argv[1:]
logs = [FlightLog.load(path) for path in sorted(Path().glob("flight_*.npz"))]
model = MODELS["flyer"](logs, foreign.describe_vehicle(vehicle))
answer = explain(model, seed=int(seed))
Path("verdict.json").write_text(json.dumps(to_json(answer)))
"""
TIMEOUT = 300.0  # [s]
SIDES = ("old", "new")


def environment(tree: str) -> dict[str, str]:
    """Return the environment of a tool's process: one thread, and one tree that is imported."""
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    others = [path for path in paths if path and not (Path(path) / "visthrow").is_dir()]
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([tree, *others]),
        "OMP_NUM_THREADS": "1",
    }


def answer_of(tree: str, arguments: list[str], folder: Path, until: float) -> dict:
    """Return a tool's verdict, with the CPU time that it took."""
    answer = folder / "verdict.json"
    answer.unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    error = ""
    try:
        done = subprocess.run(
            [sys.executable, "-c", *arguments],
            cwd=folder,
            env=environment(tree),
            capture_output=True,
            text=True,
            timeout=float(np.clip(until - time.time(), 1.0, TIMEOUT)),
            check=False,
        )
        error = (done.stdout + done.stderr).strip().rpartition("\n")[2]
    except subprocess.TimeoutExpired:
        error = sealed.NOT_WAITED
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not answer.exists():
        return {"overall": "ERROR", "error": error[-300:], "findings": [], "seconds": seconds}
    return json.loads(answer.read_text()) | {"seconds": seconds}


def order_sides(trees: list[str], number: int) -> list[tuple[str, str]]:
    """Return the sides with their trees; for every second world the new one answers first."""
    sides = list(zip(SIDES[-len(trees) :], trees))
    return sides if number % 2 else sides[::-1]


def answer_foreign(seed: int, trees: list[str], until: float) -> dict:
    """Answer a world of the other author's generator."""
    vehicle, hidden, world = foreign.draw_world(seed)
    line = {"bank": "foreign", "seed": seed, "kind": f"foreign:{hidden or 'null'}"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for i in range(foreign.FLIGHTS):
            log = foreign.fly_lissajous(world, np.random.default_rng([seed, i]))
            log.save(folder / f"flight_{i}.npz")
        for side, tree in order_sides(trees, seed):
            verdict = answer_of(tree, [FOREIGN, vehicle, str(seed)], folder, until)
            groups = sealed.named_causes(verdict)
            line[side] = {
                "overall": verdict["overall"],
                "named": [sorted(g) for g in groups],
                "judged": foreign.judge_answer(hidden, groups, verdict["overall"]),
                "seconds": verdict["seconds"],
                "error": verdict.get("error", ""),
                "reasons": verdict.get("reasons", [])[:2],
            }
    return line


def answer_sealed(kind: str, recipe: Recipe, trees: list[str], until: float) -> dict:
    """Answer a sealed world; its held-out throws measure the gain of both answers."""
    line = {"bank": "sealed", "kind": kind, "recipe": asdict(recipe)}
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as apart:
        folder = Path(name)
        held = Path(apart)
        logs = sealed.hand_over(recipe, folder, held)
        explain = [sealed.WITHOUT_TESTS, "diagnose", "explain", *(p.name for p in logs)]
        explain += ["--device", "cpu", "--json", "verdict.json", "--out", "report", "--no-report"]
        explain += [*sealed.MEASURED]
        for item in sealed.model_of(recipe):
            explain += ["--set", item]
        sizes = {}
        for side, tree in order_sides(trees, recipe.seed):
            verdict = answer_of(tree, explain, folder, until)
            line[side] = sealed.judge(recipe, verdict) | {
                "errors": sealed.errors_of(recipe, verdict),
                "seconds": verdict["seconds"],
                "error": verdict.get("error", ""),
                "reasons": verdict.get("reasons", [])[:2],
            }
            sizes[side] = verdict.get("theta", {})
        if has_names(line):
            try:
                line["held"] = sealed.measure_held_back(recipe, sizes, held)
            except (VisthrowError, RuntimeError, ValueError) as error:
                line["held_error"] = repr(error)[:200]
    return line


def one(task: tuple[tuple, list[str], float, float]) -> dict | None:
    """Answer one world with both trees; None where the time is over."""
    world, trees, begin_until, until = task
    if time.time() > begin_until:
        return None
    begin = time.time()
    try:
        if world[0] == "foreign":
            line = answer_foreign(world[1], trees, until)
        else:
            line = answer_sealed(world[1], world[2], trees, until)
    except Exception as error:  # one world that cannot be flown must not stop the bank
        return {"kind": str(world[:2]), "failed": repr(error)[:300]}
    return line | {"wall": time.time() - begin}


def worlds_of(banks: Iterable[str], foreign_lists: Iterable[str]) -> list[tuple]:
    """Return the worlds of banks and seed lists, in an order whose every beginning is balanced.

    Each kind is spread over the order evenly; the first seed fixes how the kinds are mixed."""
    worlds: list[tuple] = []
    first = 0
    for path in banks:
        words = Path(path.removeprefix("@")).read_text().split()
        seed = int(words[words.index("--seed") + 1])
        plants = words[words.index("--plants") + 1 : words.index("--")]
        counts = [word.split("=") for word in words if "=" in word]
        shorter = sealed.SMALL if "--small" in words else {}
        for kind, recipe in sealed.bank(seed, {kind: int(n) for kind, n in counts}):
            if recipe.plant in plants:
                worlds.append(("sealed", kind, replace(recipe, **shorter)))
        first = first or seed
    for path in foreign_lists:
        worlds += [("foreign", int(word)) for word in Path(path).read_text().split()]
    rng = random.Random(first)
    rng.shuffle(worlds)
    kinds = [kind_of(world) for world in worlds]
    sizes = Counter(kinds)
    placed = Counter()
    places = []
    for kind in kinds:
        places.append((placed[kind] + rng.random()) / sizes[kind])
        placed[kind] += 1
    return [world for _, world in sorted(zip(places, worlds), key=lambda item: item[0])]


def kind_of(world: tuple) -> str:
    """Return a world's kind, or ``null`` or ``hidden`` for the other author's."""
    if world[0] == "foreign":
        return "foreign" if foreign.draw_world(world[1])[1] else "foreign null"
    return world[1]


def answer(args: argparse.Namespace) -> None:
    """Answer the banks until the time is over; a line for each world."""
    worlds = worlds_of(args.banks, args.foreign)
    worlds = [w for w in worlds if w[0] == "foreign" or w[2].seed not in args.skip][: args.worlds]
    first = {kind: place for place, kind in enumerate(args.longest)}
    worlds.sort(key=lambda world: first.get(kind_of(world).split()[0], len(first)))
    now = time.time()
    limits = now + args.seconds - args.last, now + args.seconds
    trees = [str(Path(tree).resolve()) for tree in args.trees]
    tasks = [(world, trees, *limits) for world in worlds]
    print(f"{len(worlds)} worlds", flush=True)
    write_answers(one, tasks, args.jobs, args.ledger)


def write_answers(
    answer_one: Callable[[tuple], dict | None], tasks: Iterable[tuple], jobs: int, path: Path
) -> None:
    """Do tasks in processes with a core each; append the answers to a ledger as they come."""
    context = mp.get_context("spawn")
    with (
        context.Pool(jobs, sealed._pin_worker, (context.Value("i", 0),)) as pool,
        path.open("a") as ledger,
    ):
        for line in pool.imap_unordered(answer_one, tasks):
            if line is not None:
                ledger.write(json.dumps(line) + "\n")
                ledger.flush()


def interval(k: int, n: int) -> str:
    """Return a share with its exact 95 % interval."""
    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k:4d} of {n:4d} = {100.0 * k / max(n, 1):5.1f} % [{100 * low:.0f}, {100 * high:.0f}]"


def is_null(line: dict) -> bool:
    """Tell whether nothing was hidden."""
    if line["bank"] == "foreign":
        return line["kind"] == "foreign:null"
    return line["kind"].startswith("null")


def is_outside(line: dict) -> bool:
    """Tell whether a law was hidden that no entry of the catalogue is."""
    if line["bank"] == "foreign":
        return line["kind"].removeprefix("foreign:") in foreign.FOREIGN
    return line["kind"] in ("law", "beyond")


def has_names(line: dict) -> bool:
    """Tell whether effects of the catalogue were hidden, the same in all flights."""
    if is_null(line) or is_outside(line):
        return False
    return line["bank"] == "foreign" or bool(line["recipe"]["effects"])


def names_right(line: dict, side: str) -> bool:
    """Tell whether an answer names what was hidden, up to its class, and nothing else."""
    if line["bank"] == "foreign":
        return line[side]["judged"] in ("right", "class")
    return bool(line[side]["class"])


def varies_right(line: dict, side: str) -> bool:
    """Tell whether the effect that varied by flight, day or command is reported, and nothing is
    named.
    """
    answer = line[side]
    expected = line["kind"].rpartition(":")[2]
    if line["kind"] == "lost":
        return not answer["named"] and "dropped_commands" in answer["varies"]
    if line["kind"].startswith(sealed.DRIFTING):
        return not answer["named"] and any(expected in of for of in answer["drifts"])
    stated = any(expected in name or name == RANDOM.get(expected) for name in answer["varies"])
    return not answer["named"] and stated


def check_coverage(lines: Iterable[dict], side: str) -> list[bool]:
    """Return for each hidden effect that was named whether its interval holds the truth."""
    named = [
        e for line in lines for e in line[side].get("errors", ()) if e["named"] and e["estimate"]
    ]
    return [e["low"] <= e["truth"] <= e["high"] for e in named]


def gains(lines: Iterable[dict], side: str) -> np.ndarray:
    """Return the share of the lost evidence on held-out throws that each answer recovers."""
    held = [line["held"] for line in lines if "held" in line and line["held"]["before"] > 20.0]
    return np.array([1.0 - h[side] / h["before"] for h in held])


def rightly(test: Callable[[dict, str], bool]) -> Callable[[dict, str], bool]:
    """Return a test that an answer which is an error does not pass."""
    return lambda line, side: not line[side]["error"] and test(line, side)


def compare_pairs(lines: list[dict], test: Callable[[dict, str], bool]) -> str:
    """Return how many worlds only one side has right, and the sign test's probability."""
    from scipy.stats import binomtest

    right = [[test(line, side) for side in SIDES] for line in lines]
    old = sum(o and not n for o, n in right)
    new = sum(n and not o for o, n in right)
    chance = binomtest(old, old + new).pvalue if old + new else 1.0
    return f"only old {old}, only new {new}, p = {chance:.2f}"


def compare(args: argparse.Namespace) -> None:
    """Print names, nulls, laws, coverage, gain and seconds of both sides."""
    text = "".join(path.read_text() for path in args.ledgers)
    lines = [json.loads(line) for line in text.splitlines()]
    failed = [line for line in lines if "failed" in line]
    lines = [line for line in lines if "failed" not in line]
    sides = [side for side in SIDES if all(side in line for line in lines)]
    late = [line for line in lines if any(line[s]["error"] == sealed.NOT_WAITED for s in sides)]
    lines = [line for line in lines if line not in late]
    print(f"{len(lines)} worlds answered by {' and '.join(sides)}")
    print(f"{len(failed)} not flown, {len(late)} cut off")
    for side in sides:
        errors = [line[side]["error"] for line in lines if line[side]["error"]]
        print(f"{side}: {len(errors)} answers are errors, which count as wrong: {errors[:1]}")
    tests = (
        ("nulls without a name", is_null, lambda line, side: not line[side]["named"]),
        ("names up to class", has_names, names_right),
        ("  singles", lambda line: line["kind"].startswith("1x"), names_right),
        ("  pairs", lambda line: line["kind"].startswith("2x"), names_right),
        ("  triples", lambda line: line["kind"].startswith("3x"), names_right),
        ("  foreign", lambda line: has_names(line) and line["bank"] == "foreign", names_right),
        ("worlds without a wrong name", has_names, has_no_wrong_name),
        ("laws: UNKNOWN, no name", is_outside, judge_outside_law),
        ("  in the grammar", lambda line: line["kind"] == "law", judge_outside_law),
        ("  beyond it", lambda line: line["kind"] == "beyond", judge_outside_law),
        ("varies, drifts, lost", is_varying, varies_right),
    )
    tests = tuple((name, belongs, rightly(test)) for name, belongs, test in tests)
    for name, belongs, test in tests:
        part = [line for line in lines if belongs(line)]
        if not part:
            continue
        for side in sides:
            print(f"{name:30} {side} {interval(sum(test(p, side) for p in part), len(part))}")
        if len(sides) > 1:
            print(f"{'':30} {compare_pairs(part, test)}")
    for kind in sorted({line["kind"] for line in lines if is_null(line)}):
        part = [line for line in lines if line["kind"] == kind]
        names = [f"{side} {sum(bool(line[side]['named']) for line in part)}" for side in sides]
        print(f"{kind:30} false names: {', '.join(names)} of {len(part)}")
    for side in sides:
        inside = check_coverage(lines, side)
        print(f"{'95 % intervals hold the truth':30} {side} {interval(sum(inside), len(inside))}")
        gain = gains(lines, side)
        quarters = np.percentile(gain, [10, 25, 50, 75]) if len(gain) else []
        print(f"{'gain on throws held back':30} {side} n {len(gain)}, 10-25-50-75 %: {quarters}")
    for bank in ("sealed", "foreign"):
        seconds = np.array([[p[s]["seconds"] for s in sides] for p in lines if p["bank"] == bank])
        if len(seconds):
            ratio = np.exp(np.mean(np.log(seconds[:, -1] / seconds[:, 0])))
            print(
                f"CPU seconds, {bank}: median {np.median(seconds, axis=0)}, mean"
                f" {seconds.mean(0)}, geometric mean of the ratio {ratio:.2f}"
            )
    if args.list:
        print_differences(lines, tests, sides)


def is_varying(line: dict) -> bool:
    """Tell whether something was hidden that differs by flight, day or command."""
    return line["kind"] == "lost" or line["kind"].startswith((sealed.VARYING, sealed.DRIFTING))


def judge_outside_law(line: dict, side: str) -> bool:
    """Tell whether a hidden law is UNKNOWN without a name."""
    unknown = line[side]["overall"].startswith(("UNKNOWN", "EXPLAINED IN PART"))
    return unknown and not line[side]["named"]


def has_no_wrong_name(line: dict, side: str) -> bool:
    """Tell whether no name stands for nothing that was hidden."""
    if line["bank"] == "foreign":
        return line[side]["judged"] != "false"
    return not line[side]["wrong"]


def print_differences(lines: list[dict], tests: tuple, sides: list[str]) -> None:
    """Print each world that a side has wrong."""
    for name, belongs, test in tests:
        for line in lines:
            if name.startswith(" ") or not belongs(line) or all(test(line, s) for s in sides):
                continue
            hidden = line.get("recipe", {}).get("effects", line.get("seed"))
            answers = [
                f"{side} {'ok' if test(line, side) else 'NO'} {line[side]['overall']}"
                f" {line[side]['named']} {line[side].get('varies', '')} {line[side]['error'][:60]}"
                f" {' | '.join(line[side].get('reasons', ()))}"
                for side in sides
            ]
            print(f"{name}: {line['kind']} {hidden}\n    " + "\n    ".join(answers))


def main(argv: Sequence[str] | None = None) -> None:
    """Answer banks, or compare the answers of a ledger; ``argv``: in place of the program's."""
    parser = argparse.ArgumentParser(description=__doc__)
    actions = parser.add_subparsers(dest="action", required=True)
    ask = actions.add_parser("answer", help=answer.__doc__)
    ask.add_argument("--trees", nargs="+", required=True, help="checkouts: old, new; or new alone")
    ask.add_argument("--banks", nargs="*", default=[], help="files of arguments of sealed")
    ask.add_argument("--foreign", nargs="*", default=[], help="lists of seeds of foreign")
    ask.add_argument("--skip", nargs="*", type=int, default=[], help="seeds used in development")
    ask.add_argument("--longest", nargs="*", default=[], help="kinds of worlds that begin first")
    ask.add_argument("--jobs", type=int, default=2)
    ask.add_argument("--worlds", type=int, help="so many of them alone")
    ask.add_argument("--seconds", type=float, default=1e6, help="of wall clock, in all")
    ask.add_argument("--last", type=float, default=0.0, help="begin no world in the last seconds")
    ask.add_argument("--ledger", type=Path, required=True)
    judge = actions.add_parser("compare", help=compare.__doc__)
    judge.add_argument("ledgers", type=Path, nargs="+")
    judge.add_argument("--list", action="store_true", help="print worlds that a side has wrong")
    args = parser.parse_args(argv)
    {"answer": answer, "compare": compare}[args.action](args)


if __name__ == "__main__":
    main()
