"""``visthrow policy``: export a policy's network to other programs."""

import argparse
from pathlib import Path

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Export a policy."""
    from visthrow.cli.export.c_source import write_c
    from visthrow.cli.export.onnx_file import write_onnx
    from visthrow.common.errors import PolicyError
    from visthrow.onboard.policy import Policy, find_policy

    writers = {".onnx": write_onnx, ".c": write_c}
    writer = writers.get(Path(args.out).suffix)
    if writer is None:
        raise PolicyError(f"--out {args.out}; expected a name that ends in {' or '.join(writers)}")
    policy = Policy.load(find_policy(args.policy))
    writer(policy, args.out)
    memory = 0 if policy.estimator is None else policy.estimator.memory
    print(
        f"wrote {args.out}: {policy.obs_dim} observations, {policy.action_dim} actions,"
        f" a memory of {memory}"
    )
    return 0
