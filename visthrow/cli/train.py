"""``visthrow train``: train a policy, from scratch or from another policy, or resume a training."""

import argparse

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Train a policy."""
    from visthrow.training import session

    return session.run(args)
