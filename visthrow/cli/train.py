"""``visthrow train``: train a policy, from scratch or from another, with progress, evaluation,
checkpoints, resume.
"""

import argparse
from dataclasses import fields

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Train."""
    from visthrow.training import session

    options = session.Options(
        **{item.name: getattr(args, item.name) for item in fields(session.Options)}
    )
    return session.run(options)
