"""All that needs GPUs, side by side on four cards in some eight minutes: throughput by solver,
trainings through each, their policies thrown crosswise.

Writes a zip of policies for each training, and one of rates, throws and logs, into a folder."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from pathlib import Path
from typing import TextIO

COUNTS = ("1024", "4096", "16384", "65536")
CROSSED = ("chain", "physx", "mujoco_warp")
CHANGES: tuple[tuple[str, ...], ...] = ((), ("sim.substep=0.001",), ("task.start.mass=0.0",))
"""Of a training through PhysX: the first with which the shipped policy lands on this card."""

LANDS = 0.1  # [m], mean landing error of a policy whose plant is in order
STARTUP = 25.0  # [s] of a training, before its clock begins
PROBE = "probe"


def rates(*solvers: str, counts: tuple[str, ...] = COUNTS) -> list[str]:
    """Command that measures throughput."""
    name = "-".join((*solvers, *counts))
    places = ["--json", f"{{out}}/rates-{name}.json", "--device", "cuda:0"]
    return ["bench.engine.rates", "--solvers", *solvers, "--counts", *counts, *places]


def training(config: str, solver: str) -> list[str]:
    """Command that trains."""
    out = f"{{out}}/{config}-{solver}"
    return ["bench.engine.training", config, "--solver", solver, "--out", out]


def throws(policy: str, solver: str, name: str = "") -> list[str]:
    """Command that throws a shipped policy, or the one of a folder of this work."""
    place = f"{{out}}/{policy}/policy.npz" if not name else policy
    raw = ["--json", f"{{out}}/throws-{name or policy}-on-{solver}.json", "--device", "cuda:0"]
    return ["bench.engine.throws", place, "--solvers", solver, *raw]


def crossed(trained: str) -> list[list[str]]:
    """Commands that throw a policy trained here on each solver."""
    return [throws(f"state_fast-{trained}", solver) for solver in CROSSED]


FEWER = ["--set", "ppo.environments=8192"]
Work = list[tuple[list[list[str]], float, float]]
WORK: dict[str, Work] = {
    "mujoco": [
        (
            [
                training(name, "mujoco_warp") + FEWER
                for name in ("state_two_cables", "state_box", "state_fast")
            ],
            900.0,
            105.0,
        ),
        ([rates("mujoco_warp", counts=("65536",))], 50.0, 0.0),
        (
            [throws(f"{x}-mujoco_warp", "mujoco_warp") for x in ("state_two_cables", "state_box")]
            + [throws("state_fast-mujoco_warp", solver) for solver in ("mujoco_warp", "chain")],
            110.0,
            0.0,
        ),
    ],
    "physx": [([rates("physx", counts=("65536",))], 900.0, 0.0)],
}
"""Of a card: commands that run at once, the time that they may take [s], and the time that they
must leave for what comes after them [s]."""


def work(name: str, card: str, out: Path, until: float) -> None:
    """Do the commands of a name on a card; what outlasts its time is ended."""
    env = {**os.environ, "CUDA_VISIBLE_DEVICES": card, "PYTHONUNBUFFERED": "1"}
    changes: list[str] = []
    with open(out / f"{name}.log", "w") as log:
        for group, most, reserve in WORK[name]:
            limit = min(most, until - time.time() - reserve)
            if f"throws-{PROBE}" in " ".join(group[0]):
                changes = probe(group[0], limit, out, env, log)
                continue
            lines = [[part.format(out=out) for part in command] for command in group]
            for line in lines:
                if line[0].endswith("training"):
                    line += ["--seconds", f"{limit - STARTUP:.0f}", *changes]
            run(lines, limit, env, log)


def probe(command: list[str], limit: float, out: Path, env: dict, log: TextIO) -> list[str]:
    """Options of the first changes with which the shipped policy lands; else of the last ones."""
    options: list[str] = []
    for changes in CHANGES:
        options = [part for change in changes for part in ("--set", change)]
        line = [part.format(out=out) for part in command]
        run([[*line, *options]], limit, env, log)
        found = out / f"throws-{PROBE}-on-physx.json"
        row = (
            json.loads(found.read_text())["figures"]["rows"][0]
            if found.exists()
            else {"success": 0.0}
        )
        if row["success"] > 0.9 and row["error_mean"] < LANDS:
            break
        found.unlink(missing_ok=True)
    return options


def run(lines: list[list[str]], limit: float, env: dict[str, str], log: TextIO) -> None:
    """Run commands side by side for a limited time [s], and say how each ended."""
    begin = time.time()
    if limit < 5.0:
        say(f"not begun: {lines[0][:4]}", env, log)
        return
    started = [
        subprocess.Popen([sys.executable, "-m", *line], env=env, stdout=log, stderr=log)
        for line in lines
    ]
    for line, process in zip(lines, started):
        try:
            state = f"status {process.wait(max(0.0, begin + limit - time.time()))}"
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            state = "ended at its limit"
        say(f"{' '.join(line)}: {state}, {time.time() - begin:.0f} s", env, log)


def say(words: str, env: dict[str, str], log: TextIO) -> None:
    """Print what became of a command, and log it."""
    for place in (log, sys.stdout):
        print(f"card {env['CUDA_VISIBLE_DEVICES']}: {words}", file=place, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=430.0, help="for all of it")
    parser.add_argument("--only", nargs="+", default=list(WORK), choices=list(WORK))
    args = parser.parse_args()
    devices = os.environ.get("CUDA_VISIBLE_DEVICES", "0,1,2,3").split(",")
    args.out.mkdir(parents=True, exist_ok=True)
    until = time.time() + args.seconds
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        cards = [
            threading.Thread(target=work, args=(name, card, place, until))
            for name, card in zip(args.only, devices)
        ]
        for card in cards:
            card.start()
        for card in cards:
            card.join()
        folders = [item for item in sorted(place.iterdir()) if item.is_dir()]
        files = {item.name: sorted(item.iterdir()) for item in folders}
        files["rest"] = sorted(place.glob("*.*"))
        for name, packed in files.items():
            with zipfile.ZipFile(args.out / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as file:
                for item in packed:
                    file.write(item, item.name)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
