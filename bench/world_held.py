"""A wrench that is held over a substep in the world's axes, as the paper's engine holds it.

Between two exchanges the chain holds the wrench of the quadrotor's blocks in the axes of the body,
which turn. Here the force is turned back by half of what the body turns in the substep. To second
order in the substep that is a force which keeps its direction in the world."""

import contextlib
from collections.abc import Iterator

import warp as wp

from sim import solvers
from sim.solvers import World
from sim.solvers.exchanged_chain import ChainSolver


class WorldHeldChain(ChainSolver):
    """The chain behind the exchange, under a wrench whose axes stay in the world."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._turn_back = _turn_back(world)

    def advance(self, duration: float) -> None:
        w = self.world
        inputs = [0.5 * duration, w.bodies.rate_b, w.wrench.force_b, w.wrench.torque_b]
        wp.launch(self._turn_back, w.count, inputs, device=w.device)
        super().advance(duration)


def _turn_back(world: World) -> wp.Kernel:
    """Kernel that turns force and torque back by what the body turns in some time."""
    real = world.types.real
    vec3 = world.types.vec3

    @wp.kernel(module="unique", enable_backward=False)
    def turn_back(
        # Params:
        duration: real,
        # State in:
        rate_b: wp.array(dtype=vec3),
        # In and out:
        force_b: wp.array(dtype=vec3),
        torque_b: wp.array(dtype=vec3),
    ):
        env = wp.tid()
        rate = rate_b[env]
        angle = wp.length(rate) * duration
        back = wp.quat_from_axis_angle(wp.normalize(rate), -angle)
        force_b[env] = wp.quat_rotate(back, force_b[env])
        torque_b[env] = wp.quat_rotate(back, torque_b[env])

    return turn_back


@contextlib.contextmanager
def register_world_held() -> Iterator[None]:
    """Let ``sim.solver`` "exchanged_chain" mean :class:`WorldHeldChain`."""
    name = "exchanged_chain"
    usual = solvers.SOLVERS["exchanged_chain"]
    solvers.SOLVERS[name] = f"{__name__}:{WorldHeldChain.__name__}"
    try:
        yield
    finally:
        solvers.SOLVERS[name] = usual
