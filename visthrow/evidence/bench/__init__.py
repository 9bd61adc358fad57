"""``visthrow bench``: speed of the simulator, of the camera and of a training iteration; what was recorded before."""

import argparse

from visthrow.common.arguments import add_common

KINDS = {
    "sim": ("the simulator: on a CPU core against MuJoCo C, on a GPU against MuJoCo Warp", "visthrow.evidence.bench.sim.command"),
    "camera": ("keypoints of thousands of environments against kornia and OpenCV", "visthrow.evidence.bench.camera"),
    "train": ("where the wall time of a training goes: in an iteration, or to an error", "visthrow.evidence.bench.iteration"),
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
        "  visthrow bench sim --threads 2                 two threads of a CPU against one\n"
        "  visthrow bench sim --device cuda               steps a second over batch sizes on a GPU\n"
        "  visthrow bench camera                          keypoints on the CPU, and on the GPU if there is one\n"
        "  visthrow bench train state --device cuda       simulation, environment, inference and learning\n"
        "  visthrow bench train laptop --until 0.06 0.04  seconds of a whole training to these errors, over seeds\n"
        "  visthrow bench explain monday/*.npz            seconds of a diagnosis and of its report\n"
        "  visthrow bench records                         what was measured before, on which machine and commit\n"
    )
    kinds = parser.add_subparsers(dest="bench", metavar="WHAT", title="what to measure", required=True)
    sim, camera, train, explain, records = (
        kinds.add_parser(name, help=text, description=text) for name, (text, _) in KINDS.items()
    )
    _add_sim(sim)
    camera.add_argument("--environments", type=int, default=16384, metavar="N", help="batch size (default: 16384)")
    train.add_argument("configs", metavar="CONFIG", nargs="*", default=["state"], help="training configurations (default: state)")
    train.add_argument("--iterations", type=int, default=5, metavar="N", help="iterations measured (default: 5)")
    train.add_argument(
        "--until", type=float, nargs="+", metavar="ERROR", help="train until throws at 2.0 m land so near on average [m], and time that"
    )
    train.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5], metavar="N", help="of the trainings (default: 1 to 5)")
    train.add_argument("--minutes", type=float, default=30.0, metavar="T", help="that a training may take (default: 30)")
    opening.add_arguments(explain)
    explain.add_argument("--no-report", action="store_true", help="measure the verdicts only")
    for kind in (sim, camera, train, explain):
        kind.add_argument(
            "--repeats", type=int, default=5, metavar="N", help="measurements; the median counts (default: 5)"
        )
    sim.add_argument("--core", type=int, metavar="N", help="CPU core to stay on (default: the last one)")
    sim.add_argument(
        "--config", default="state", metavar="NAME", help="training configuration whose plant is measured (default: state)"
    )
    for kind in (sim, camera, train):
        add_common(kind)
    for kind in (sim, camera, train, explain):
        kind.add_argument("--record", metavar="NAME", help="keep the result in the package's records under this name")
    sim.set_defaults(device="cpu")
    explain.set_defaults(device="cpu", repeats=2)
    records.add_argument("names", metavar="NAME", nargs="*", help="records to print (default: all)")


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
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="measure N threads of a CPU against one instead of MuJoCo (default: 1)"
    )
    parser.add_argument("--without-mujoco", action="store_true", help="measure this simulator alone")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    import importlib

    return importlib.import_module(KINDS[args.bench][1]).run(args)
