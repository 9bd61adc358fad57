"""The loop closed on Betaflight's firmware: throws before, the diagnosis, throws after.

    python -m bench.sitl.loop
        # the committed record
    python bench/sitl/alone.py python -m bench.sitl.loop --name after
        # and again
    python bench/sitl/alone.py python -m bench.sitl.loop --name gains --policy vision

Each series is twenty throws at 1.5, 2.0 and 2.5 m through the firmware, in lock step, poses with 1
mm and 0.2 deg of noise at 100 Hz, and the same throws on our own block with the policy's own
vehicle (``own``). An interrupted series resumes. The record keeps error and separation of each
throw; runs and blackboxes stay in the folder."""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from bench.direct import Direct
from bench.sitl.direct import throw
from hil.params import HilParams
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.sitl.test_betaflight import program
from visthrow import config
from visthrow.common import provenance
from visthrow.onboard.policy import Policy, find_policy
from visthrow.throws.wire_plant import make, make_motors

RECORD = Path(__file__).with_name("betaflight-4.6.0.json")
DISTANCES = (2.0, 1.5, 2.5)


def fly_throw(
    where: str, distance: float, seed: int, policy: str, plant: str, folder: Path
) -> dict:
    """Fly one throw, through the firmware or on our block; returns its line."""
    params = config.load(
        HilParams,
        config.find("hil", "betaflight_sitl"),
        [f"goal_w=[{distance},0.0,0.0]", f'policy="{policy}"'],
    )
    loaded = Policy.load(find_policy(policy))
    if where == "own":
        report = Direct(make(policy, seed), loaded, params, FakeMocapParams(), seed).throw()
    else:
        report = throw(
            program(),
            folder / f"{distance:g}-{seed:02d}",
            params,
            loaded,
            make_motors(plant, seed),
            FakeMocapParams(),
            seed,
        )
    landing = report["landing_w"]
    error = None if landing is None else round(math.hypot(landing[0] - distance, landing[1]), 5)
    why = report.get("run", {}).get("reason", "")
    return {
        "where": where,
        "distance": distance,
        "seed": seed,
        "error": error,
        "landing_w": landing,
        "ended": why,
    }


def series(args: argparse.Namespace) -> list[dict]:
    """Fly the missing throws of a series."""
    args.out.mkdir(parents=True, exist_ok=True)
    lines = args.out / f"{args.name}.jsonl"
    throws = [json.loads(text) for text in lines.read_text().splitlines()] if lines.exists() else []
    done = {(line["where"], line["distance"], line["seed"]) for line in throws}
    for where in ("firmware", "own"):
        for distance in args.distances:
            for seed in range(args.seeds):
                if (where, distance, seed) not in done:
                    throws.append(
                        fly_throw(
                            where, distance, seed, args.policy, args.plant, args.out / args.name
                        )
                    )
                    with open(lines, "a") as out:
                        out.write(json.dumps(throws[-1]) + "\n")
                    print(json.dumps(throws[-1]), flush=True)
    return throws


def table(record: dict) -> str:
    """A record as a table of Markdown: mean, greatest error [m], and how many landed."""
    out = [
        "| | " + " | ".join(f"{d:g} m" for d in sorted(DISTANCES)) + " |",
        "|---|" + "---|" * len(DISTANCES),
    ]
    for name, one in record.items():
        for where, words in (("firmware", "through the firmware"), ("own", "on our own block")):
            cells = []
            for distance in sorted(DISTANCES):
                throws = [
                    t for t in one["throws"] if t["where"] == where and t["distance"] == distance
                ]
                errors = [t["error"] for t in throws if t["error"] is not None]
                text = (
                    f"{np.mean(errors):.3f} m (to {max(errors):.3f})" if errors else "none landed"
                )
                cells.append(f"{text}, {len(errors)} of {len(throws)}")
            out.append(f"| {name}, {one['policy']}, {words} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def draw(path: Path, record: dict) -> None:
    """Draw where the throws through the firmware landed: a panel a distance, the goal in the
    middle.
    """
    from visthrow.view import style

    style.use()
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(DISTANCES), figsize=(9.6, 2.7), sharex=True, sharey=True)
    for axis, distance in zip(axes, sorted(DISTANCES)):
        for i, one in enumerate(record.values()):
            points = [
                t["landing_w"]
                for t in one["throws"]
                if t["where"] == "firmware" and t["distance"] == distance
            ]
            x, y = 100.0 * (np.array(points)[:, :2] - [distance, 0.0]).T
            axis.plot(x, y, "ox"[i % 2], color=style.COLOURS[i], ms=4.5, label=one["policy"])
        axis.add_patch(plt.Circle((0.0, 0.0), 3.0, fill=False, color=style.INK, lw=0.8))
        axis.set(xlabel="beyond the goal [cm]", title=f"{distance:g} m", aspect="equal")
    axes[0].set_ylabel("to the left [cm]")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="lower center",
        ncols=len(record),
        fontsize=8,
        bbox_to_anchor=(0.5, -0.07),
    )
    figure.tight_layout()
    figure.savefig(path, dpi=110, bbox_inches="tight")


def main() -> None:
    """Show the record, or make a series of it anew."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--name", choices=("gains", "after"), help="of the series to fly; left out: show the record"
    )
    parser.add_argument(
        "--policy", default="vision_betaflight", help="that throws: a shipped name or a file"
    )
    parser.add_argument(
        "--plant", default="vision", help="policy whose vehicle is behind the firmware"
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="throws of each distance (default: 20)"
    )
    parser.add_argument("--distances", type=float, nargs="+", default=DISTANCES)
    parser.add_argument("--out", type=Path, default=Path("out/loop"))
    parser.add_argument(
        "--record", action="store_true", help="keep the series in the committed record"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the record's landings")
    args = parser.parse_args()
    record = json.loads(RECORD.read_text())
    if args.name:
        made = {
            "policy": Path(args.policy).stem,
            "commit": provenance.commit(),
            "throws": series(args),
        }
        record["loop"] = {**record.get("loop", {}), args.name: made}
        if args.record:
            RECORD.write_text(json.dumps(record, indent=1) + "\n")
    print(table(record["loop"]))
    if args.picture:
        draw(args.picture, record["loop"])


if __name__ == "__main__":
    main()
