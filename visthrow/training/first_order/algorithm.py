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
from visthrow.training.first_order.layers import Layers
from visthrow.training.first_order.surrogate import Flights, Plants, fit
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
        self.cfg, self.p, p = experiment, experiment.first_order, experiment.ppo
        seen = experiment.task.observation
        if seen.layout != "state" or seen.oldest > experiment.sim.control_period:
            expected = 'observation.layout = "state" and a latency of one period at most'
            raise ConfigError(f'algorithm = "first_order" takes {expected}; "distillation" makes a vision policy of its policy')
        if experiment.task.target.moves or experiment.fleet is not None:
            raise ConfigError('algorithm = "first_order" trains for one vehicle and goals that stand still; "ppo" for the others too')
        self._ranks = ranks
        blind = dataclasses.replace(experiment, ppo=dataclasses.replace(p, privileged=()))  # there is no critic
        self.env = env = ThrowEnv(blind, device, seed)
        E, T = env.num_envs, self.p.horizon
        self.samples = E * T * ranks.world
        seen = env.get_observations()
        self.network = Network(seen, {"actor": ["actor"]}, "actor", act.ACTIONS, p.hidden, p.activation, p.normalize).to(device)
        lag = experiment.release.lag / experiment.sim.control_period
        self.lag, rest = int(lag + 1e-6), max(lag - int(lag + 1e-6), 0.0)
        self.releases = T - self.lag - 1  # the cubic looks a step past the separation
        if self.releases < 1:
            raise ConfigError(f"first_order.horizon is {T} steps; expected at least {self.lag + 2} for a release to end in")
        self.plants = Plants.of(env)
        with torch.no_grad():  # random commands give every observation a spread to start from
            self.surrogate = fit(env, self.plants, self._watch)
        self.flights, self.adjoint = Flights(T, E, device), Flights(T, E, device)
        make = {"device": device, "dtype": torch.float32}
        self.obs = torch.zeros(T, E, env.layout.dimension, **make)
        self.layers = Layers(self.network, T, E, env.layout.dimension, device)
        self.action, self.by_clipped = self.layers.action, torch.zeros_like(self.layers.action)
        self.landing, self.time = torch.zeros(T + 1, E, 2, **make), torch.zeros(T + 1, E, **make)
        self.age, self.goal = torch.zeros(E, **make), torch.zeros(E, 3, **make)
        nodes = (-1.0, 0.0, 1.0, 2.0)  # of the cubic through the steps about the separation
        shares = [math.prod((rest - b) / (a - b) for b in nodes if b != a) for a in nodes]
        k = torch.arange(self.releases, device=device)
        self._separation = [(w, (k + self.lag + int(a)).clamp(0, T)) for a, w in zip(nodes, shares)]
        self._drop = torch.tensor([0.0, 0.0, 0.5 * GRAVITY], **make)
        self._figures: dict[str, Tensor] = {}
        self._adapting = False
        self._launches = self._recorded()
        self._schedule(0.0)
        self._begin()
        ranks.share(self.network)
        on_gpu = device.startswith("cuda")
        rate = torch.tensor(self.p.learning_rate, **make) if on_gpu else self.p.learning_rate
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

    def _begin(self) -> None:
        """Hover with the latch at rest, whatever is seen."""
        last = self.network.mlp[-1]
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(self.env._start_action)
            last.bias[act.COMMANDS] = self.p.initial_release

    @torch.no_grad()
    def _fly(self) -> None:
        """Fly one batch without release."""
        env, stops = self.env, self._latched == 1.0 and self.env.device == "cpu"

        def decide(k: int, seen: Tensor) -> Tensor | None:
            self.obs[k].copy_(seen)
            asked = self.action[: max(k - self.lag - 2, 0), :, act.COMMANDS] > self.cfg.release.threshold
            if stops and bool((asked.sum(0) > 1).all()):  # of no flight a later step counts: its latch has tripped, or would have
                return None
            return self.layers.forward(k, seen)

        def foresee(k: int) -> None:
            if k == 0:
                self.goal.copy_(env.views.goal_w)
                self.age.copy_(env.pose_age)
            with on_torch_stream(env.device):
                env.sim.foresee()
            self.landing[k].copy_(env.views.foreseen["landing_w"][:, :2])
            self.time[k].copy_(env.views.foreseen["time_to_impact"])

        self.flights.fly(env, self.plants, decide, foresee)

    def _rewards_at_release(self, x: SimpleNamespace) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, landing error [m] and time to impact [s] of a release at each step, shape (releases, E)."""
        p, release = self.cfg.task.reward, self.cfg.release
        up = x.load_vel[..., 2]
        fall = (up + (up.square() + 2.0 * GRAVITY * (x.load_pos[..., 2] - release.landing_height)).clamp(min=1e-6).sqrt()) / GRAVITY
        landing = x.load_pos[..., :2] + x.load_vel[..., :2] * fall[..., None]
        landing = landing + (self.landing - landing).detach()  # the simulator's own value, the slope of flight without drag
        fall = fall + (self.time - fall).detach()
        share = torch.linspace(0.0, 1.0, release.clearance_samples, device=fall.device) * fall[..., None]
        path = (x.load_pos - x.pos)[:, :, None] + share[..., None] * x.load_vel[:, :, None] - share[..., None] ** 2 * self._drop
        clearance = (path.square().sum(-1) + 1e-12).sqrt().amin(-1)
        landing, fall, clearance = (sum(w * value[i] for w, i in self._separation) for value in (landing, fall, clearance))
        error = ((landing - self.goal[:, :2]).square().sum(-1) + ROUND**2).sqrt()
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
        p, K, steps = self.cfg.task.reward, self.releases, self.flights.steps
        k = torch.arange(self.p.horizon, device=steps.device)[:, None]
        reward, error, fall = self._rewards_at_release(x)
        asked = x.action[:K, :, act.COMMANDS] - self.cfg.release.threshold
        hazard = torch.sigmoid(asked / self._width)
        hazard = hazard + self._latched * ((asked > 0.0).float() - hazard).detach()  # the slope stays that of the smooth one
        hazard = hazard * (k[:K] >= self._first)
        ended, cut = k[:K] > steps, k[:K] + self.lag + 2 > steps
        hazard = torch.where(ended, 1.0, hazard)
        reward = torch.where(cut, -p.termination, reward)
        survival = torch.cat([torch.ones_like(hazard[:1]), (1.0 - hazard).cumprod(0)])
        chance = survival[:-1] * hazard
        carried = survival[(k[:, 0] - self.lag).clamp(0, K)] * (k < steps)
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
        f, adjoint, states = self.flights.x, self.adjoint.x, ("pos", "vel", "load_pos", "load_vel", "response")
        tilt = ob.rotation_from_quat(f["quat"])[..., 2, :]  # world z in the body frame
        x = SimpleNamespace(**{name: f[name].clone() for name in states})
        x.upright, x.action, x.clipped = tilt[..., 2].clone(), self.action.clone(), act.clip_action(self.action)
        leaves = vars(x)
        for leaf in leaves.values():
            leaf.requires_grad_()
        with torch.enable_grad():
            cost, figures = self._cost(x)
        by = dict(zip(leaves, torch.autograd.grad(cost, list(leaves.values())), strict=True))
        for name in states:
            adjoint[name].copy_(by[name])
        adjoint["turn"].copy_(torch.stack([-tilt[..., 1], tilt[..., 0], torch.zeros_like(tilt[..., 0])], -1) * by["upright"][..., None])
        adjoint["command"].zero_()
        self.by_clipped.copy_(by["clipped"])
        self.layers.by_action.copy_(by["action"])
        self.layers.prepare()
        self.backward()
        return figures | {"cost": cost.detach()}

    def _recorded(self) -> list[wp.Launch]:
        """Launches of the backward kernel, from the last step to the first."""
        env, task, p = self.env, self.cfg.task, Setting()
        p.max_thrust, p.max_rate = task.action.max_thrust, wp.vec3(*task.action.max_rate)
        p.period, p.decay = self.cfg.sim.control_period, self.p.decay
        plants = {"mass": self.flights.mass, "load_mass": self.plants.load_mass, "age": self.age, "mount": self.plants.mount}
        for name, tensor in {**vars(self.surrogate), **plants}.items():
            kind = wp.vec3 if name == "mount" else wp.vec4 if name == "response" else wp.float32
            setattr(p, name, wp.from_torch(tensor.contiguous(), dtype=kind))
        ins = [self.flights.course, *map(wp.from_torch, (self.flights.steps, self.action, self.layers.by_seen))]
        state, out = (self.adjoint.course, wp.from_torch(self.by_clipped)), wp.from_torch(self.layers.by_action)
        how = {"device": env.device, "block_dim": 64, "record_cmd": True}
        kernel = build_backward(env.layout)
        return [wp.launch(kernel, env.num_envs, [p, k, *state, *ins, out], **how) for k in reversed(range(self.p.horizon))]

    @torch.no_grad()
    def _back(self) -> None:
        """From the derivatives of the cost by states and actions to whole derivatives by the actions."""
        for k, launch in zip(reversed(range(self.p.horizon)), self._launches):
            with on_torch_stream(self.env.device):
                launch.launch()
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
        self._descend()
        figures = {name: float(value.detach()) for name, value in self._figures.items()}
        times = {"rollout_s": middle - start, "learning_s": time.perf_counter() - middle}
        return figures | times | {"learning_rate": rate, "episodes": float(self.env.num_envs)}

    @torch.no_grad()
    def _descend(self) -> None:
        """Gradient of the last rollout, Adam, observation statistics."""
        self._figures, parameters = self.derivatives(), list(self.network.mlp.parameters())
        size = self.layers.by_action.square().sum((0, 2)).sqrt()  # a few wild flights must not outweigh the rest
        self.layers.gradients(self.obs, (OUTLIER * size.sort().values[len(size) // 2] / size.clamp(min=1e-12)).clamp(max=1.0))
        self._ranks.average(parameters)
        self._figures["gradient_norm"] = torch.nn.utils.clip_grad_norm_(parameters, self.p.max_grad_norm)
        self._figures["ended"] = (self.flights.steps < self.flights.flown).float().mean()
        self.optimizer.step()
        self._watch(self.obs[self.flights.whole()])

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
        return {**learnt, "adapting": self._adapting, "surrogate": vars(self.surrogate)}

    def load_state_dict(self, saved: dict, own_throws: bool = True) -> None:
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self._adapting = saved["adapting"]
        for name, value in saved["surrogate"].items():
            getattr(self.surrogate, name).copy_(value)
        if own_throws:
            self.env.load_state_dict(saved["env"])
