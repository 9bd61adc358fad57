"""Add a reward term: run this program in place of `visthrow`.

python examples/add_reward.py train laptop --minutes 5 --out runs/calmer

To keep a term, add its function to visthrow/task/rewards.py, its coefficient to RewardParams in
visthrow/task and to configs/task/state.toml, and a line to ThrowEnv._judge. PPO alone uses it:
first-order training has its own reward in visthrow/training/first_order.
"""

import sys

import torch

from visthrow import cli
from visthrow.task import rewards

PENALTY = 0.002  # for each (m/s)^2 of the payload's vertical speed
plain = rewards.kinetic


def calmer(p, vel_w, rate_b, payload_vel_w: torch.Tensor) -> torch.Tensor:
    """Return the kinetic term less a penalty on the payload's vertical speed, shape (E,)."""
    return plain(p, vel_w, rate_b, payload_vel_w) - PENALTY * payload_vel_w[:, 2].square()


if __name__ == "__main__":
    rewards.kinetic = calmer
    sys.exit(cli.main(sys.argv[1:]))
