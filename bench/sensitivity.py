"""Sensitivity of landings to numbers that the paper does not state, and the size of each catalogue
effect at which the error reaches the paper's 0.10 m.

    python -m bench.sensitivity state vision --out out/sensitivity --record sensitivity

``OUT/points.jsonl`` keeps every point; the same command goes on where it stopped.
``OUT/sensitivity.png`` is the picture of it.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench import start
from bench.report import Report, Table, finish
from bench.world_held import register_world_held
from sim.effects.setting import Setting, generalise, specialise
from visthrow.common.arguments import add_option
from visthrow.common.workers import status
from visthrow.config.effects import catalogue
from visthrow.task import Experiment, plant_of
from visthrow.throws.loading import load_policy
from visthrow.training import protocol

TARGET = 2.0
THROWS = 200
SEED = 11
MISS = 0.10
"""Mean landing error of the paper's vehicle at this target [m]."""

SWEEPS = {
    "rope.rope_mass": (0.002, 0.003, 0.004, 0.006, 0.010, 0.015, 0.020),
    "rope.joint_damping": (0.0, 1e-6, 1e-5, 3e-5, 1e-4),
    "rope.payload_inertia": (0.0, 2.1e-5, 4.2e-5, 8.4e-5, 1.68e-4),
}
"""Key of the plant that the paper does not give -> values [kg, N m s, kg m^2]."""

AXES = ("body", "world")
"""Axes in which the wrench of the blocks is held between two exchanges, 2 ms apart."""

BLOCKS = ("sensing", "integrator")
"""Blocks whose effects change logs or numerics, not the plant."""
FIRST = 0.5
GROWTH = 2.0
LAST = 64.0
"""Sizes that are flown, in prior deviations: first, step and last."""

Point = dict[str, Any]


def apply_effect(experiment: Experiment, name: str, theta: float) -> Experiment:
    """Return the experiment with an effect of this size on its plant or camera."""
    plant = plant_of(experiment)
    base = generalise(Setting(plant, experiment.sensing, camera=experiment.camera))
    setting = catalogue()[name].apply(base, theta)
    new = specialise(setting.plant, plant)
    return dataclasses.replace(
        experiment,
        **{part: getattr(new, part) for part in ("vehicle", "rope", "release", "sim", "air")},
        camera=setting.camera,
    )


def measure_throws(experiment: Experiment, policy: Any) -> dict[str, float]:
    """Throws in one plant: mean error, deviation, and share that landed."""
    throws = protocol.throw(experiment, policy.actor(THROWS), TARGET, THROWS, "cpu", SEED)
    error = throws.error[throws.success]
    landed = float(throws.success.mean())
    blank = {"error": math.inf, "deviation": math.inf, "landed": landed}
    return blank if not len(error) else blank | {"error": error.mean(), "deviation": error.std()}


def sizes(name: str, experiment: Experiment) -> Iterator[tuple[int, list[float]]]:
    """Give the signs of an effect, each with sizes that grow to its bound."""
    effect = catalogue()[name]
    base = generalise(Setting(plant_of(experiment), experiment.sensing, camera=experiment.camera))
    if not effect.applies(base) or effect.switch:
        return
    low, high = effect.bound_by(base).bounds
    for sign, most in ((1, high), (-1, -low)):
        count = int(math.log(LAST / FIRST, GROWTH)) + 1
        steps = [FIRST * GROWTH**k * effect.prior_sd for k in range(count)]
        within = [sign * step for step in steps if step < most]
        if most > 0.0:
            yield sign, [*within, *([sign * most] if len(within) < count else [])]


def find_crossing(points: Sequence[tuple[float, float]]) -> float | None:
    """Size at which the error first reaches :data:`MISS`, by straight lines; None where it does
    not.
    """
    before = (0.0, 0.0)
    for size, error in points:
        if error >= MISS:
            share = (MISS - before[1]) / (error - before[1]) if math.isfinite(error) else 1.0
            return before[0] + share * (size - before[0])
        before = (size, error)
    return None


class Points:
    """Flown points, appended to a file line by line."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.path = path
        self.kept = {tuple(row["key"]): row for row in map(json.loads, lines)}

    def get(self, key: tuple[str, str, float], throw: Callable[[], dict[str, float]]) -> Point:
        """Return the point of this key; throws it unless it is in the file."""
        if key not in self.kept:
            status(f"{key[0]}: {key[1]} {key[2]:+.4g}")
            self.kept[key] = {"key": list(key), **throw()}
            with self.path.open("a", encoding="utf-8") as file:
                print(json.dumps(self.kept[key]), file=file)
        return self.kept[key]


def run(args: argparse.Namespace) -> int:
    """Throw, print, write."""
    torch.set_num_threads(1)
    points = Points(Path(args.out) / "points.jsonl")
    figures = {}
    for name in args.policies:
        loaded = load_policy(name)
        figures[name] = {
            "sweeps": _sweeps(name, points),
            "wrench": {axes: _measure_held(name, axes, points) for axes in AXES},
            "effects": _effects(name, loaded.experiment, loaded.policy, points),
        }
    status("")
    picture(figures, Path(args.out) / "sensitivity.png")
    return finish(_report(figures), args)


def _sweeps(name: str, points: Points) -> dict[str, list[tuple[float, float]]]:
    sweeps = {}
    for key, values in SWEEPS.items():
        rows = []
        for value in values:

            def throw(key: str = key, value: float = value) -> dict[str, float]:
                loaded = load_policy(name, None, [f"{key}={value}"], allow=["rope"])
                return measure_throws(loaded.experiment, loaded.policy)

            rows.append((value, points.get((name, key, value), throw)["error"]))
        sweeps[key] = rows
    return sweeps


def _measure_held(name: str, axes: str, points: Points) -> float:
    """Landing error with the wrench held in these axes."""

    def throw() -> dict[str, float]:
        loaded = load_policy(name, None, ["sim.solver=exchanged_chain"])
        with register_world_held() if axes == "world" else contextlib.nullcontext():
            return measure_throws(loaded.experiment, loaded.policy)

    return points.get((name, f"wrench held in {axes}", 0.0), throw)["error"]


def _effects(
    name: str, experiment: Experiment, policy: Any, points: Points
) -> dict[str, dict[str, Any]]:
    effects: dict[str, dict[str, Any]] = {}
    for effect_name, effect in catalogue().items():
        camera = effect.block == "camera" and experiment.task.observation.layout != "vision"
        if effect.block in BLOCKS or camera:
            continue
        signs = {}
        for sign, steps in sizes(effect_name, experiment):
            rows = []
            for size in steps:

                def throw(effect: str = effect_name, size: float = size) -> dict[str, float]:
                    return measure_throws(apply_effect(experiment, effect, size), policy)

                point = points.get((name, effect_name, size), throw)
                rows.append((size, point["error"] if point["landed"] >= 0.5 else math.inf))
                if rows[-1][1] >= MISS:
                    break
            signs["+" if sign > 0 else "-"] = {"size": find_crossing(rows), "points": rows}
        if signs:
            unit = {"unit": effect.unit, "prior_sd": effect.prior_sd, "cause": effect.cause}
            effects[effect_name] = {**unit, **signs}
    return effects


def _report(figures: dict[str, Any]) -> Report:
    tables = []
    for key in SWEEPS:
        head = (key, *(f"{value:g}" for value in SWEEPS[key]))
        rows = [
            (name, *(f"{error:.4f}" for _, error in entry["sweeps"][key]))
            for name, entry in figures.items()
        ]
        tables.append(Table(key, head, tuple(rows)))
    rows = [
        (name, *(f"{entry['wrench'][axes]:.4f}" for axes in AXES))
        for name, entry in figures.items()
    ]
    tables.append(
        Table("Axes in which the wrench is held for 2 ms", ("policy", *AXES), tuple(rows))
    )
    for name, entry in figures.items():
        rows = []
        for effect, row in entry["effects"].items():
            cells = [row.get(sign, {}).get("size") for sign in "+-"]
            rows.append((effect, row["unit"], f"{row['prior_sd']:.3g}", *map(_size, cells)))
        near = [(min(_priors(row)), line) for row, line in zip(entry["effects"].values(), rows)]
        head = ("effect", "unit", "prior deviation", "+", "-")
        title = f"{name}: size at which landings miss by {MISS:.2f} m"
        tables.append(Table(title, head, tuple(line for _, line in sorted(near))))
    note = f"{THROWS} throws at {TARGET} m in the training simulator a point, seed {SEED}."
    return Report("sensitivity", "Sensitivity of the landing", tuple(tables), (note,), figures)


def _priors(row: dict[str, Any]) -> list[float]:
    """Sizes in prior deviations, infinite where there is none."""
    reached = [row.get(sign, {}).get("size") for sign in "+-"]
    return [math.inf if size is None else abs(size) / row["prior_sd"] for size in reached]


def _size(size: float | None) -> str:
    return "-" if size is None else f"{size:+.3g}"


def picture(figures: dict[str, Any], path: Path, shown: int = 16) -> None:
    """Draw the two sweeps, and the effects that reach the miss at the smallest sizes."""
    import matplotlib.pyplot as plt

    drawing, (one, two, three) = plt.subplots(
        1, 3, figsize=(12, 4.2), gridspec_kw={"width_ratios": (1, 1, 1.6)}, layout="constrained"
    )
    for axes, (key, values), factor, label in (
        (one, next(iter(SWEEPS.items())), 1e3, "mass of the rope [g]"),
        (two, list(SWEEPS.items())[1], 1e6, "joint damping [µN m s]"),
    ):
        for name, entry in figures.items():
            error = [1e3 * e for _, e in entry["sweeps"][key]]
            axes.plot(np.array(values) * factor, error, "o-", label=name)
        axes.axhline(1e3 * MISS, color="gray", linestyle=":")
        axes.set(xlabel=label, ylabel="landing error [mm]", ylim=(0.0, 1.1e3 * MISS))
    two.set_xscale("symlog", linthresh=1.0)
    one.legend(frameon=False)
    every: dict[str, float] = {}
    for entry in figures.values():
        for effect, row in entry["effects"].items():
            every[effect] = min(every.get(effect, math.inf), min(_priors(row)))
    names = [e for e in sorted(every, key=every.__getitem__) if math.isfinite(every[e])][:shown]
    for number, (name, entry) in enumerate(figures.items()):
        rows = [
            (k, min(_priors(entry["effects"][e])))
            for k, e in enumerate(names)
            if e in entry["effects"]
        ]
        three.plot([size for _, size in rows], [k + 0.2 * number for k, _ in rows], "o", label=name)
    three.set(xscale="log", xlabel=f"size at a miss of {1e3 * MISS:.0f} mm [prior deviations]")
    three.set_yticks(range(len(names)), names, fontsize=8)
    three.invert_yaxis()
    drawing.savefig(path, dpi=110)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = start.parser_of(__doc__)
    parser.add_argument("policies", nargs="+", help="shipped names or files")
    folder = {"default": "out/sensitivity", "help": "for the points (default: %(default)s)"}
    add_option(parser, "--out", shared=True, **folder)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
