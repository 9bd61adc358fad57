"""First-order training: the cost of flights, in which a hazard weights a release at every step, and
gradient descent on it.
"""

import dataclasses
import math
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from sim.params import GRAVITY
from sim.torch_bridge import ReplayedGraph, on_torch_stream
from visthrow.common.errors import ConfigError
from visthrow.common.free_fall import fall_time, free_flight
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, rewards
from visthrow.training.env import ThrowEnv
from visthrow.training.first_order.backward import BackwardParams, Layers, step
from visthrow.training.first_order.surrogate import STATES, Course, FlightBatch, fit
from visthrow.training.ppo.algorithm import Algorithm
from visthrow.training.ppo.network import MuonAdam, Network, average_weights, cosine_rate
from visthrow.training.ranks import Ranks

# Widths of the barriers
ALTITUDE = 0.15  # before the bounds of altitude and distance [m]
GROUND = 0.1  # of the payload's height over the ground [m]
ABOVE = 0.08  # of the vehicle's height above the payload [m]
UPRIGHT = 0.15  # of the cosine of the tilt
PULL = 0.4  # lowest tension of the rope without a cost, in weights of the payload
SLACK = 0.3  # depth in a barrier that costs as much as a missing tension of one weight [m]
BARRIER = 600.0  # cost of the squared depth in a barrier
ROUND = 0.02
"""Length below which landing errors are smoothed [m]: the gradient of a distance reverses at the
goal, which is noise for accurate throws.
"""
OUTLIER = 4.0  # limit of a flight's derivatives, in multiples of the median flight's
NODES = (-1, 0, 1, 2)  # steps around a separation, the nodes of a cubic interpolation
REACH = 2
"""Largest number of steps by which a release is shifted.

Half of all releases are shifted to a step earlier, then half of all to a step later, and both a
second time. The cost of a release is the mean over these, so that a policy learns to release when
the landing point hardly changes with time. Without the shifts it changed by 0.02 to 0.1 m a step in
some trainings, and noise shifts a release by a step.
"""

AVERAGED = 10  # longest window of gradient steps over which the exported weights are averaged


def _require_supported(experiment: Experiment) -> None:
    """Raise ConfigError for a task that first-order training does not support."""
    observation = experiment.task.observation
    late = observation.oldest > experiment.sim.control_period
    unsupported = experiment.task.target.moves or experiment.fleet is not None
    if observation.layout != "state" or late or unsupported:
        raise ConfigError(
            'algorithm = "first_order" needs observation.layout = "state", a latency of one period'
            ' at most, one vehicle and stationary goals; "distillation" makes a vision policy of'
            " its policy"
        )


class FirstOrder(Algorithm):
    """First-order training with a surrogate that is fitted to the environment's plants."""

    parts = ("network", "average", "optimizer")

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: Ranks):
        self.experiment = experiment
        self.p = experiment.first_order
        horizon = self.p.horizon
        self._ranks = ranks
        p = experiment.ppo
        _require_supported(experiment)
        lag = experiment.release.lag / experiment.sim.control_period
        self.lag = int(lag + 1e-6)
        remainder = max(lag - self.lag, 0.0)
        if horizon < self.lag + NODES[-1]:
            raise ConfigError(
                f"first_order.horizon is {horizon} steps; expected at least {self.lag + 2}"
                " for a release"
            )
        self._shares = [
            math.prod((remainder - b) / (a - b) for b in NODES if b != a) for a in NODES
        ]
        without_critic = dataclasses.replace(p, privileged=())
        simulated = dataclasses.replace(experiment, ppo=without_critic)
        self.env = env = ThrowEnv(simulated, device, seed)
        self.samples = env.num_envs * horizon * ranks.world
        self.network = Network(
            env.get_observations(),
            {"actor": ["actor"]},
            "actor",
            act.ACTIONS,
            hidden_dims=p.hidden,
            activation=p.activation,
            obs_normalization=p.normalize,
        ).to(device)
        self.flights = FlightBatch(env, horizon)
        with torch.no_grad():
            self.surrogate = fit(self.flights)
            # initial statistics of the observations, from flights with random commands
            self.network.update_normalization(
                {"actor": self.flights.obs[self.flights.mark_flown_steps()]}
            )
            last = self.network.mlp[-1]
            last.weight.mul_(0.1)  # hover with the latch at rest, for any observation
            last.bias.copy_(env.start_action)
            last.bias[act.COMMANDS] = self.p.initial_release
        ranks.share(self.network)
        self.average = average_weights(self.network, AVERAGED)
        self._requests = torch.zeros_like(self.flights.steps)
        self.layers = Layers(self.network, self.flights.obs)
        self._launches = self._record_launches()
        self.iterations = self.p.iterations
        self._adapting = False
        self._schedule(0.0)
        weights = self.network.mlp.parameters()
        self.optimizer = MuonAdam(
            weights, self.network.matrices, lr=self.p.learning_rate, betas=(0.9, 0.95)
        )
        self.rollout, self.backward = (
            ReplayedGraph(work) if device.startswith("cuda") else work
            for work in (self._fly, self._run_backward)
        )

    def _schedule(self, done: float) -> None:
        """Set the hazard's width, the latch's share in its value, and its first step after a share
        ``done`` of the training.
        """
        p = self.p
        self._width = p.width * (p.final_width / p.width) ** min(done / p.sharp, 1.0)
        self._latched, freed = (
            min(max((done - low) / (high - low), 0.0), 1.0) for low, high in (p.latched, p.free)
        )
        self._first = p.first_release * (1.0 - freed)

    @torch.no_grad()
    def _fly(self) -> None:
        """Fly one batch without release."""
        self.flights.fly(self._decide)

    def _decide(self, k: int, obs: Tensor) -> Tensor | None:
        """Return the policy's actions at step k, or None when all flights have ended.

        On a CPU a flight ends when later steps have no derivative: after its second request to
        release."""
        flying = self.flights.flying
        if k == 0:
            self._requests.zero_()
        stops = self._latched == 1.0 and self.env.device == "cpu"
        # the last step whose cost of a release is fully determined
        before = k - (self.lag + NODES[-1] + 1 + REACH)
        if stops and before >= self._first:
            asked = self.layers.action[before, :, act.COMMANDS] > self.experiment.release.threshold
            self._requests.add_(asked)
            torch.lt(self._requests, 2, out=flying)
        if not stops or flying.any():
            return self.layers.forward(k, obs, flying)
        return None

    def _rewards_at_release(self, x: SimpleNamespace, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return reward, landing error [m] and time to impact [s] of a release at each of the first
        ``count`` steps, shape (count, E).
        """
        p = self.experiment.task.reward
        release = self.experiment.release
        flights = self.flights
        up = x.load_vel[..., 2]
        fall = fall_time(x.load_pos[..., 2] - release.landing_height, up, floor=1e-6)
        landing = x.load_pos[..., :2] + x.load_vel[..., :2] * fall[..., None]
        # values of the simulator, with the slopes of a flight without drag
        landing = landing + (flights.landing[: len(fall)] - landing).detach()
        fall = fall + (flights.time[: len(fall)] - fall).detach()
        shares = torch.linspace(0.0, 1.0, release.clearance_samples, device=fall.device)
        times = shares * fall[..., None]
        offset = (x.load_pos - x.pos)[:, :, None]
        path = free_flight(offset, x.load_vel[:, :, None], times[..., None])
        clearance = (path.square().sum(-1) + 1e-12).sqrt().amin(-1)
        separation = torch.arange(count, device=fall.device) + self.lag
        rows = [(separation + node).clamp(min=0) for node in NODES]
        landing, fall, clearance = (
            sum(w * v[i] for w, i in zip(self._shares, rows)) for v in (landing, fall, clearance)
        )
        miss = landing - self.env.views.goal_w[:, :2]
        error = (miss.square().sum(-1) + ROUND**2).sqrt()
        reward = rewards.release_reward(p, error, fall, clearance, release.clearance_margin)
        return reward, error, fall

    def _pull(self, x: SimpleNamespace) -> Tensor:
        """Return the rope's tension at each step, in weights of the payload, shape (T, E).

        On a slack rope the vehicle does not move the payload, and the surrogate does not model the
        jerk that follows."""
        rope = torch.nn.functional.normalize(x.load_pos[1:] - x.pos[1:], dim=-1)
        gain = (x.load_vel[1:] - x.load_vel[:-1]) / self.experiment.sim.control_period
        return -(rope * gain).sum(-1) / GRAVITY - rope[..., 2]

    def _reward_carrying(self, x: SimpleNamespace) -> Tensor:
        """Return the rewards of each step while carrying, with the barriers, shape (T, E)."""
        task = self.experiment.task
        env = self.env
        p = task.reward
        bounds = task.bounds
        rate = x.response[1:, :, 1:]
        height = x.pos[1:, :, 2]
        load = x.load_pos[1:, :, 2]
        upright = ob.rotation_from_quat(x.quat[1:])[..., 2, 2]
        action = act.clip_action(x.action)
        first = env.start_action.expand_as(action[:1])
        before = torch.cat([first, action[:-1]])
        commanding = rewards.command(p, action, env.rate_weights)
        changing = rewards.change(p, action, before, env.change_weights)
        margins = [
            height - bounds.altitude[0] - ALTITUDE,
            bounds.altitude[1] - ALTITUDE - height,
            height - load - ABOVE,
            load - self.experiment.release.landing_height - GROUND,
            bounds.horizontal - ALTITUDE - x.pos[1:, :, :2].norm(dim=-1),
            upright - math.cos(math.radians(bounds.tilt_deg)) - UPRIGHT,
            SLACK * (self._pull(x) - PULL),
        ]
        barrier = BARRIER * sum(gap.clamp(max=0.0).square() for gap in margins)
        moving = rewards.kinetic(p, x.vel[1:], rate, x.load_vel[1:])
        time = rewards.carry_time(p, self.experiment.sim.control_period)
        return moving + commanding + changing + time - barrier

    def _cost(self, x: SimpleNamespace) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the mean cost of the flights, and figures of their releases."""
        p = self.experiment.task.reward
        steps = self.flights.steps
        T = self.flights.last
        lag = self.lag
        k = torch.arange(T, device=steps.device)[:, None]
        K = T - lag - 1  # the cubic needs a step after the separation
        released = k[:K]
        reward, error, fall = self._rewards_at_release(x, K)
        latch_input = x.action[:K, :, act.COMMANDS] - self.experiment.release.threshold
        smooth = torch.sigmoid(latch_input / self._width)
        cut = released + lag + 2 > steps
        # the slope remains that of the smooth hazard
        hazard = smooth + self._latched * ((latch_input > 0.0).float() - smooth).detach()
        hazard = torch.where(released > steps, 1.0, hazard * (released >= self._first))
        reward = torch.where(cut, -p.termination, reward)
        # roll wraps around, but there is no release in the first and last steps
        for shift in (1, -1) * REACH:
            reward = 0.5 * (reward + reward.roll(shift, 0))
        survival = torch.cat([torch.ones_like(hazard[:1]), (1.0 - hazard).cumprod(0)])
        chance = survival[:-1] * hazard
        carried = survival[(k[:, 0] - lag).clamp(0, K)] * (k < steps)
        excess = (x.action.abs() - 1.0).clamp(min=0.0)
        past = excess.square().sum(-1) * carried.detach()
        releasing = (chance * reward).sum(0)
        carrying = (carried * self._reward_carrying(x)).sum(0)
        gain = releasing + carrying - p.termination * survival[-1]
        done = (chance * ~cut).detach()
        error = (error.square() - ROUND**2).clamp(min=0.0).sqrt()
        carry = (released + 1) * self.experiment.sim.control_period
        duration = carry + self.experiment.release.lag + fall
        share = done / done.sum().clamp(min=1e-6)
        figures = {
            "landing_error": (share * error).sum(),
            "duration": (share * duration).sum(),
            "released": done.sum(0).mean(),
        }
        return (self.p.saturation * past.sum(0) - gain).mean() * p.scale, figures

    def derivatives(self) -> dict[str, Tensor]:
        """Write the derivatives of the last rollout's cost by the actions into the layers; return
        figures.
        """
        flights = self.flights
        T = flights.last
        leaves = {name: flights.x[name][: T + 1].clone().requires_grad_() for name in STATES}
        leaves["action"] = self.layers.action[:T].clone().requires_grad_()
        with torch.enable_grad():
            cost, figures = self._cost(SimpleNamespace(**leaves))
        *by_states, by_action = torch.autograd.grad(cost, list(leaves.values()))
        for name, gradient in zip(STATES, by_states):
            flights.adjoint[name][: T + 1] = gradient
        self.layers.by_action[:T] = by_action
        self.layers.by_observation.zero_()
        self.backward()
        return figures | {"cost": cost}

    def _record_launches(self) -> list[wp.Launch]:
        """Return the launches of the surrogate's backward pass, one for each step."""
        env = self.env
        flights = self.flights
        layers = self.layers
        action = self.experiment.task.action
        p = BackwardParams()
        p.max_thrust = action.max_thrust
        p.max_rate = wp.vec3(*action.max_rate)
        p.history = env.layout.history
        p.period = self.experiment.sim.control_period
        p.decay = self.p.decay
        plants = {
            "mass": flights.mass,
            "load_mass": flights.load_mass,
            "mount": flights.mount,
            "age": env.delay.age,
        }
        for name, tensor in (self.surrogate | plants).items():
            setattr(p, name, wp.from_torch(tensor, dtype=BackwardParams.vars[name].type.dtype))
        arguments = (
            flights.course,
            wp.from_torch(flights.steps),
            wp.from_torch(layers.action, grad=layers.by_action),
            flights.made,
            wp.from_torch(torch.zeros_like(layers.by_observation), grad=layers.by_observation),
        )
        return [
            wp.launch(
                step,
                env.num_envs,
                [p, k, *arguments],
                adj_inputs=[BackwardParams(), None, Course(), None, None, Course(), None],
                device=env.device,
                block_dim=64,
                record_cmd=True,
                adjoint=True,
            )
            for k in range(self.p.horizon)
        ]

    @torch.no_grad()
    def _run_backward(self) -> None:
        """Convert partial derivatives of the cost by states and actions to total derivatives by the
        actions.
        """
        for k in reversed(range(self.flights.last)):
            with on_torch_stream(self.env.device):
                self._launches[k].launch()
            self.layers.backpropagate(k, self.flights.steps >= k)

    def collect(self, done: float) -> None:
        self._schedule(1.0 if self._adapting else done)
        self.rollout()

    @torch.no_grad()
    def learn(self, done: float) -> dict[str, float]:
        p = self.p
        parameters = list(self.network.mlp.parameters())
        T = self.flights.last
        rate = cosine_rate(self.optimizer, done, p.learning_rate, p.final_rate)
        figures = self.derivatives()
        size = self.layers.by_action[:T].square().sum((0, 2)).sqrt().clamp(min=1e-12)
        # a few extreme flights must not dominate the gradient
        limit = OUTLIER * size.median()
        self.layers.gradients(self.flights.mark_flown_steps()[:T], (limit / size).clamp(max=1.0))
        self._ranks.average(parameters)
        figures["gradient_norm"] = torch.nn.utils.clip_grad_norm_(parameters, p.max_grad_norm)
        self.optimizer.step()
        self.network.update_normalization(
            {"actor": self.flights.obs[self.flights.mark_flown_steps()]}
        )
        self.average.update_parameters(self.network)
        return {name: value.item() for name, value in figures.items()} | {
            "learning_rate": rate,
            "episodes": float(self.env.num_envs),
        }

    def take_up(self, policy: Policy) -> None:
        """Start from a policy with the same layers."""
        super().take_up(policy)
        self._adapt()

    def _adapt(self) -> None:
        """Use the schedules of a training that starts from a policy, which already releases."""
        p = self.p
        self._adapting = True
        self.iterations = p.adapting
        self.p = dataclasses.replace(
            p,
            learning_rate=p.adapting_rate,
            final_rate=0.1 * p.adapting_rate,
            width=p.adapting_width,
            final_width=p.adapting_width,
        )

    def state_dict(self) -> dict:
        return super().state_dict() | {"adapting": self._adapting, "surrogate": self.surrogate}

    def load_state_dict(self, saved: dict, keep_throws: bool = True) -> None:
        super().load_state_dict(saved, keep_throws)
        if saved["adapting"]:
            self._adapt()
        for name, value in saved["surrogate"].items():
            self.surrogate[name].copy_(value)
