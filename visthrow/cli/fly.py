"""``visthrow fly``: fly one throw and write a 3D recording and a picture of it."""

import argparse
import sys
from pathlib import Path

from visthrow.common.arguments import declare
from visthrow.common.errors import ConfigError
from visthrow.common.extras import load_extra
from visthrow.common.storage import check_place, writable, write_json
from visthrow.onboard.shipped import find_policy

FILES = {
    "flight.npz": "every signal of the flight; read it with visthrow.logs.flightlog.FlightLog.load",
    "throw.rrd": "the scene in 3D, the image plane and all signals; open it with: rerun",
    "throw.png": "the throw in four pictures",
    "pixels.png": "frames of the throw with what the detector saw",
}


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Fly one throw, write the files and print a summary."""
    save = args.save
    find_policy(args.policy)  # reports an unknown name before heavy imports
    from visthrow.common.compute_device import resolve
    from visthrow.throws.loading import load_policy
    from visthrow.throws.recorded import check_goal, fly

    _check(args)
    loaded = load_policy(args.policy, args.config, args.overrides, args.allow)
    goal = [args.target[0], args.target[1] if len(args.target) == 2 else 0.0, 0.0]
    check_goal(loaded, goal)
    writable(Path(args.out))
    if args.no_rope:
        return _fly_alone(args, loaded.experiment, goal)
    if save:
        check_place(save)
        loaded.policy.save(save)
    if args.plant != "hybrid":
        print("flying on the reference plant; this takes about a minute", file=sys.stderr)
    eyes = None if args.pixels is None else _make_rendered_eyes(loaded, args.pixels, args.seed)
    log = fly(loaded, goal, args.plant, args.seed, resolve(args.device), eyes)
    paths = write(Path(args.out), log, loaded.experiment)
    if eyes is not None:
        paths.append(eyes.sheet(Path(args.out) / "pixels.png"))
    print(summary_text(log))
    for key, value in loaded.departures.items():
        print(f"flown under another condition than in training: {key} = {value}")
    for path in args.export:
        export(path, log, loaded.experiment)
        print(f"{path}  the flight for other programs")
    for path in paths:
        print(f"{path}  {FILES[path.name]}")
    if save:
        print(f"{save}  the policy for these conditions")
    if args.json:
        write_json(
            args.json,
            {
                key: log.meta[key]
                for key in ("policy", "plant", "goal_w", "seed", "times", "result")
            },
        )
    return 0 if log.meta["result"]["success"] else 1


def _check(args: argparse.Namespace) -> None:
    """Raise ConfigError for invalid or contradictory arguments."""
    from visthrow.logs.export import FORMATS
    from visthrow.throws.plants import check_plant

    check_plant(args.plant)
    formats = FORMATS | {".mcap": ("mcap.writer", "recordings")}
    if len(args.target) > 2:
        raise ConfigError(
            f"--target {' '.join(f'{x:g}' for x in args.target)}; expected a distance, or x and y"
        )
    for path in args.export:
        ending = Path(path).suffix
        if ending not in formats:
            raise ConfigError(
                f"--export {path}: ending '{ending}'; expected one of {', '.join(formats)}"
            )
        load_extra(*formats[ending], f"--export {path}", ConfigError)
    if args.no_rope and (args.pixels or args.save or args.export or args.plant != "hybrid"):
        raise ConfigError(
            "--no-rope with --pixels, --save, --export or --plant; expected it without these"
        )
    for override in args.overrides:
        if override.startswith("task.noise.command"):
            raise ConfigError(
                f"--set {override}: fly sends commands as they are, without training's noise;"
                " compare throws with it"
            )


def _fly_alone(args: argparse.Namespace, experiment, goal: list[float]) -> int:
    """Fly without a rope, write the log and print the vehicle's final position error."""
    from visthrow.common.compute_device import resolve
    from visthrow.throws.vehicle_alone import SECONDS, fly_alone

    log = fly_alone(experiment, (goal[0], goal[1]), args.no_rope, resolve(args.device))
    path = Path(args.out) / "flight.npz"
    log.save(path)
    error = log.meta["result"]["error"]
    print(f"after {SECONDS:g} s the vehicle hovers {error:.3f} m from the point above the target")
    print(f"{path}  {FILES[path.name]}")
    return 0


def _make_rendered_eyes(loaded, method: str, seed: int):
    """Return a detector on rendered pictures for a vision policy."""
    rendered = load_extra("visthrow.detector_training.eyes", "detector", "--pixels", ConfigError)
    if loaded.policy.contract["observation"]["layout"] != "vision":
        raise ConfigError(
            f"--pixels with the state policy '{loaded.name}'; expected a vision policy"
        )
    experiment = loaded.experiment
    return rendered.RenderedEyes(
        experiment.camera, experiment.rope, 1, seed, method=method, keep=True
    )


def write(folder: Path, log, experiment) -> list[Path]:
    """Write log, recording and, for a throw that landed, the picture; return their paths."""
    from visthrow.view import rerun_view, strip

    paths = [folder / name for name in list(FILES)[:3]]
    log.save(paths[0])
    rerun_view.write(paths[1], log, experiment)
    if "landing" not in log:
        return paths[:2]
    strip.draw(paths[2], log, experiment.camera)
    return paths


def export(path: str, log, experiment) -> None:
    """Write a flight for other programs in the format of the path's ending."""
    from visthrow.logs import export as tables
    from visthrow.view import mcap_view

    if Path(path).suffix == ".mcap":
        mcap_view.write(path, log, experiment)
    else:
        tables.export(log, path)


def summary_text(log) -> str:
    """Return a summary of the throw in a few lines."""
    meta = log.meta
    times = meta["times"]
    result = meta["result"]
    goal = meta["goal_w"]
    start = times["policy_start"]
    plant = f"{meta['plant_meaning']} (plant {meta['plant']}, seed {meta['seed']})"
    lines = [
        f"policy '{meta['policy']}' on {plant}",
        f"hover   {start:.2f} s until the swing was quiet",
    ]
    if "separation" in times:
        separation_time = log["separation"].values[0]
        lines.append(
            f"throw   release commanded {times['latch'] - start:.2f} s, separation"
            f" {times['separation'] - start:.2f} s after the start, payload at x"
            f" {separation_time[0]:.2f} m, z {separation_time[2]:.2f} m"
        )
    if "landing" in log:
        x, y, _ = log["landing"].values[0]
        lines.append(
            f"landing at x {x:.3f} m, y {y:+.3f} m: {result['error']:.3f} m from the target "
            f"({goal[0]:g}, {goal[1]:g}), {result['duration']:.2f} s after the start"
        )
    if result["failure"]:
        lines.append(f"failed: {result['failure']}")
    end = "hovering again" if result["hovering_again"] else "not hovering again"
    lines.append(
        f"after   {times['end'] - times['recovery']:.1f} s of recovery the vehicle was {end}"
    )
    return "\n".join(lines)
