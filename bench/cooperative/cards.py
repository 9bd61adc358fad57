"""Train policies of a pair, each with a drawn seed on the card that is named for it, side by side,
and throw them under every condition of :data:`visthrow.cooperative.team.FAULTS`.

Writes a policy for each and ``results.json``, with curves and figures, into a folder."""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from bench import start

THROWING = 60.0  # time kept for the throws after a training [s]
KEEPING = 45.0  # between two saved policies [s]
TALKING = 10.0  # between two lines of progress [s]
EARLY = 150.0  # a job that fails earlier is restarted without CUDA graphs [s]
THROWS = 200
SEED = 900_000  # of the throws: no training has it


def train_and_throw(args: argparse.Namespace) -> None:
    """One card's work."""
    from visthrow import config
    from visthrow.common import provenance
    from visthrow.common.storage import write_json
    from visthrow.cooperative.team import FAULTS, TeamExperiment
    from visthrow.cooperative.team_training import TeamTraining, throw

    begin = time.time()
    path = config.find("cooperative", args.config)
    experiment = config.load(TeamExperiment, path, args.overrides)
    training = TeamTraining(experiment, args.device, args.seed, args.eager)
    name = f"{args.config}-{args.seed}"
    policy = args.out / f"{name}.npz"
    report = args.reports / f"{name}.json"
    made_by = {"seed": args.seed, "config": config.to_dict(experiment, defaults=False)}
    result = {"config": args.config, "seed": args.seed, "built_s": time.time() - begin}
    result |= {"provenance": provenance.collect(), "curve": [], "throws": []}

    def keep() -> None:
        training.policy(made_by | provenance.collect()).save(policy)
        write_json(report, result)

    throwing = min(THROWING, 0.3 * args.seconds)
    seconds = args.until - time.time() - throwing
    print(f"{name}: trains for {seconds:.0f} s", flush=True)
    spoke = kept = time.time()
    for figures in training.run(seconds):
        now = time.time()
        if not math.isfinite(figures["value"] + figures["surrogate"]):
            print(f"{name}: a loss is not finite: {figures}", flush=True)
            break
        if now - spoke > TALKING or figures["iteration"] < 3:
            spoke = now
            figures["samples"] = figures["iteration"] * training.samples
            result["curve"].append(figures)
            row = {key: round(value, 4) for key, value in figures.items()}
            print(f"{name}: {json.dumps(row)}", flush=True)
        if now - kept > KEEPING:
            kept = now
            keep()
    else:
        keep()
    from visthrow.onboard.policy import Policy

    act = Policy.load(policy).to(args.device).act
    for fault in FAULTS:
        if time.time() > args.until - 10.0:
            print(f"{name}: no time left for {fault}", flush=True)
            break
        options = {"fault": fault, "count": args.throws, "device": args.device, "seed": SEED}
        row = throw(experiment, act, **options)
        result["throws"].append(row)
        print(f"{name}: {json.dumps(row)}", flush=True)
        write_json(report, result)


def job(args: argparse.Namespace, card: int, config: str, seed: int, until: float) -> None:
    """Run one card's work in a process of its own, and once more where it fails early."""
    env = {**os.environ, "CUDA_VISIBLE_DEVICES": str(card), "PYTHONUNBUFFERED": "1"}
    begin = time.time()
    print(f"card {card}: {config}, seed {seed}", flush=True)
    for extra in ([], ["--eager"]):
        words = [str(args.out), "--config", config, "--seed", str(seed), "--until", str(until)]
        words += ["--seconds", str(args.seconds), "--device", args.device, *extra]
        words += ["--throws", str(args.throws), "--reports", str(args.reports)]
        words += [word for change in args.overrides for word in ("--set", change)]
        command = [sys.executable, "-m", "bench.cooperative.cards", *words]
        process = subprocess.Popen(command, env=env)
        try:
            status = process.wait(max(until - time.time(), 1.0))
        except subprocess.TimeoutExpired:
            process.kill()
            status = process.wait()
        spent = time.time() - begin
        print(f"card {card}: {config} {seed}: status {status} after {spent:.0f} s", flush=True)
        if status == 0 or spent > EARLY:
            return


def parse_placement(text: str) -> tuple[str, int]:
    """Read ``CONFIG:CARD``. Raises ArgumentTypeError: other text."""
    config, _, card = text.rpartition(":")
    if not config or not card.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r}; expected CONFIG:CARD, as in pair:0")
    return config, int(card)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=540.0, help="for all of it")
    parser.add_argument(
        "--jobs",
        type=parse_placement,
        nargs="+",
        metavar="CONFIG:CARD",
        default=[("pair", 0), ("pair_vision", 1)],
        help="configurations to train, a seed each, and their cards; one may be named again",
    )
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--throws", type=int, default=THROWS)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--config", help="of configs/cooperative: one job's work")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--reports", type=Path, help="folder of the job's report")
    parser.add_argument("--until", type=float, help="end of the job's work [s since 1970]")
    parser.add_argument("--eager", action="store_true", help="without CUDA graphs")
    return start.main(parser, run, argv)


def run(args: argparse.Namespace) -> int:
    """Run all jobs, or one job's work."""
    args.out.mkdir(parents=True, exist_ok=True)
    if args.config:
        train_and_throw(args)
        return 0
    until = time.time() + args.seconds
    with tempfile.TemporaryDirectory() as folder:
        args.reports = Path(folder)
        jobs = []
        for config, card in args.jobs:
            seed = int.from_bytes(os.urandom(3), "big") % SEED
            jobs.append(threading.Thread(target=job, args=(args, card, config, seed, until)))
        for one in jobs:
            one.start()
        for one in jobs:
            one.join()
        reports = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("*.json"))]
    (args.out / "results.json").write_text(json.dumps(reports, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
