"""Arguments of ``visthrow camera``. An action's modules are imported only if it is chosen."""

import argparse

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    from visthrow.view import camera_actions

    return {
        "calibrate": camera_actions.calibrate,
        "check": camera_actions.check,
        "show": camera_actions.show,
    }[args.action](args)
