"""``visthrow bench``: speed of the simulator, of the camera and of a training iteration; what was recorded before."""

import argparse

from visthrow.common.arguments import add_common

KINDS = {
    "sim": ("the simulator: on a CPU core against MuJoCo C, on a GPU against MuJoCo Warp", "visthrow.evidence.bench.sim.command"),
    "camera": ("keypoints of thousands of environments against kornia and OpenCV", "visthrow.evidence.bench.camera"),
    "detector": ("recall, precision and pixel error of the keypoint detector on rendered frames", "visthrow.evidence.bench.detector"),
    "train": ("where the wall time of a training iteration goes", "visthrow.evidence.bench.iteration"),
    "hil": ("the HIL runner over loopback: latency and soak, throws over the wire, faults", "visthrow.evidence.bench.hil.command"),
    "mpc": ("a step of the baseline's controller, and its tracking error", "visthrow.evidence.bench.mpc"),
    "explain": ("seconds of a diagnosis and of its report, on logs of one's own", "visthrow.evidence.bench.explain"),
    "records": ("print the recorded measurements as Markdown", "visthrow.evidence.bench.records"),
}
"""Name -> (help, module). The module has ``run(args) -> int``; it is imported only when chosen."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from visthrow.diagnose.inputs import opening

    parser.epilog = (
        "examples:\n"
        "  visthrow bench sim                             one CPU core against MuJoCo C on the same rope\n"
        "  visthrow bench sim --device cuda               steps a second over batch sizes on a GPU\n"
        "  visthrow bench camera                          keypoints on the CPU, and on the GPU if there is one\n"
        "  visthrow bench detector --out out/sheet.png    the ball and goal detector by nuisance, 15 minutes\n"
        "  visthrow bench train state --device cuda       simulation, environment, inference and learning\n"
        "  visthrow bench hil --minutes 1                 message in to command out, missed ticks, memory\n"
        "  visthrow bench hil --throws 60 --policy state  throws over the wire, and the same without it\n"
        "  visthrow bench mpc                             a step of the baseline's controller; needs piqp\n"
        "  visthrow bench explain monday/*.npz            seconds of a diagnosis and of its report\n"
        "  visthrow bench records                         what was measured before, on which machine and commit\n"
    )
    kinds = parser.add_subparsers(dest="bench", metavar="WHAT", title="what to measure", required=True)
    sim, camera, detector, train, hil, mpc, explain, records = (
        kinds.add_parser(name, help=text, description=text) for name, (text, _) in KINDS.items()
    )
    _add_sim(sim)
    camera.add_argument("--environments", type=int, default=16384, metavar="N", help="batch size (default: 16384)")
    detector.add_argument("--frames", type=int, default=100, metavar="N", help="scenes a level (default: 100)")
    detector.add_argument("--seed", type=int, default=0, help="of the scenes")
    detector.add_argument("--jobs", type=int, metavar="N", help="processes at once (default: one a core)")
    detector.add_argument("--out", metavar="FILE", help="write a contact sheet of the first scenes there, .png")
    train.add_argument(
        "config", metavar="CONFIG", nargs="?", default="state", help="training configuration (default: state)"
    )
    train.add_argument("--iterations", type=int, default=5, metavar="N", help="iterations measured (default: 5)")
    _add_hil(hil)
    opening.add_arguments(explain)
    explain.add_argument("--no-report", action="store_true", help="measure the verdicts only")
    for kind in (sim, camera, train, explain):
        kind.add_argument(
            "--repeats", type=int, default=5, metavar="N", help="measurements; the median counts (default: 5)"
        )
    mpc.add_argument("--throws", type=int, default=10, metavar="N", help="a target and plant (default: 10)")
    for kind in (sim, mpc):
        kind.add_argument("--core", type=int, metavar="N", help="CPU core to stay on (default: the last one)")
    for kind in (sim, mpc):
        kind.add_argument(
            "--config", default="state", metavar="NAME", help="training configuration whose plant is measured (default: state)"
        )
    for kind in (sim, camera, detector, train):
        add_common(kind)
    add_common(mpc, device=False)
    for kind in (sim, camera, detector, train, hil, mpc, explain):
        kind.add_argument("--record", metavar="NAME", help="keep the result in the package's records under this name")
    sim.set_defaults(device="cpu")
    explain.set_defaults(device="cpu", repeats=2)
    records.add_argument("names", metavar="NAME", nargs="*", help="records to print (default: all)")


def _add_hil(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--policy", default="vision", metavar="POLICY", help="a shipped name or a file (default: vision)")
    parser.add_argument("--minutes", type=float, default=1.0, metavar="N", help="of the soak, in real time (default: 1)")
    parser.add_argument("--rate", type=float, default=200.0, metavar="HZ", help="of poses in the soak (default: 200)")
    parser.add_argument("--core", type=int, metavar="N", help="CPU core that the runner is kept on in the soak")
    parser.add_argument("--keep", metavar="FOLDER", help="keep the soak's run here")
    parser.add_argument("--throws", type=int, default=0, metavar="N", help="throw so often instead; may be interrupted")
    parser.add_argument("--seed", type=int, default=0, help="of the first throw (default: 0)")
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N",
        help="throws or faults at once, each with a core for the run and one for the fake where there are enough (default: 1)",
    )  # fmt: skip
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X",
        help="of both clocks in throws and faults; below 1 on a machine too slow for real time",
    )  # fmt: skip
    parser.add_argument("--out", default="out/hil", metavar="FOLDER", help="of the series (default: out/hil)")
    parser.add_argument("--keep-runs", action="store_true", help="keep the run folder of each throw, for hil view")
    parser.add_argument("--faults", nargs="*", metavar="NAME", help="inject these faults instead (default: each in turn)")
    parser.add_argument("--json", metavar="FILE", help="write the printed figures to this file as well")


def _add_sim(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--batch",
        type=int,
        nargs="+",
        metavar="N",
        help="environments; several on a GPU (default: 1024 on the CPU, 4096 to 524288 on a GPU)",
    )
    parser.add_argument(
        "--seconds", type=float, default=1.0, metavar="S", help="wall time of one measurement, about (default: 1)"
    )
    parser.add_argument("--without-mujoco", action="store_true", help="measure this simulator alone")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    import importlib

    return importlib.import_module(KINDS[args.bench][1]).run(args)
