"""What the runner does when motion capture fails in mid throw, and after how long: each fault over UDP, in real time."""

import argparse
import statistics
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

from visthrow.bench.hil import STILL, json_lines, never_releasing
from visthrow.bench.hil_processes import Pair
from visthrow.bench.records import Report, Table

START, LENGTH = 2.5, 1.2
"""When a fault begins, and how long it is watched [s]."""

QUICK = {"states.check_hold": 0.2, "states.armed_least": 0.1, "states.quiet": 0.1, "states.abort": 0.5, "states.throw": 60.0}
ODOMETRY = (
    'source.senders=[{ body = "vehicle", message = "ODOMETRY", system = 1, component = 1 }, '
    '{ body = "payload", message = "ODOMETRY", system = 1, component = 25 }]'
)
"""The message that carries a reset counter."""


def faults(args: argparse.Namespace) -> Report:
    """Inject each fault in turn."""
    known = import_module("hil.mocap_faults").FAULTS  # the onboard side is not imported by name: it must not need this one
    rows, figures = [], {}
    with tempfile.TemporaryDirectory() as folder:
        policy = never_releasing("state", Path(folder) / "policy.npz")
        for name, (text, _) in known.items():
            found = _one(name, policy, Path(folder) / name)
            figures[name] = found
            done = "; ".join(f"{s['state']} after {s['after']:.2f} s ({s['reason']})" for s in found["states"]) or "flies on"
            rows.append((name, text, done, str(found["commands"]), str(found["releases"]), str(len(found["breaches"]))))
            print(f"{name}: {done}", flush=True)
    notes = (
        f"each fault begins in mid throw, {START:g} s after the first pose, of a policy that never releases; times "
        "count from the first pose that the fault spoiled",
        "a breach is a command that is not finite or beyond the limits of training, or a release that was not armed, was outside "
        "of the fence or came twice, as seen by the vehicle",
    )
    header = ("fault", "what happens", "what the runner did", "commands", "releases", "breaches")
    table = Table("Faults of motion capture over UDP", header, tuple(rows))
    return Report("hil", "What the runner does when motion capture fails", (table,), notes, figures)


def _one(name: str, policy: Path, folder: Path) -> dict[str, Any]:
    settings = [f"{key}={value}" for key, value in QUICK.items()]
    run = ["--config", "fake", "--set", f'policy="{policy}"']
    fake = [*STILL, "--seconds", str(START + LENGTH), "--set", f"mocap_fault={name}", "--set", f"fault_time={START}"]
    if name == "reset":
        settings.append(ODOMETRY)
        fake += ["--set", "pose_message=ODOMETRY"]
    for setting in settings:
        run += ["--set", setting]
    summary, report = Pair(tuple(run), tuple(fake)).fly(folder)
    begin = _begin(folder)
    ticks = json_lines(folder / "ticks.jsonl")
    last = begin + LENGTH - 0.1  # then the fake goes, which is no fault of motion capture
    states, before = [], "throw"
    for tick in ticks:
        if begin <= tick["time"] < last and tick["state"] != before:
            before = tick["state"]
            states.append({"state": before, "after": tick["time"] - begin, "reason": tick["reason"]})
    flying = [tick["state"] for tick in ticks if tick["time"] < begin]
    return {
        "in_throw": bool(flying) and flying[-1] == "throw", "states": states, "commands": report["commands"],
        "releases": report["releases"], "breaches": report["breaches"], "missed": summary["missed"],
    }  # fmt: skip


def _begin(folder: Path) -> float:
    """When the first pose that a fault could spoil was due to arrive, on the runner's clock [s]."""
    rows = [row for row in json_lines(folder / "poses.jsonl") if row[3] == "vehicle"]
    early = [row[2] - row[1] for row in rows if row[1] < START]
    return START + statistics.median(early)
