"""Complete throws with the shipped policies: mocap in, thrust, rates and release out, payload
lands.
"""

import numpy as np
from numpy.linalg import norm
from pytest import mark

from tests.loopback.wire import throw
from visthrow.throws.wire_plant import make

LANDING = 0.05
"""Landing error over the wire of a throw at 2 m [m], with 1 mm, 0.2 deg, 10 ms and 2 % of
loss; 0.10 m is asked for.
"""

READ_BACK = 0.01
"""Landing by the payload's noisy poses against the truth [m]."""


@mark.parametrize("policy", ["state", "vision"])
def test_throws_in_lock_step(policy):
    summary, fake, _ = throw(make(policy, 0), policy=policy, seconds=5.5)
    true = fake.plant.landing["landing_w"]
    assert true is not None, summary["reason"]
    assert np.hypot(true[0] - 2.0, true[1]) < LANDING
    (landing,) = summary["landings"]
    assert norm(np.subtract(landing["landing_w"], true)) < READ_BACK
    assert (summary["cancelled"], fake.witness.releases, summary["guard"]["refused"]) == (0, 1, 0)
    assert summary["held_back"] == 0, "a right throw is not delayed"
