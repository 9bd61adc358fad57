"""Options that commands share, and the exit status of a process."""

import argparse

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def add_common(parser: argparse.ArgumentParser, *, device: bool = True, json: bool = True) -> None:
    """Add the options that commands share: ``--device``, ``--set``, ``--json``.

    Args:
        parser: Of the command.
        device: Whether the command computes on a device; read ``args.device`` through ``visthrow.training.device.resolve``.
        json: Whether the command prints a table; write it to ``args.json`` as well where that is not None.
    """
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="change one value of the configuration, for instance --set vehicle.body.mass=0.25; may be repeated",
    )  # fmt: skip
    if device:
        parser.add_argument(
            "--device",
            default="auto",
            metavar="NAME",
            help="auto, cpu, cuda or cuda:1 (default: a GPU if there is one)",
        )
    if json:
        parser.add_argument("--json", metavar="FILE", help="write the printed figures to this file as well")
