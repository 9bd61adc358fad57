"""``visthrow sweep``: do lists of training runs and throws in resumable units, on several GPUs or a
cluster.
"""

import argparse
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from visthrow.common.arguments import EXIT_INTERRUPTED, declare
from visthrow.common.errors import ConfigError

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Run the chosen action on a list."""
    from visthrow.paper.sweep import sweep_record as record
    from visthrow.paper.sweep.work_units import load_list

    if args.action == "run" and args.minutes is not None and args.minutes <= 0:
        raise ConfigError(f"--minutes {args.minutes:g}; expected more than 0")
    work = load_list(args.list, tuple(args.overrides))
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out} is a file; expected a folder")
    if args.action == "status":
        lines, done = record.status(work, out)
        print("\n".join(lines))
        return 0 if done else 1
    if args.action == "collect":
        for path in record.collect(work, out, Path(args.records or out / "records")):
            print(path)
        return 0
    return _run(args, work, out) if args.action == "run" else _work(args, work, out)


def _run(args: argparse.Namespace, work: Any, out: Path) -> int:
    from sim.cores import cores
    from visthrow.common import compute_device
    from visthrow.paper.sweep.pool import Local, ProcessPool

    changes = tuple(args.overrides)
    jobs = args.jobs or cores()
    begin = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - begin:6.0f} s  {text}", flush=True)

    # a batch system's signal also leads to checkpoints
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if args.slurm is not None:
            outcome = ProcessPool(work, out, _cluster(args, out, jobs, changes), say).run()
        else:
            starter = Local(
                args.list,
                out,
                [compute_device.resolve(name) for name in args.devices.split(",")],
                jobs,
                changes,
            )
            outcome = ProcessPool(work, out, starter, say).run(args.minutes)
    finally:
        signal.signal(signal.SIGTERM, before)
    for name, reason in outcome.failed.items():
        print(f"{name} failed: {reason}; its output is in {out / 'logs'}", file=sys.stderr)
    if outcome.stopped:
        print("stopped before the end; the same command continues", file=sys.stderr)
    if outcome.interrupted:
        return EXIT_INTERRUPTED
    return 1 if outcome.failed else 0


def _cluster(args: argparse.Namespace, out: Path, jobs: int, changes: tuple[str, ...]) -> Any:
    from visthrow.paper.sweep.cluster import Cluster

    wrong = [item for item in args.slurm if "=" not in item]
    if wrong or not args.devices.isdigit() or args.minutes is None:
        raise ConfigError(
            f"--slurm {' '.join(args.slurm)} --devices {args.devices} --minutes {args.minutes};"
            " expected KEY=VALUE, the number of GPUs to use at once, and the length of a job"
        )
    options = {f"slurm_{key}": value for key, value in (item.split("=", 1) for item in args.slurm)}
    return Cluster(args.list, out, "slurm", int(args.devices), jobs, args.minutes, changes, options)


def _work(args: argparse.Namespace, work: Any, out: Path) -> int:
    from visthrow.paper.sweep.work import work as do

    if not args.units:
        raise ConfigError("sweep work: no --units; expected ids as `visthrow sweep run` gives them")
    # in a background job of a shell SIGINT is ignored, which child processes inherit
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if args.parent:
        threading.Thread(target=_follow, args=(args.parent,), daemon=True).start()
    return do(work, out, args.units.split(","), args.device, args.minutes)


def _follow(parent: int) -> None:
    """Interrupt this process like Ctrl-C when its parent has ended."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGINT)
