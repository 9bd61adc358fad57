"""All that needs GPUs, side by side on four cards in some seven minutes: throughput by solver,
trainings through each, their policies thrown crosswise.

Writes a file for each card's work, and what the jobs said, into a folder."""

import argparse
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
SAME_MASS = "task.start.mass=0.0"
"""A change for an engine that cannot take other masses on a GPU: tried where it failed."""

CROSSED = ("chain", "physx", "mujoco_warp")


def rates(*solvers: str, counts: tuple[str, ...] = COUNTS) -> list[str]:
    """Command that measures throughput."""
    name = "-".join((*solvers, *counts))
    places = ["--json", f"{{out}}/rates-{name}.json", "--device", "cuda:0"]
    return ["bench.engine.rates", "--solvers", *solvers, "--counts", *counts, *places]


def training(config: str, solver: str, seconds: int) -> list[str]:
    """Command that trains."""
    place = ["--out", f"{{out}}/{config}-{solver}", "--seconds", str(seconds)]
    return ["bench.engine.training", config, "--solver", solver, *place]


def throws(config: str, trained: str, solver: str) -> list[str]:
    """Command that throws a policy trained here."""
    place = f"{{out}}/{config}-{trained}"
    raw = ["--raw", f"{place}/throws-{solver}.json", "--device", "cuda:0"]
    return ["bench.engine.throws", f"{place}/policy.npz", "--solvers", solver, *raw]


WORK: list[list[tuple[list[str], int]]] = [
    [
        (training("state_fast", "chain", 60), 110),
        (rates("chain", "exchanged_chain"), 60),
        *[(rates("physx", counts=(count,)), 100) for count in COUNTS],
        (throws("state_fast", "chain", "chain"), 40),
        (throws("state_fast", "chain", "physx"), 60),
        (throws("state_fast", "chain", "mujoco_warp"), 100),
    ],
    [
        (training("state_fast", "physx", 270), 320),
        *[(throws("state_fast", "physx", solver), 60) for solver in CROSSED],
    ],
    [
        (training("state_fast", "mujoco_warp", 270), 360),
        *[(throws("state_fast", "mujoco_warp", solver), 60) for solver in CROSSED],
    ],
    [
        (training("state_box", "mujoco_warp", 100), 200),
        (training("state_two_cables", "mujoco_warp", 100), 150),
        (throws("state_box", "mujoco_warp", "mujoco_warp"), 60),
        (throws("state_two_cables", "mujoco_warp", "mujoco_warp"), 60),
        (rates("mujoco_warp"), 100),
    ],
]
"""Of each card: commands, and the time that each may take [s]."""


def work(card: int, out: Path, until: float) -> None:
    """Do one card's commands, one after another; what outlasts its time is ended."""
    env = {**os.environ, "CUDA_VISIBLE_DEVICES": str(card), "PYTHONUNBUFFERED": "1"}
    with open(out / f"card{card}.log", "w") as log:
        for command, most in WORK[card]:
            line = [sys.executable, "-m", *(part.format(out=out) for part in command)]
            for changes in ([], ["--set", SAME_MASS]):
                limit, begin = min(most, until - time.time()), time.time()
                state = run([*line, *changes], limit, env, log)
                words = " ".join([*command[:4], *changes])
                told = f"card {card}: {words}: {state}, {time.time() - begin:.0f} s"
                print(told, file=log, flush=True)
                print(told, flush=True)
                if state != "status 1" or "physx" not in line:
                    break


def run(line: list[str], limit: float, env: dict[str, str], log: TextIO) -> str:
    """Run a command for a limited time [s]; returns how it ended."""
    if limit < 5.0:
        return "not begun: no time left"
    process = subprocess.Popen(line, env=env, stdout=log, stderr=subprocess.STDOUT)
    try:
        return f"status {process.wait(limit)}"
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return f"ended after {limit:.0f} s"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=430.0, help="for all of it")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    until = time.time() + args.seconds
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        cards = [
            threading.Thread(target=work, args=(card, place, until)) for card in range(len(WORK))
        ]
        for card in cards:
            card.start()
        for card in cards:
            card.join()
        for item in sorted(place.iterdir()):
            if item.is_dir():
                with zipfile.ZipFile(args.out / f"{item.name}.zip", "w") as packed:
                    for file in sorted(item.iterdir()):
                        packed.write(file, file.name)
        with zipfile.ZipFile(args.out / "rest.zip", "w", zipfile.ZIP_DEFLATED) as packed:
            for file in sorted(place.glob("*.*")):
                packed.write(file, file.name)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
