"""Add a source of poses: fly the runner dry on poses of your own, without sending anything.

python examples/add_source.py --seconds 2
"""

import argparse

import numpy as np

from hil.control.state_machine import OperatorInput
from hil.control.tick.runner import Runner
from hil.links.backends import make_backend
from hil.params import HilParams
from hil.poses.pose import Pose
from hil.poses.sources.pose_source import Source
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy

PLACES = {"vehicle": (0.0, 0.0, 1.33), "payload": (0.0, 0.0, 0.95), "goal": (2.0, 0.0, 0.0)}
LEVEL = (0.0, 0.0, 0.0, 1.0)  # xyzw
FRAMES = ('axes="x,y,z"', 'body_axes="x,y,z"', 'quaternion="xyzw"')  # of this source: ours


class Still(Source):
    """A source that reports bodies at rest 100 times a second."""

    period = 0.01
    _next = 0.0

    def poll(self, now: float) -> list[Pose]:
        if now < self._next:
            return []
        self._next = now + self.period
        return [Pose(now, now, body, place, LEVEL) for body, place in PLACES.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0)
    args = parser.parse_args()
    changes = [f"frames.{body}.{of}" for body in ("vehicle", "payload") for of in FRAMES]
    params = config.load(HilParams, config.find("hil", "dry_run"), changes)
    policy = Policy.load(find_policy(params.policy))
    backend = make_backend(params, None)
    runner = Runner(params, policy, backend)
    source = Still()
    for now in np.arange(0.0, args.seconds, runner.pilot.period):
        decision = runner.tick(now, source.poll(now), backend.status(now), OperatorInput())
    print(f"after {args.seconds:g} s: {decision.state}; the policy's command is {decision.command}")


if __name__ == "__main__":
    main()
