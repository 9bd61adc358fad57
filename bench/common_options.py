"""Options that measuring programs share with the product's commands."""

import argparse

from visthrow.common.arguments import add_option


def add_common(parser: argparse.ArgumentParser, *, device: bool = True, json: bool = True) -> None:
    """Add ``--set``, ``--device`` and ``--json``."""
    for name, included in (("--set", True), ("--device", device), ("--json", json)):
        if included:
            add_option(parser, name, shared=True)
