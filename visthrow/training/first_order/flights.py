"""Flights of the simulator in which nothing is released, recorded with where the payload would land at every step."""

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from sim.arrays.torch_bridge import on_torch_stream
from visthrow.onboard import observations as ob
from visthrow.training import terminations
from visthrow.training.env import ThrowEnv


@wp.struct
class Course:
    """Course of flights, or derivatives of a cost by it: (T + 1, E)."""

    pos: wp.array2d(dtype=wp.vec3)
    vel: wp.array2d(dtype=wp.vec3)
    turn: wp.array2d(dtype=wp.vec3)  # derivatives alone
    load_pos: wp.array2d(dtype=wp.vec3)
    load_vel: wp.array2d(dtype=wp.vec3)
    response: wp.array2d(dtype=wp.vec4)  # thrust, body rates
    command: wp.array2d(dtype=wp.vec4)
    quat: wp.array2d(dtype=wp.quat)  # flights alone


def course(steps: int, count: int, device: str) -> tuple[dict[str, Tensor], Course]:
    """Tensors of shape (T + 1, E, 3 or 4) by the names of :class:`Course`, and the same memory for kernels."""
    kinds, made = {name: field.type.dtype for name, field in Course.vars.items()}, Course()
    x = {name: torch.zeros(steps + 1, count, kind._length_, device=device) for name, kind in kinds.items()}
    for name, kind in kinds.items():
        setattr(made, name, wp.from_torch(x[name], dtype=kind))
    return x, made


class Flights:
    """A batch of flights and the plants that make them.

    Attributes:
        x, course: states and commands; see :func:`course`. obs: what the actor observes, shape (T, E, D).
        landing, time: of a payload that separates at a state, [m], shape (T + 1, E, 2), and [s], shape (T + 1, E).
        mass, load_mass: of vehicles with their ropes and of payloads [kg], shape (E,). mount: of the ropes [m], shape (E, 3).
        flying: whether a flight goes on, int32, shape (E,); its plant stands still otherwise.
        steps: until a flight was over, int32, shape (E,): states 0 to ``steps`` are of one flight. last: of the longest.
        ended: whether a bound ended it, shape (E,).
    """

    def __init__(self, env: ThrowEnv, steps: int):
        E, make = env.num_envs, {"device": env.device}
        self.env, (self.x, self.course), self.last = env, course(steps, E, env.device), steps
        self.obs = torch.zeros(steps, E, env.layout.dimension, **make)
        self.landing, self.time = torch.zeros(steps + 1, E, 2, **make), torch.zeros(steps + 1, E, **make)
        self.status = torch.zeros(steps + 1, E, dtype=torch.int32, **make)
        self.flying, self.steps = (torch.zeros(E, dtype=torch.int32, **make) for _ in range(2))
        self.ended, self._mask = torch.zeros(E, dtype=torch.bool, **make), wp.from_torch(self.flying)
        vehicle, rope = env.sim.plants()
        load = rope["payload_mass"]
        parts = (vehicle["body"]["mass"], rope["total_mass"] - load, load, rope["mount"], vehicle["thrust"]["k_f"])
        rows = (torch.tensor(part, dtype=torch.float32, **make) for part in parts)
        self._body, self._rope, self.load_mass, self.mount, self._thrust = rows
        self.mass = self._body + self._rope

    def observed(self) -> Tensor:
        """What the actor observed while flights lasted, shape (N, D)."""
        return self.obs[torch.arange(len(self.obs), device=self.steps.device)[:, None] <= self.steps]

    def fly(self, act: Callable[[int, Tensor], Tensor | None]) -> None:
        """Fly from new starts under actions ``act(k, observations)``; where it has none, all flights are over."""
        env, x, state, out = self.env, self.x, self.env.views.state, self.env.views.out
        sources = {"pos": state["pos_w"], "vel": state["vel_w"], "quat": state["quat_wb"], "load_pos": out["payload_pos_w"],
                   "load_vel": out["payload_vel_w"]}  # fmt: skip
        seen = env.reset()["actor"]
        torch.add(self._body * state["mass_scale"], self._rope, out=self.mass)
        self.flying.fill_(1)
        self.steps.zero_()
        for k in range(len(self.obs) + 1):
            with on_torch_stream(env.device):
                env.sim.foresee()
            for name, source in sources.items():
                x[name][k].copy_(source)
            torch.mul(self._thrust, state["motor_speed"].square().sum(-1), out=x["response"][k, :, 0])
            x["response"][k, :, 1:].copy_(state["rate_b"])
            self.status[k].copy_(state["status"])
            self.landing[k].copy_(env.views.foreseen["landing_w"][:, :2])
            self.time[k].copy_(env.views.foreseen["time_to_impact"])
            self.last = k
            if k == len(self.obs):
                break
            self.obs[k].copy_(seen)
            action = act(k, seen)
            if action is None:
                break
            self.steps.add_(self.flying)
            seen = env.carry(action, self._mask)["actor"]
            x["command"][k].copy_(env.views.command)
        flown = (x["pos"][1:], ob.rotation_from_quat(x["quat"][1:]), x["load_pos"][1:], self.status[1:])
        pos, rot, load_pos, status = (value.flatten(0, 1) for value in flown)
        held, time, height = torch.zeros_like(status, dtype=torch.bool), torch.zeros_like(pos[:, 0]), env.cfg.release.landing_height
        ends = terminations.negative(env.cfg.task.bounds, pos, rot, load_pos, status, held, time, height)
        until = (~ends).view(len(self.obs), -1).int().cumprod(0).sum(0)
        torch.lt(until, self.steps, out=self.ended)
        self.steps.clamp_(max=until)
