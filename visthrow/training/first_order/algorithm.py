"""First-order training: the cost of flights, in which a hazard weighs a release at every step, and its descent."""

import dataclasses
import math
import time
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from sim.arrays.torch_bridge import Replayed, on_torch_stream
from sim.params import GRAVITY
from visthrow.common.errors import ConfigError
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment
from visthrow.training import rewards
from visthrow.training.env import ThrowEnv
from visthrow.training.first_order.backward import Setting, build_backward
from visthrow.training.first_order.flights import Flights, course
from visthrow.training.first_order.layers import Layers
from visthrow.training.first_order.surrogate import fit
from visthrow.training.ppo.network import Network
from visthrow.training.ranks import Ranks

BARRIER = 600.0
"""Barriers cost this times the square of how far a state is within their margins."""
MARGINS = {"altitude": 0.15, "ground": 0.1, "above": 0.08, "upright": 0.15}
"""Reach of the barriers: of altitude, payload over ground, payload below vehicle [m], cosine of the tilt."""
ROUND = 0.02
"""Landing errors are smooth below this [m]: the slope of a distance turns round at the goal, which is noise where throws are good."""
OUTLIER = 4.0
"""A flight's derivatives are shortened to this many times the median flight's."""
NODES = (-1, 0, 1, 2)
"""Steps about a separation that a cubic goes through."""
STATES = ("pos", "vel", "load_pos", "load_vel", "response")


class FirstOrder:
    """First-order training; see :class:`visthrow.training.trainer.Algorithm`.

    Attributes:
        surrogate: fitted to the environment's plants at the start.
        network: of the policy, with its normaliser.
        rollout: flies one batch without release.
    """

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: Ranks):
        """Fit the surrogate and start the network near hover.

        Args:
            experiment: the run's configuration; the environments of ``ppo`` are the throws of a gradient, its network the policy's.
            device: "cpu" or "cuda:0".
            seed: of the environment; torch's own generators are the caller's to seed.
            ranks: this process among those of the training.

        Raises:
            ConfigError: Goals that move, a fleet, a vision layout, or a horizon too short for a release.
        """
        self.cfg, self.p, self._ranks = experiment, experiment.first_order, ranks
        seen, p, on_gpu = experiment.task.observation, experiment.ppo, device.startswith("cuda")
        if seen.layout != "state" or seen.oldest > experiment.sim.control_period:
            expected = 'observation.layout = "state" and a latency of one period at most'
            raise ConfigError(f'algorithm = "first_order" takes {expected}; "distillation" makes a vision policy of its policy')
        if experiment.task.target.moves or experiment.fleet is not None:
            raise ConfigError('algorithm = "first_order" trains for one vehicle and goals that stand still; "ppo" for the others too')
        lag = experiment.release.lag / experiment.sim.control_period
        self.lag, rest = int(lag + 1e-6), max(lag - int(lag + 1e-6), 0.0)
        if self.p.horizon < self.lag + NODES[-1]:
            raise ConfigError(f"first_order.horizon is {self.p.horizon} steps; expected at least {self.lag + 2} for a release")
        self._shares = [math.prod((rest - b) / (a - b) for b in NODES if b != a) for a in NODES]
        blind = dataclasses.replace(experiment, ppo=dataclasses.replace(p, privileged=()))  # there is no critic
        self.env = env = ThrowEnv(blind, device, seed)
        self.samples = env.num_envs * self.p.horizon * ranks.world
        groups = {"actor": ["actor"]}
        self.network = Network(env.get_observations(), groups, "actor", act.ACTIONS, p.hidden, p.activation, p.normalize).to(device)
        with torch.no_grad():  # random commands give every observation a spread to start from
            self.surrogate = fit(env, self._watch)
            last = self.network.mlp[-1]  # hover with the latch at rest, whatever is seen
            last.weight.mul_(0.1)
            last.bias.copy_(env._start_action)
            last.bias[act.COMMANDS] = self.p.initial_release
        ranks.share(self.network)
        self.flights, (self.adjoint, adjoint) = Flights(env, self.p.horizon), course(self.p.horizon, env.num_envs, device)
        self.layers = Layers(self.network, self.flights.obs)
        self.action, self.by_clipped = self.layers.action, torch.zeros_like(self.layers.action)
        self._launches, self._adapting = self._recorded(adjoint), False
        self._schedule(0.0)
        rate = torch.tensor(self.p.learning_rate, device=device) if on_gpu else self.p.learning_rate
        self.optimizer = torch.optim.Adam(self.network.mlp.parameters(), lr=rate, betas=(0.9, 0.95), capturable=on_gpu)
        self.rollout, self.backward = (Replayed(work) if on_gpu else work for work in (self._fly, self._back))

    @property
    def iterations(self) -> int:
        """Gradients of a whole training."""
        return self.p.adapting if self._adapting else self.p.iterations

    def _schedule(self, done: float) -> None:
        """Width of the hazard, share of the latch in it, and first step that it counts at, at this share of the training."""
        p = self.p
        self._width = p.adapting_width if self._adapting else p.width * (p.final_width / p.width) ** min(done / p.sharp, 1.0)
        self._latched, freed = (min(max((done - low) / (high - low), 0.0), 1.0) for low, high in (p.latched, p.free))
        self._first = p.first_release * (1.0 - freed)

    @torch.no_grad()
    def _fly(self) -> None:
        """Fly one batch without release, on a CPU each flight until nothing that follows has a derivative: its latch asked twice."""
        stops, wait = self._latched == 1.0 and self.env.device == "cpu", self.lag + NODES[-1] + 1
        asked = torch.zeros_like(self.flights.steps)

        def decide(k: int, seen: Tensor) -> Tensor | None:
            if stops and k - wait >= self._first:
                asked.add_(self.action[k - wait, :, act.COMMANDS] > self.cfg.release.threshold)
                torch.lt(asked, 2, out=self.flights.flying)
                if not self.flights.flying.any():
                    return None
            return self.layers.forward(k, seen)

        self.flights.fly(decide)

    def _rewards_at_release(self, x: SimpleNamespace, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, landing error [m] and time to impact [s] of a release at each of the first steps, shape (count, E)."""
        p, release, flights = self.cfg.task.reward, self.cfg.release, self.flights
        up = x.load_vel[..., 2]
        fall = (up + (up.square() + 2.0 * GRAVITY * (x.load_pos[..., 2] - release.landing_height)).clamp(min=1e-6).sqrt()) / GRAVITY
        landing = x.load_pos[..., :2] + x.load_vel[..., :2] * fall[..., None]
        landing = landing + (flights.landing[: len(fall)] - landing).detach()  # the simulator's value, the slope of flight without drag
        fall = fall + (flights.time[: len(fall)] - fall).detach()
        share = torch.linspace(0.0, 1.0, release.clearance_samples, device=fall.device) * fall[..., None]
        path = (x.load_pos - x.pos)[:, :, None] + share[..., None] * x.load_vel[:, :, None]
        path[..., 2] -= 0.5 * GRAVITY * share**2
        clearance = (path.square().sum(-1) + 1e-12).sqrt().amin(-1)
        rows = [(torch.arange(count, device=fall.device) + (self.lag + node)).clamp(min=0) for node in NODES]
        values = (sum(w * value[i] for w, i in zip(self._shares, rows)) for value in (landing, fall, clearance))
        landing, fall, clearance = values
        error = ((landing - self.env.views.goal_w[:, :2]).square().sum(-1) + ROUND**2).sqrt()
        reward = rewards.landing(p, error) + rewards.time_of_flight(p, fall)
        return reward + rewards.proximity(p, clearance, release.clearance_margin), error, fall

    def _carrying(self, x: SimpleNamespace) -> Tensor:
        """Rewards of each step while carrying, barriers included, shape (T, E)."""
        task, env = self.cfg.task, self.env
        p, bounds = task.reward, task.bounds
        rate, height, load = x.response[1:, :, 1:], x.pos[1:, :, 2], x.load_pos[1:, :, 2]
        before = torch.cat([env._start_action.expand_as(x.clipped[:1]), x.clipped[:-1]])
        now, before = x.clipped.flatten(0, 1), before.flatten(0, 1)
        on_action = rewards.command(p, now, env._rate_weights) + rewards.change(p, now, before, env._change_weights)
        inside = [
            height - bounds.altitude[0] - MARGINS["altitude"],
            bounds.altitude[1] - MARGINS["altitude"] - height,
            load - self.cfg.release.landing_height - MARGINS["ground"],
            height - load - MARGINS["above"],
            x.upright[1:] - math.cos(math.radians(bounds.tilt_deg)) - MARGINS["upright"],
            bounds.horizontal - MARGINS["altitude"] - x.pos[1:, :, :2].norm(dim=-1),
        ]
        barrier = BARRIER * sum(gap.clamp(max=0.0).square() for gap in inside)
        moving = rewards.kinetic(p, x.vel[1:], rate, x.load_vel[1:])
        return moving + on_action.view_as(moving) + rewards.carry_time(p, self.cfg.sim.control_period) - barrier

    def _cost(self, x: SimpleNamespace) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean cost of the flights and figures of what is released."""
        p, steps, T, lag = self.cfg.task.reward, self.flights.steps, self.flights.last, self.lag
        k, K = torch.arange(T, device=steps.device)[:, None], T - lag - 1  # the cubic looks a step past the separation
        reward, error, fall = self._rewards_at_release(x, K)
        asked = x.action[:K, :, act.COMMANDS] - self.cfg.release.threshold
        hazard = torch.sigmoid(asked / self._width)
        hazard = hazard + self._latched * ((asked > 0.0).float() - hazard).detach()  # the slope stays that of the smooth one
        hazard = hazard * (k[:K] >= self._first)
        ended, cut = k[:K] > steps, k[:K] + lag + 2 > steps
        hazard = torch.where(ended, 1.0, hazard)
        reward = torch.where(cut, -p.termination, reward)
        survival = torch.cat([torch.ones_like(hazard[:1]), (1.0 - hazard).cumprod(0)])
        chance = survival[:-1] * hazard
        carried = survival[(k[:, 0] - lag).clamp(0, K)] * (k < steps)
        past = (x.action.abs() - 1.0).clamp(min=0.0).square().sum(-1) * carried.detach()
        gain = (chance * reward).sum(0) + (carried * self._carrying(x)).sum(0) - p.termination * survival[-1]
        done = (chance * ~cut).detach()
        total = done.sum().clamp(min=1e-6)
        error = (error.square() - ROUND**2).clamp(min=0.0).sqrt()
        duration = (k[:K] + 1) * self.cfg.sim.control_period + self.cfg.release.lag + fall
        figures = {"released": done.sum() / done.shape[1], "landing_error": (done * error).sum() / total,
                   "duration": (done * duration).sum() / total}  # fmt: skip
        return (self.p.saturation * past.sum(0) - gain).mean() * p.scale, figures

    def derivatives(self) -> dict[str, Tensor]:
        """Derivatives of the cost of the last rollout by the actions, as the layers hold them; returns figures."""
        f, T = self.flights.x, self.flights.last
        tilt = ob.rotation_from_quat(f["quat"][: T + 1])[..., 2, :]  # world z in the body frame
        leaves = {name: f[name][: T + 1].clone() for name in STATES} | {"upright": tilt[..., 2].clone()}
        leaves |= {"action": self.action[:T].clone(), "clipped": act.clip_action(self.action[:T])}
        with torch.enable_grad():
            cost, figures = self._cost(SimpleNamespace(**{name: leaf.requires_grad_() for name, leaf in leaves.items()}))
        by = dict(zip(leaves, torch.autograd.grad(cost, list(leaves.values()))))
        for name in STATES:
            self.adjoint[name][: T + 1] = by[name]
        turn = torch.stack([-tilt[..., 1], tilt[..., 0], torch.zeros_like(tilt[..., 0])], -1) * by["upright"][..., None]
        self.adjoint["turn"][: T + 1] = turn
        self.adjoint["command"].zero_()
        self.by_clipped[:T], self.layers.by_action[:T] = by["clipped"], by["action"]
        self.layers.prepare(T)
        self.backward()
        return {name: figure.detach() for name, figure in (figures | {"cost": cost}).items()}

    def _recorded(self, adjoint: wp.struct) -> list[wp.Launch]:
        """Launches of the backward kernel, a step each."""
        env, flights, action, p = self.env, self.flights, self.cfg.task.action, Setting()
        p.max_thrust, p.max_rate = action.max_thrust, wp.vec3(*action.max_rate)
        p.period, p.decay = self.cfg.sim.control_period, self.p.decay
        plants = {"mass": flights.mass, "load_mass": flights.load_mass, "age": env.pose_age, "mount": flights.mount}
        for name, tensor in (self.surrogate | plants).items():
            kind = wp.vec3 if name == "mount" else wp.vec4 if name == "response" else wp.float32
            setattr(p, name, wp.from_torch(tensor, dtype=kind))
        tensors = (flights.steps, self.action, self.layers.by_seen, self.layers.by_action, self.by_clipped)
        *rest, clipped = map(wp.from_torch, tensors)
        kernel, given = build_backward(env.layout), (adjoint, clipped, flights.course, *rest)
        how = {"device": env.device, "block_dim": 64, "record_cmd": True}
        return [wp.launch(kernel, env.num_envs, [p, k, *given], **how) for k in range(self.p.horizon)]

    @torch.no_grad()
    def _back(self) -> None:
        """From the derivatives of the cost by states and actions to whole derivatives by the actions."""
        for k in reversed(range(self.flights.last)):
            with on_torch_stream(self.env.device):
                self._launches[k].launch()
            self.layers.back(k)

    def step(self, done: float) -> dict[str, float]:
        """One rollout and one step of Adam at this share of the training; returns its figures."""
        p, start = self.p, time.perf_counter()
        self._schedule(1.0 if self._adapting else done)
        highest, lowest = (p.adapting_rate, 0.1 * p.adapting_rate) if self._adapting else (p.learning_rate, p.final_rate)
        rate = lowest + 0.5 * (highest - lowest) * (1.0 + math.cos(math.pi * done))
        for group in self.optimizer.param_groups:
            group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], Tensor) else rate
        self.rollout()
        if self.env.device.startswith("cuda"):
            torch.cuda.synchronize()
        middle = time.perf_counter()
        figures = {name: float(value) for name, value in self._descend().items()}
        times = {"rollout_s": middle - start, "learning_s": time.perf_counter() - middle}
        return figures | times | {"learning_rate": rate, "episodes": float(self.env.num_envs)}

    @torch.no_grad()
    def _descend(self) -> dict[str, Tensor]:
        """Gradient of the last rollout, Adam, observation statistics; returns figures."""
        figures, parameters, T = self.derivatives(), list(self.network.mlp.parameters()), self.flights.last
        size = self.layers.by_action[:T].square().sum((0, 2)).sqrt()  # a few wild flights must not outweigh the rest
        median = size.kthvalue(len(size) // 2 + 1).values
        self.layers.gradients(self.flights.obs[:T], (OUTLIER * median / size.clamp(min=1e-12)).clamp(max=1.0))
        self._ranks.average(parameters)
        figures["gradient_norm"] = torch.nn.utils.clip_grad_norm_(parameters, self.p.max_grad_norm)
        figures["ended"] = self.flights.ended.float().mean()
        self.optimizer.step()
        self._watch(self.flights.observed())
        return figures

    def _watch(self, seen: Tensor) -> None:
        """Take observations, shape (N, D), into the normaliser's statistics."""
        if self.network.obs_normalization:
            normalizer = self.network.obs_normalizer
            std = normalizer._std  # the update makes a new tensor; a graph reads this one
            normalizer.update(seen)
            normalizer._std = std.copy_(normalizer._std)

    def export(self, contract: dict, made_by: dict) -> Policy:
        """The policy as a file's content."""
        return Policy.from_actor_state(self.network.state_dict(), self.cfg.ppo.activation, contract, made_by)

    def take_up(self, policy: Policy) -> None:
        """Start from a policy of the same layers: it releases as it has learnt to, and the rate starts at that of adaptation."""
        self.network.take_up(policy)
        self._adapting = True

    def state_dict(self) -> dict:
        """All that the next iteration depends on, besides torch's generators."""
        learnt = {name: getattr(self, name).state_dict() for name in ("network", "optimizer", "env")}
        return learnt | {"adapting": self._adapting, "surrogate": self.surrogate}

    def load_state_dict(self, saved: dict, own_throws: bool = True) -> None:
        self._adapting = saved["adapting"]
        for name in ("network", "optimizer", *["env"] * own_throws):
            getattr(self, name).load_state_dict(saved[name])
        for name, value in saved["surrogate"].items():
            self.surrogate[name].copy_(value)
