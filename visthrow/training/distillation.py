"""A vision policy with a memory, distilled from a state policy: an estimator learns what the state
policy looks at.

The state policy decides; in place of its observation it is given the estimate that a recurrent
network makes of all that a vision policy has seen (:mod:`visthrow.onboard.estimator`). The network
flies from the first iteration on, and is fitted by regression to the exact observation on the
states that it meets (DAgger: Ross et al., AISTATS 2011), with backpropagation through the whole
throw. Throws that the exact observation flies would teach it to read the truth out of the action
before."""

from itertools import pairwise
from types import SimpleNamespace

import torch
import torch.nn.functional as F
from rsl_rl.modules import EmpiricalNormalization
from torch import Tensor, nn

from sim.torch_bridge import ReplayedGraph
from visthrow.common.errors import ConfigError
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import DistillationParams, Experiment, contract_of
from visthrow.training.env import ThrowEnv
from visthrow.training.ppo.algorithm import Algorithm
from visthrow.training.ppo.network import MuonAdam, averaged, cosine_rate, normalizer_state
from visthrow.training.ranks import Ranks

SCALES = (0.02, 0.05, 0.2, 0.02, 0.01, 0.005)
"""Errors that count alike: of position [m], velocity [m/s], body rates [rad/s], rotation [-], goal
and payload offsets [m].
"""

AVERAGED = 100  # gradient steps that the exported weights are a mean of, at most

# iterations in which the observations' mean and spread are taken; from there they stand still
WATCHED = 50


class EstimatorNetwork(nn.Module):
    """The estimator as it is trained; see :class:`visthrow.onboard.estimator.Estimator` for its
    parts and shapes.
    """

    def __init__(self, passed: Tensor, learnt: Tensor, width: int, p: DistillationParams):
        """Begin with an estimate of what is kept: the entry of the observation that each estimate
        corrects, ``width`` for none, shape (S,).

        ``learnt``: which estimates are learnt, bool, shape (S,). width: D. p: sizes.
        """
        super().__init__()
        widths = (p.hidden, *p.inner)
        self.encoder = nn.Linear(width, p.hidden)
        self.inner = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
        self.gru = nn.GRU(widths[-1], p.memory)
        self.output = nn.Linear(p.memory, len(passed))
        with torch.no_grad():
            self.output.weight.mul_(0.1)
            self.output.bias.zero_()
        self.normalizer = EmpiricalNormalization(width)
        self.register_buffer("kept", passed)
        self.register_buffer("learnt", learnt.float())

    def frozen(self) -> Estimator:
        """Return the estimator that flies; it shares the parameters."""
        mask = self.learnt
        gru = self.gru
        normaliser = self.normalizer
        parts = [
            normaliser.mean,
            normaliser.std + normaliser.eps,
            self.encoder.weight,
            self.encoder.bias,
        ]
        parts += [gru.weight_ih_l0, gru.bias_ih_l0, gru.weight_hh_l0, gru.bias_hh_l0]
        parts += [self.output.weight * mask[:, None], self.output.bias * mask, self.kept]
        inner = tuple((layer.weight.detach(), layer.bias.detach()) for layer in self.inner)
        return Estimator(*(part.detach() for part in parts), inner)

    @property
    def matrices(self) -> list[Tensor]:
        """Weights of all layers but the last."""
        layers = (self.encoder, *self.inner, self.gru)
        return [w for layer in layers for w in layer.parameters() if w.dim() == 2]

    def forward(self, obs: Tensor) -> Tensor:
        """Estimates, shape (T, E, S), along throws, shape (T, E, D)."""
        x = F.elu(self.encoder(self.normalizer(obs)))
        for layer in self.inner:
            x = F.elu(layer(x))
        x, _ = self.gru(x)
        return F.pad(obs, (0, 1))[..., self.kept] + self.output(x) * self.learnt


class Distillation(Algorithm):
    """Distillation of a state policy.

    Attributes:
        teacher: the state policy. network: what is fitted.
    """

    parts = ("network", "average", "optimizer")

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: Ranks):
        self.experiment = experiment
        self.p = experiment.distillation
        observation = experiment.task.observation
        if experiment.task.target.moves or observation.layout != "vision":
            raise ConfigError(
                'algorithm = "distillation" takes goals that stand still and observation.layout ='
                ' "vision"'
            )
        self._ranks = ranks
        self.teacher = Policy.load(find_policy(self.p.teacher), device)
        self.teacher.require(contract_of(experiment), ("action", "control_period", "release"))
        contract = self.teacher.contract["observation"]
        self._layout = ob.layout_of(SimpleNamespace(**contract))
        if self._layout.name != "state":
            raise ConfigError(
                f"distillation.teacher {self.p.teacher!r} has the layout {self._layout.name!r};"
                " expected 'state'"
            )
        if self._layout.motion or self._layout.located or self._layout.response:
            raise ConfigError(
                f"distillation.teacher {self.p.teacher!r} is given more than the paper's state"
                " policy; expected one without goal_velocity, located and response"
            )
        self.env = env = ThrowEnv(experiment, device, seed)
        self.iterations = self.p.iterations
        E = env.num_envs
        T = self.p.horizon
        self.samples = E * T * ranks.world
        self._age = sum(contract["latency"]) / 2.0
        passed, learnt = _passed(env.layout, self._layout)
        self.network = EstimatorNetwork(passed, learnt, env.layout.dimension, self.p).to(device)
        ranks.share(self.network)
        widths = (3, 3, 3, 6, act.ACTIONS, 2, 3 * (1 + self._layout.history), 1)
        scales = (*SCALES[:4], 1.0, *SCALES[4:], 1.0)
        make = {"device": device, "dtype": torch.float32}
        self._scales = torch.cat(
            [torch.full((width,), scale, **make) for width, scale in zip(widths, scales)]
        )
        self._obs, self._truth = (
            torch.zeros(T, E, env.layout.dimension, **make),
            torch.zeros(T, E, self._layout.dimension, **make),
        )
        self._alive = torch.zeros(T, E, **make)
        self._history = torch.zeros(E, 1 + self._layout.history, self._layout.payload, **make)
        self._flying = self.network.frozen()
        self.average = averaged(self.network, AVERAGED)
        on_gpu = device.startswith("cuda")
        weights = self.network.parameters()
        self.optimizer = MuonAdam(
            weights, self.network.matrices, lr=self.p.learning_rate, fused=on_gpu
        )
        self.rollout = ReplayedGraph(self._fly) if on_gpu else self._fly

    @torch.no_grad()
    def _fly(self) -> None:
        """Fly one batch from new starts and record what was seen, what there was, and until when
        each throw lasted.
        """
        env = self.env
        policy = self.teacher
        observed = env.reset()["actor"]
        memory = torch.zeros(env.num_envs, self.p.memory, device=env.device)
        alive = torch.ones_like(self._alive[0])
        fresh = alive > 0.0
        for k in range(self.p.horizon):
            self._obs[k].copy_(observed)
            truth, history = ob.observe(
                self._layout,
                env.exact_frame(self._age),
                None,
                env.previous_action,
                env.views.state["attached"].float(),
                self._history,
                fresh if k == 0 else ~fresh,
            )
            self._history.copy_(history)
            self._truth[k].copy_(truth)
            self._alive[k].copy_(alive)
            estimate, memory = self._flying.step(observed, memory)
            observations, _, done, _ = env.step(policy.decide(estimate))
            observed = observations["actor"]
            alive = alive * (done == 0)

    def collect(self, done: float) -> None:
        self.env.clear_totals()
        self._refresh()
        self.rollout()

    def learn(self, done: float) -> dict[str, float]:
        rate = cosine_rate(self.optimizer, done, self.p.learning_rate, self.p.final_rate)
        if done * self.iterations < WATCHED:
            self.network.normalizer.update(self._obs.flatten(0, 1))
        return self._descend() | self.env.episode_means() | {"learning_rate": rate}

    def _descend(self) -> dict[str, float]:
        """Fit the last rollout, each throw once an epoch."""
        total = torch.zeros((), device=self.env.device)
        for _ in range(self.p.epochs):
            for rows in torch.randperm(self.env.num_envs, device=self.env.device).chunk(
                self.p.minibatches
            ):
                obs = self._obs[:, rows]
                truth = self._truth[:, rows]
                alive = self._alive[:, rows]
                estimate = self.network(obs)
                off = F.smooth_l1_loss(
                    estimate / self._scales, truth / self._scales, reduction="none"
                ).mean(-1)
                target = act.clip_action(self.teacher.decide(truth))
                action = self.teacher.decide(estimate)
                wrong = (
                    act.clip_action(action) - target
                ).detach()  # beyond the limits only the way back counts
                acted = (wrong * action).sum(-1) if self.p.action_weight else 0.0
                loss = (alive * (off + self.p.action_weight * acted)).sum() / alive.sum()
                self.network.zero_grad()
                loss.backward()
                self._ranks.average(self.network.parameters())
                nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
                self.optimizer.step()
                self.average.update_parameters(self.network)
                total += (alive * off).sum().detach() / alive.sum()
        return {"value": float(total) / (self.p.epochs * self.p.minibatches)}

    def _refresh(self) -> None:
        """Take the network's state into what flies, in place: a captured rollout reads these
        tensors.
        """
        flying = self._flying.parts()
        for name, value in self.network.frozen().parts().items():
            flying[name].copy_(value)

    def export(self, contract: dict, made_by: dict) -> Policy:
        t = self.teacher.to("cpu")
        parts = self.average.module.frozen().parts()
        estimator = Estimator.of_parts({name: part.cpu().clone() for name, part in parts.items()})
        return Policy(
            t.weights, t.biases, t.activation, contract, made_by, t.mean, t.std, t.eps, estimator
        )

    def take_up(self, policy: Policy) -> None:
        e = policy.estimator
        n = self.network
        fits = e is not None and {k: v.shape for k, v in e.parts().items()} == {
            k: v.shape for k, v in n.frozen().parts().items()
        }
        if not fits:
            raise ConfigError(
                "--from: the policy has no estimator of this configuration's shape to start from"
            )
        taken = n.frozen().parts()  # the network's own memory, but for the masked output's
        for name, value in e.parts().items():
            taken[name].copy_(value)
        n.output.load_state_dict({"weight": e.output_weight, "bias": e.output_bias})
        n.normalizer.load_state_dict(normalizer_state(e.mean, e.std - n.normalizer.eps))
        self.average.module.load_state_dict(n.state_dict())


def _passed(vision: ob.Layout, state: ob.Layout) -> tuple[Tensor, Tensor]:
    """Which entry of a vision observation each entry of a state observation corrects, and which of
    these are learnt.
    """
    none = vision.dimension
    vehicle = list(range(ob.VEHICLE + 5))
    places = vision.dimension - vision.motion - vision.located
    goal = [places, places + 1] if vision.located else [none, none]
    between = state.dimension - len(vehicle) - len(goal) - 1
    columns = torch.tensor([*vehicle, *goal, *[none] * between, places - vision.validity - 1])
    learnt = torch.ones(state.dimension, dtype=torch.bool)
    # the action before and the latch are known
    learnt[ob.VEHICLE : ob.VEHICLE + 5] = False
    learnt[-1] = False
    return columns, learnt
