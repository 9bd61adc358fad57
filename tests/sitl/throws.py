"""Throws through Betaflight's firmware: one line of JSON a throw, each run's folder and the firmware's blackbox beside it.

    python tests/sitl/alone.py python tests/sitl/throws.py --out out/firmware --throws 10 --distances 1.5 2.0 2.5 --speed 0.4

Poses have 1 mm and 0.2 deg of noise at 100 Hz. A series that was cut goes on where it was.
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

from hil.fakes.base import Options
from hil.fakes.mocap import MocapParams
from hil.fakes.process import VEHICLE_ID, load_plant, serve
from hil.fakes.sitl import BetaflightSitl, Firmware, favour, needed
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.params import HilParams
from tests.sitl.test_betaflight import program
from visthrow import config

AFTER, GIVEN_UP = 1.2, 25.0
"""Flown on after a landing; flown at most [s]."""


def throw(folder: Path, settings: Path, distance: float, seed: int, args: argparse.Namespace) -> dict:
    """Fly one throw; what became of it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(settings / "eeprom.bin", folder)
    firmware = Firmware(program(), folder)
    firmware.start()
    told = open(folder / "run.txt", "w")  # noqa: SIM115 - the runner's; it ends with it
    runner = subprocess.Popen(
        [sys.executable, "-m", "visthrow.cli", "hil", "run", "--config", args.config, "--auto-arm", "--speed", str(args.speed),
         "--out", str(folder / "run"), "--set", f"goal_w=[{distance},0.0,0.0]", "--set", "realtime.priority=10", "--set",
         "states.abort=0.5", "--set", f'policy="{args.policy}"'],
        stdout=told, stderr=subprocess.STDOUT,
    )  # fmt: skip
    fake = None
    try:
        params = config.load(HilParams, config.find("hil", args.config))
        plant = load_plant("visthrow.throws.wire_plant:make_motors", args.plant or args.policy, seed)
        link = Link(open_port(check_device("udpout:127.0.0.1:14560")), *VEHICLE_ID)
        fake = BetaflightSitl(plant, link, MocapParams(), seed, Options(), params.betaflight)
        favour()
        fake.sensors.start(args.speed)
        report = serve(fake, MonotonicClock(args.speed), GIVEN_UP, folder / "bridge.json", AFTER)
        runner.wait(60.0)
    finally:
        runner.kill()
        runner.wait()
        firmware.stop()
        if fake is not None:
            fake.close()
    landing = report["landing_w"]
    error = None if landing is None else math.hypot(landing[0] - distance, landing[1])
    along = None if landing is None else landing[0] - distance
    return {
        "distance": distance, "seed": seed, "error": error, "along": along, "across": landing and landing[1],
        "lag": landing and report["separation_time"] - report["release_time"], "loop_us": report["loop_us"],
        "late": report["late_periods"] / (report["time"] / plant.period),
    }  # fmt: skip


def main() -> None:
    """Fly the series."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/firmware"))
    parser.add_argument("--throws", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="seed of the first throw")
    parser.add_argument("--distances", type=float, nargs="+", default=[1.5, 2.0, 2.5])
    parser.add_argument("--speed", type=float, default=0.4)
    parser.add_argument("--policy", default="vision_dropout")
    parser.add_argument("--plant", default=None, help="policy whose vehicle is flown (default: that of --policy)")
    parser.add_argument("--config", default="betaflight_sitl")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lines = args.out / "throws.jsonl"
    known = [json.loads(text) for text in lines.read_text().splitlines()] if lines.exists() else []
    done = {(line["distance"], line["seed"]) for line in known}
    settings = args.out / "settings"
    if not (settings / "eeprom.bin").exists():
        firmware = Firmware(program(), settings)
        firmware.set_up(needed(config.load(HilParams, config.find("hil", args.config)).betaflight))
        firmware.stop()
    for seed in range(args.first, args.first + args.throws):
        for distance in args.distances:
            if (distance, seed) in done:
                continue
            line = throw(args.out / f"{distance:g}-{seed:03d}", settings, distance, seed, args)
            with open(lines, "a") as out:
                out.write(json.dumps(line) + "\n")
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
