"""``visthrow train``: train a policy, from scratch or from another, with progress, evaluation,
checkpoints, resume.
"""

import argparse

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Train."""
    from visthrow.training import session

    return session.run(args)
