"""Sealed worlds: hide effects, fly, hand over a folder of logs, read the verdict, and only then
compare with the truth.

The tool runs in a separate process that cannot import the tests, in a folder that holds only logs
and the model's configuration. The truth's SHA-256 is recorded before, the verdict's after. Three
more throws of each world are held out; the models with the verdict's sizes and with the true ones
predict them.

    python -m bench.diagnose.sealed null=10 1x15=20 2x10=5 curve=50 sight=20 law=5 \\
        --jobs 8 --ledger ledger.jsonl
    python -m bench.diagnose.ledger ledger.jsonl
"""

import argparse
import hashlib
import json
import multiprocessing as mp
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from bench.worlds.world import (
    CAMERA_FLOORS,
    COLOURS,
    FLOORS,
    PLANTS,
    Recipe,
    draw,
    dust_of,
    fly_recipe,
    record_flights,
)
from visthrow.common.errors import VisthrowError
from visthrow.diagnose.likelihood.threads import limit_to_one_thread
from visthrow.logs.flightlog import Channel, FlightLog

WITHOUT_TESTS = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name == "tests" or name.startswith("tests."):
            raise ImportError("the tool asked for the tests")
sys.meta_path.insert(0, Blocker())
from visthrow.cli import main
sys.exit(main(sys.argv[1:]))
"""

ALIKE = (
    {
        "thrust_gain",
        "mass_quad",
        "air_density",
    },  # only the ratio of thrust to weight shows, of a vehicle of unknown mass
    {
        "mass_payload",
        "rope_mass",
        "downwash",
    },  # all pull at the mount alike, but for a centimetre of lever
    {"rope_length", "payload_offset", "payload_marker_z"},  # a few grams of rope apart
)
"""Effects that flights of this kind hardly separate."""

LAWS = {
    "law_ball_swirl": 0.02,
    "law_vehicle_swirl": 0.05,
    "law_speed_thrust": 0.02,
    "law_slew_thrust": 0.008,
    "law_joint_square": 2e-4,
}
"""Terms that no entry of the catalogue has, with sizes that show: see
:class:`bench.worlds.vehicle.Numbers`.
"""
BEYOND = {"law_power_drag": 0.06, "law_sink_push": 0.08}
"""Laws that no term of the tool's grammar has: an exponent between, a switch."""

MEASURED = ("--measured", "air_density=0.003")
"""Measurements that the user states: barometer and thermometer of the hall.

In all these worlds the air is as dense as the model's.
"""

NOT_WAITED = "timeout"
"""Error of a world whose verdict was cut off by the time limit."""

JUDGED = ("exact", "class", "own_class", "wrong", "missed")
"""Fields that are counted over the answered worlds."""

TERMS = {
    "law_ball_swirl": "F_p = c (z x v_p)",
    "law_vehicle_swirl": "F = c (e_z x v)",
    "law_speed_thrust": "F = c T v_xy e_z",
    "law_slew_thrust": "F = c dT/dt e_z",
    "law_joint_square": "M_j = c |Ω| Ω",
}
"""The same as the tool writes them."""

CURVE = (
    "rope_length",
    "cmd_delay",
    "motor_tau",
    "release_lag",
    "payload_drag",
    "wind_x",
    "com_x",
    "marker_rot_x",
    "frame_tilt_x",
    "thrust_gain",
)
"""Effects with a required detection limit, of plants without a camera."""
SIGHT = ("camera_tilt_x", "camera_latency", "marker_rot_x", "mocap_delay_quad")
"""Effects with a required detection limit with a camera, and effects that resemble them."""
HELD = 3
"""Held-out throws."""
VARIES = {
    "release_lag": (5e-3, 12e-3),
    "wind_x": (0.5, 1.2),
    "cmd_delay": (3e-3, 8e-3),
    "mass_payload": (3e-3, 8e-3),
    "thrust_gain": (0.02, 0.05),
}
"""Effects that differ from flight to flight, with the range of their deviation."""
SMALL = dict(free=2, free_seconds=4.0, throws=6)
"""Flights of worlds that take seconds."""
LOST = (0.05, 0.15)
"""Share of commands that never arrive."""
DUSTY = "+dust"
DUST = 0.5
"""End of the kinds whose worlds have some of every other effect, and its deviation in floors."""
SMALLEST = 3.0
LARGEST = 30.0
"""Sizes of the completeness curves [floors]."""
NEAREST = 3.0
NEXT = 8.0
"""Those about the limits themselves, which lie at 4 to 9 floors."""
LIMIT = "limit:"
NULL = "null:"
VARYING = "varies:"
DRIFTING = "drifts:"
"""Prefixes of the kinds that hide one named effect about its limit; nothing; one that differs from
flight to flight, or by day.
"""
DAYS = 4
"""Of worlds with effects that drift."""
FAINTEST = 1.0
PLAINEST = 15.0
"""Those of the curves with a camera, whose limits lie at 5 or 6 floors."""


def flight_log(record: dict, day: int | None = None) -> FlightLog:
    """The recording of a world as the package's flight log; with the ``day`` that it is of, if
    there are several.
    """
    t = record["time"]
    visible = np.isfinite(record["pos"][:, 0])
    ball_visible = np.isfinite(record["ball"][:, 0])
    channels = {
        "pos_w": Channel(t, np.nan_to_num(record["pos"]), "m", "world", visible),
        "quat_wb": Channel(
            t, np.nan_to_num(record["quat"][:, [1, 2, 3, 0]]), "1", "world", visible
        ),
        "payload_pos_w": Channel(t, np.nan_to_num(record["ball"]), "m", "world", ball_visible),
        "command": Channel(record["sent_time"], record["sent"], "N, rad/s", "body"),
        "battery_voltage": Channel(record["sent_time"], record["volt"], "V"),
    }
    release_command = np.zeros(len(record["sent_time"]))
    if record["release"] is not None:
        release_command[record["sent_time"] >= record["release"] - 1e-9] = 1.0
    channels["release_command"] = Channel(record["sent_time"], release_command, "1")
    if "look" in record:
        kept = ~record["look_lost"]
        stamps = record["look_time"]
        channels["keypoints"] = Channel(stamps, record["look"], "1", "image", kept)
        channels["keypoints_valid"] = Channel(stamps, record["look_seen"], "bool")
        channels["goal_w"] = Channel(np.zeros(1), record["goal"][None], "m", "world")
    return FlightLog(channels, {} if day is None else {"day": f"day {day}"})


def model_of(recipe: Recipe) -> list[str]:
    """Overrides that make the model the plant's null: one rod for the rod; as many as the string
    has, and a point for its ball.

    With 15 rods the string's 24 masses would differ by 0.3 mm in a hard throw, which may be named
    as the joints' damping."""
    return {
        "rod": ["rope.segments=1"],
        "string": ["rope.segments=24", "rope.payload_inertia=1e-9"],
        "chain": [],
    }[recipe.plant]


def hand_over(recipe: Recipe, folder: Path, held: Path | None = None) -> list[Path]:
    """Fly a world and write its logs; held-out ones into a separate folder."""
    paths = []
    records = record_flights(recipe, fly_recipe(recipe))
    shown = len(records) - recipe.held
    for i, record in enumerate(records):
        if i < shown or held is not None:
            path = (folder if i < shown else held) / f"flight_{i:02d}.npz"
            flight_log(record, i % recipe.days if recipe.days else None).save(path)
            paths += [path] if i < shown else []
    return paths


def ask(
    logs: list[Path], model: list[str], folder: Path, device: str = "cpu", timeout: float = 900.0
) -> dict:
    """Verdict of ``visthrow diagnose explain`` on logs, run in a separate process; with ``error``
    where it failed or exceeded its time [s].
    """
    answer = folder / "verdict.json"
    command = [sys.executable, "-c", WITHOUT_TESTS, "diagnose", "explain", *(p.name for p in logs)]
    command += [
        "--device",
        device,
        "--json",
        answer.name,
        "--out",
        "report",
        "--no-report",
        *MEASURED,
    ]
    for item in model:
        command += ["--set", item]
    root = Path(__file__).resolve().parents[2]
    known = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    }
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=timeout,
            env=known,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"overall": "ERROR", "error": NOT_WAITED, "findings": []}
    if not answer.exists():
        return {
            "overall": "ERROR",
            "error": (done.stdout + done.stderr).strip().rpartition("\n")[2],
            "findings": [],
        }
    return json.loads(answer.read_text())


def measure_held_back(
    recipe: Recipe, answers: dict[str, dict[str, float]], held: Path
) -> dict[str, float]:
    """Return the nats by which the plain model (``before``) and the sizes of each answer explain
    the held-out throws worse than the truth does.

    See :func:`~bench.diagnose.shortfalls.shortfalls`; the truth is the ``oracle``, with 0;
    ``samples`` is their number. A law outside the catalogue has no size: the plain model then has
    0."""
    from bench.diagnose.shortfalls import shortfalls
    from visthrow.diagnose.throw.throw_model import ThrowModel
    from visthrow.task import load_experiment, plant_of

    sizes = {**answers, "before": {}}
    if not any(name.startswith("law_") for name in recipe.effects):
        sizes["oracle"] = recipe.effects | dust_of(recipe)
    experiment = load_experiment("state", model_of(recipe))
    logs = [FlightLog.load(path) for path in sorted(held.glob("*.npz"))]
    names = sorted(set().union(*sizes.values()))
    model = ThrowModel(
        logs, plant_of(experiment), only=names, camera=experiment.camera if recipe.camera else None
    )
    different = list({json.dumps(s, sort_keys=True): s for s in sizes.values()}.values())
    nats, samples = shortfalls(model, different)
    return {who: nats[different.index(s)] for who, s in sizes.items()} | {"samples": samples}


def named_causes(verdict: dict) -> list[set[str]]:
    """Each cause that was named, as the set of names it may have: one for FOUND, several for a
    CLASS.
    """
    out = []
    for f in verdict["findings"]:
        if f["verdict"] == "FOUND":
            out.append({f["name"]})
        elif f["verdict"] == "CLASS":
            group = {f["name"], *f.get("partners", ())}
            if group not in out:
                out.append(group)
    return out


def find_matches(group: set[str], truth: set[str]) -> set[str]:
    """Hidden effects that a name, or a class of names, matches: the same, or ones that flights
    hardly distinguish.
    """
    return {n for n in truth if group & ({n} | set().union(*(a for a in ALIKE if n in a)))}


def match_names(groups: list[set[str]], truth: set[str]) -> list[str]:
    """The hidden effect that each name, or class of names, matches, each once; "" where there is
    none.

    Exact matches come before effects that flights hardly distinguish."""
    out = [""] * len(groups)
    left = set(truth)
    for meant in (set.intersection, find_matches):
        for i in sorted(range(len(groups)), key=lambda i: len(groups[i])):
            if not out[i] and (possible := meant(groups[i], left)):
                out[i] = min(possible)
                left.remove(out[i])
    return out


def judge(recipe: Recipe, verdict: dict) -> dict:
    """Compare a verdict with the truth.

    ``exact``: every hidden effect named alone and nothing else; ``class``: named alone or in a
    class of truly alike ones; ``own_class``: the same with the classes that the tool makes;
    ``wrong``: names that are none of the hidden effects; ``missed``: hidden effects that were not
    named. A law outside the catalogue has no name: it is ``unknown`` that is right."""
    truth = {n for n in recipe.effects if not n.startswith("law_")}
    groups = named_causes(verdict)
    covered = all(any(n in group for group in groups) for n in truth) and len(groups) == len(truth)
    stands_for = match_names(groups, truth)
    exact = sum(group == {name} for group, name in zip(groups, stands_for))
    hits = set(stands_for) - {""}
    wrong = stands_for.count("")
    return {
        "exact": exact == len(truth) == len(groups),
        "class": hits == truth and not wrong,
        "wrong": wrong,
        "missed": len(truth - hits),
        "named": [sorted(g) for g in groups],
        "overall": verdict["overall"],
        "extra": max(len(groups) - len(truth), 0),
        "own_class": covered,
        "unknown": verdict["overall"].startswith("UNKNOWN"),
        "laws": [law["formula"] for law in verdict.get("laws", ())[:3]],
        "varies": [row["name"] for row in verdict.get("scatter", ()) if row["found"]],
        "drifts": [
            row["of"]
            for row in verdict.get("scatter", ())
            if row["found"] and row.get("by") == "day"
        ],
    }


def errors_of(recipe: Recipe, verdict: dict) -> list[dict]:
    """The finding of each hidden effect: named or not, estimate, deviation, interval, evidence."""
    findings = {f["name"]: f for f in verdict["findings"]}
    kept = ("verdict", "estimate", "sd", "low", "high", "floor", "nats")
    return [
        {"name": name, "truth": theta, "named": findings[name]["verdict"] in ("FOUND", "CLASS")}
        | {k: findings[name].get(k) for k in kept}
        for name, theta in recipe.effects.items()
        if name in findings
    ]


def run_world(
    recipe: Recipe, device: str = "cpu", verdicts: Path | None = None, until: float = np.inf
) -> dict:
    """One sealed world from drawing to judgement: a line of the ledger.

    Args:
        recipe: of the world.
        device: of the diagnosis.
        verdicts: folder for the whole verdict.
        until: deadline of the verdict, by ``time.time()`` [s].
    """
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as apart:
        folder = Path(name)
        held = Path(apart)
        sealed = recipe.digest()
        begin = time.perf_counter()
        logs = hand_over(recipe, folder, held)
        flown = time.perf_counter()
        verdict = ask(
            logs, model_of(recipe), folder, device, float(np.clip(until - time.time(), 1.0, 900.0))
        )
        seconds = time.perf_counter() - flown
        digest = hashlib.sha256(json.dumps(verdict, sort_keys=True).encode()).hexdigest()
        if verdicts is not None:
            verdicts.mkdir(parents=True, exist_ok=True)
            (verdicts / f"{sealed[:12]}.json").write_text(
                json.dumps({"recipe": asdict(recipe)} | verdict)
            )
        line = {
            "truth_sha256": sealed,
            "verdict_sha256": digest,
            "recipe": asdict(recipe),
            "fly_s": round(flown - begin, 1),
        }
        line |= {"explain_s": round(seconds, 1), "errors": errors_of(recipe, verdict)} | judge(
            recipe, verdict
        )
        if "error" in verdict:
            return line | {"error": verdict["error"]}
        if recipe.held and (recipe.effects or verdict.get("theta")):
            try:
                answers = {"after": verdict.get("theta", {})}
                line["held"] = measure_held_back(recipe, answers, held)
            except (VisthrowError, RuntimeError) as error:
                line["held_error"] = repr(error)
    return line


def _strip_prefix(kind: str, begin: str, names: Iterable[str]) -> str:
    """The name that follows the prefix of a kind.

    Raises:
        ValueError: It is none of the names.
    """
    name = kind.removeprefix(begin)
    if name not in names:
        raise ValueError(
            f"kind {kind!r}: no effect or noise {name!r}; there are {', '.join(names)}"
        )
    return name


def draw_world(kind: str, number: int) -> Recipe:
    """A world of a kind:

    ``null``, ``law``, ``curve``, ``limit:NAME``, ``flights`` or ``EFFECTSxFLOORS``; those with a
    camera.

    ``null:COLOUR`` hides nothing behind noise of one of COLOURS, ``varies:NAME`` an effect that
    differs from flight to flight, ``drifts:NAME`` one that differs from day to day, ``lost``
    commands that never arrive, ``beyond`` a law outside the tool's grammar. Those with a camera are
    ``sight``, ``camera`` and ``clear``. ``curve`` and ``sight`` hide one of the effects with a
    required limit, ``limit:NAME`` the named one, about its limit, ``camera`` any of a camera's,
    ``clear`` none. ``KIND+dust`` adds a little of every other effect."""
    if kind.endswith(DUSTY):
        return replace(draw_world(kind.removesuffix(DUSTY), number), dust=DUST)
    rng = np.random.default_rng(number + 7)
    if kind == "clear":
        return draw(
            number,
            0,
            0.0,
            camera=True,
            noise=float(rng.choice([0.5, 1.0, 2.0])),
            dropouts=float(rng.choice([0.0, 0.1])),
        )
    if kind in ("sight", "camera"):
        ends, names = (
            ((FAINTEST, PLAINEST), SIGHT)
            if kind == "sight"
            else ((SMALLEST, LARGEST), tuple(CAMERA_FLOORS))
        )
        floors = float(np.exp(rng.uniform(*np.log(ends))))
        return draw(number, 1, floors, names=(str(rng.choice(names)),), camera=True)
    if kind.startswith(LIMIT):
        name = _strip_prefix(kind, LIMIT, FLOORS)
        return draw(number, 1, float(np.exp(rng.uniform(*np.log((NEAREST, NEXT))))), names=(name,))
    if kind.startswith(NULL):
        return draw(number, 0, 0.0, colour=_strip_prefix(kind, NULL, COLOURS))
    if kind.startswith(VARYING):
        name = _strip_prefix(kind, VARYING, VARIES)
        return draw(number, 0, 0.0, varies={name: float(rng.uniform(*VARIES[name]))})
    if kind.startswith(DRIFTING):
        return replace(draw_world(kind.replace(DRIFTING, VARYING), number), days=DAYS)
    if kind == "lost":
        return draw(number, 0, 0.0, lost=float(rng.uniform(*LOST)))
    if kind == "null":
        rough = {
            "noise": float(rng.choice([0.5, 1.0, 2.0])),
            "gusts": float(rng.choice([0.5, 1.0, 2.0])),
        }
        return draw(number, 0, 0.0, dropouts=float(rng.choice([0.0, 0.1])), **rough)
    if kind == "law":
        name = str(rng.choice(list(LAWS)))
        only_brakes = name == "law_joint_square"  # and makes the string's masses unstable
        size = (
            LAWS[name]
            * float(np.exp(rng.uniform(-0.3, 0.7)))
            * (1.0 if only_brakes else float(rng.choice([-1.0, 1.0])))
        )
        return replace(
            draw(number, 0, 0.0, plants=("rod",) if only_brakes else ("rod", "string")),
            effects={name: size},
        )
    if kind == "beyond":
        name = str(rng.choice(list(BEYOND)))
        size = BEYOND[name] * float(np.exp(rng.uniform(-0.3, 0.7))) * float(rng.choice([-1.0, 1.0]))
        return replace(draw(number, 0, 0.0, plants=("rod", "string")), effects={name: size})
    if kind in ("curve", "flights"):
        floors = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
        if kind == "curve":
            return draw(number, 1, floors, names=(str(rng.choice(CURVE)),))
        return draw(
            number, 1, floors, free=int(rng.integers(1, 9)), throws=int(rng.integers(2, 13))
        )
    effects, _, floors = kind.partition("x")
    return draw(number, int(effects), float(floors))


def bank(seed: int, sizes: dict[str, int]) -> list[tuple[str, Recipe]]:
    """Worlds of a bank, kinds mixed."""
    out: list[tuple[float, str, Recipe]] = []
    for k, (kind, count) in enumerate(sorted(sizes.items())):
        for i in range(count):
            recipe = replace(draw_world(kind, seed + 100_000 * k + 100 * i), held=HELD)
            out.append(((i + 0.5) / count, kind, recipe))
    return [(kind, recipe) for _, kind, recipe in sorted(out, key=lambda item: item[:2])]


def _pin_worker(numbers) -> None:
    """Pin a worker to one core: processes that it starts count that one only."""
    cores = sorted(os.sched_getaffinity(0))
    with numbers.get_lock():
        mine = numbers.value
        numbers.value += 1
    os.sched_setaffinity(0, {cores[mine % len(cores)]})


def _one(task: tuple[str, Recipe, float, float, Path | None]) -> dict | None:
    kind, recipe, begin, until, verdicts = task
    if time.time() > begin:
        return None
    try:
        return {"kind": kind} | run_world(recipe, verdicts=verdicts, until=until)
    except (RuntimeError, ValueError) as error:
        return {
            "kind": kind,
            "recipe": asdict(recipe),
            "error": repr(error),
            "truth_sha256": recipe.digest(),
        }


def warm(plant: str) -> None:
    """Compile the kernels of a plant by flying its smallest world."""
    line = run_world(Recipe(5, plant, {"com_x": 0.002}, free=1, free_seconds=2.0, throws=1, held=1))
    print(
        plant, line["overall"], line["fly_s"], line["explain_s"], line.get("error", ""), flush=True
    )


def main() -> None:
    """Run a bank of sealed worlds and append it to a ledger; worlds in the ledger are skipped."""
    parser = argparse.ArgumentParser(
        description=main.__doc__,
        fromfile_prefix_chars="@",
        epilog="@FILE holds arguments, one a line",
    )
    kinds = (
        "null, null:COLOUR, varies:NAME, drifts:NAME, lost, law, beyond, curve, limit:NAME,"
        " flights, EFFECTSxFLOORS, "
    )
    kinds += "any of these +dust; with a camera sight, camera, clear"
    parser.add_argument("worlds", nargs="*", metavar="KIND=COUNT", help=kinds)
    parser.add_argument(
        "--seed", type=int, help="of the first world; drawn by the system where not given"
    )
    parser.add_argument("--ledger", type=Path, default=Path("ledger.jsonl"))
    parser.add_argument(
        "--verdicts", type=Path, metavar="FOLDER", help="where to keep whole verdicts"
    )
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no world later than this")
    parser.add_argument(
        "--end",
        type=float,
        default=1e6,
        help="minutes after which a missing verdict counts as cut off",
    )
    parser.add_argument(
        "--warm", choices=PLANTS, help="only compile what worlds of this plant need"
    )
    parser.add_argument(
        "--plants",
        nargs="+",
        choices=PLANTS,
        default=PLANTS,
        help="leave worlds of others out, such as without MuJoCo",
    )
    parser.add_argument(
        "--small", action="store_true", help="short flights, as the default tests have them"
    )
    args = parser.parse_args()
    limit_to_one_thread()
    if args.warm:
        warm(args.warm)
        return
    first = int.from_bytes(os.urandom(4), "little") if args.seed is None else args.seed
    print(f"first seed {first}", flush=True)
    done = set()
    if args.ledger.exists():
        done = {json.loads(line)["truth_sha256"] for line in args.ledger.read_text().splitlines()}
    sizes = {kind: int(count) for kind, count in (item.split("=") for item in args.worlds)}
    begin, end = (time.time() + 60.0 * minutes for minutes in (args.minutes, args.end))
    shorter = SMALL if args.small else {}
    worlds = [
        (kind, replace(recipe, **shorter))
        for kind, recipe in bank(first, sizes)
        if recipe.plant in args.plants
    ]
    print(
        f"{len(worlds)} of {sum(sizes.values())} worlds are of the plants {', '.join(args.plants)}",
        flush=True,
    )
    worlds = [(kind, recipe) for kind, recipe in worlds if recipe.digest() not in done]
    tasks = [(kind, recipe, begin, end, args.verdicts) for kind, recipe in worlds]
    tally: dict[str, Counter] = {kind: Counter() for kind in sizes}
    context = mp.get_context("spawn")
    with context.Pool(
        args.jobs, _pin_worker, (context.Value("i", 0),), maxtasksperchild=None
    ) as pool:
        for line in pool.imap_unordered(_one, tasks):
            if line is None:
                continue
            with args.ledger.open("a") as out:
                out.write(json.dumps(line) + "\n")
            failed = line["overall"] == "ERROR"
            tally[line["kind"]].update(
                ["worlds"] + ["failed"] * failed + [k for k in JUDGED if line.get(k) and not failed]
            )
            outcome = {
                k: line.get(k) for k in ("overall", "named", "explain_s", "error") if k in line
            }
            print(
                line["kind"],
                line["recipe"]["plant"],
                line["recipe"]["effects"],
                outcome,
                flush=True,
            )
    for kind, count in tally.items():
        print(kind, dict(count))


if __name__ == "__main__":
    main()
