"""Distil a state policy into a vision policy with memory: a recurrent network learns to estimate
the state policy's observation.

The network estimates this observation from the history of vision observations
(:mod:`visthrow.onboard.estimator`), and the state policy acts on the estimate. From the first
iteration on, the throws are flown with the network's estimates, and the network is fitted by
regression to the exact observations of the states that it visits (DAgger: Ross et al., AISTATS
2011), with backpropagation through the whole throw. If the throws were flown with exact
observations, the network would learn to infer the state from the previous action."""

from dataclasses import replace
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
from visthrow.training.ppo.network import MuonAdam, average_weights, cosine_rate, normalizer_state
from visthrow.training.ranks import Ranks

SCALES = (0.02, 0.05, 0.2, 0.02, 1.0, 0.01, 0.005, 1.0)
"""Errors that count equally in the loss: position [m], velocity [m/s], body rates [rad/s],
rotation [-], action, goal and payload offsets [m], latch.
"""

AVERAGED = 100  # longest window of gradient steps over which the exported weights are averaged

# iterations that determine the observations' mean and spread, which are then constant
WATCHED = 50


class EstimatorNetwork(nn.Module):
    """The estimator during training; :class:`visthrow.onboard.estimator.Estimator` describes its
    parts and shapes.
    """

    def __init__(self, passed: Tensor, learnt: Tensor, width: int, p: DistillationParams):
        """Initialise the network so that its estimates are nearly the entries that it corrects.

        Args:
            passed: index of the observation's entry that each estimate corrects, ``width`` for
                none, shape (S,).
            learnt: whether an estimate is learnt, bool, shape (S,).
            width: number D of entries of the observation.
            p: sizes of the layers.
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

    def freeze(self) -> Estimator:
        """Return the estimator for flight, which shares this network's parameters."""
        gru = self.gru
        normaliser = self.normalizer
        parts = [normaliser.mean, normaliser.std + normaliser.eps]
        parts += [self.encoder.weight, self.encoder.bias]
        parts += [gru.weight_ih_l0, gru.bias_ih_l0, gru.weight_hh_l0, gru.bias_hh_l0]
        parts.append(self.output.weight * self.learnt[:, None])
        parts += [self.output.bias * self.learnt, self.kept]
        inner = tuple((layer.weight.detach(), layer.bias.detach()) for layer in self.inner)
        return Estimator(*(part.detach() for part in parts), inner)

    @property
    def matrices(self) -> list[Tensor]:
        """Return the weight matrices of all layers except the last."""
        layers = (self.encoder, *self.inner, self.gru)
        return [w for layer in layers for w in layer.parameters() if w.dim() == 2]

    def forward(self, obs: Tensor) -> Tensor:
        """Return estimates, shape (T, E, S), for the observations of throws, shape (T, E, D)."""
        x = F.elu(self.encoder(self.normalizer(obs)))
        for layer in self.inner:
            x = F.elu(layer(x))
        x, _ = self.gru(x)
        return F.pad(obs, (0, 1))[..., self.kept] + self.output(x) * self.learnt


class Distillation(Algorithm):
    """Distillation of a state policy.

    Attributes:
        teacher: the state policy.
        network: the estimator that is fitted.
    """

    parts = ("network", "average", "optimizer")

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: Ranks):
        self.experiment = experiment
        self.p = p = experiment.distillation
        if experiment.task.target.moves or experiment.task.observation.layout != "vision":
            raise ConfigError(
                'algorithm = "distillation" needs stationary goals and observation.layout ='
                ' "vision"'
            )
        self._ranks = ranks
        self.teacher = Policy.load(find_policy(p.teacher), device)
        self.teacher.require(contract_of(experiment), ("action", "control_period", "release"))
        contract = self.teacher.contract["observation"]
        self._layout = layout = ob.layout_of(SimpleNamespace(**contract))
        if layout.name != "state" or layout.motion or layout.located or layout.response:
            raise ConfigError(
                f"distillation.teacher {p.teacher!r} has the layout {layout.name!r}; expected"
                " 'state', as the paper's: without goal_velocity, located and response"
            )
        self.env = env = ThrowEnv(experiment, device, seed)
        self.iterations = p.iterations
        E = env.num_envs
        T = p.horizon
        self.samples = E * T * ranks.world
        self._age = sum(contract["latency"]) / 2.0
        passed, learnt = _map_entries(env.layout, layout)
        self.network = EstimatorNetwork(passed, learnt, env.layout.dimension, p).to(device)
        ranks.share(self.network)
        widths = [3, 3, 3, 6, act.ACTIONS, 2, 3 * (1 + layout.history), 1]
        self._scales = torch.tensor(SCALES).repeat_interleave(torch.tensor(widths)).to(device)
        self._obs = torch.zeros(T, E, env.layout.dimension, device=device)
        self._truth = torch.zeros(T, E, layout.dimension, device=device)
        self._alive = torch.zeros(T, E, device=device)
        self._history = torch.zeros(E, 1 + layout.history, layout.payload, device=device)
        self._flying = self.network.freeze()
        self.average = average_weights(self.network, AVERAGED)
        on_gpu = device.startswith("cuda")
        weights = self.network.parameters()
        matrices = self.network.matrices
        self.optimizer = MuonAdam(weights, matrices, lr=p.learning_rate, fused=on_gpu)
        self.rollout = ReplayedGraph(self._fly) if on_gpu else self._fly

    @torch.no_grad()
    def _fly(self) -> None:
        """Fly one batch from new starts; record observations, exact state observations, and which
        throws are still in progress.
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
        p = self.p
        rate = cosine_rate(self.optimizer, done, p.learning_rate, p.final_rate)
        if done * self.iterations < WATCHED:
            self.network.normalizer.update(self._obs.flatten(0, 1))
        losses = []
        for _ in range(p.epochs):  # each throw once
            order = torch.randperm(self.env.num_envs, device=self.env.device)
            losses += [self._step(rows) for rows in order.chunk(p.minibatches)]
        figures = {"value": float(sum(losses)) / len(losses), "learning_rate": rate}
        return figures | self.env.episode_means()

    def _step(self, rows: Tensor) -> Tensor:
        """Take one gradient step on the throws of these indices; return their mean error in units
        of :data:`SCALES`.
        """
        truth = self._truth[:, rows]
        alive = self._alive[:, rows]
        estimate = self.network(self._obs[:, rows])
        scaled = estimate / self._scales
        off = F.smooth_l1_loss(scaled, truth / self._scales, reduction="none").mean(-1)
        target = act.clip_action(self.teacher.decide(truth))
        action = self.teacher.decide(estimate)
        # both actions are clipped: past a limit, the gradient is zero or points back
        wrong = (act.clip_action(action) - target).detach()
        acted = (wrong * action).sum(-1)
        count = alive.sum()
        loss = (alive * (off + self.p.action_weight * acted)).sum() / count
        self.network.zero_grad()
        loss.backward()
        self._ranks.average(self.network.parameters())
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.average.update_parameters(self.network)
        return (alive * off).sum().detach() / count

    def _refresh(self) -> None:
        """Copy the network's state into the estimator that flies, in place, because a captured
        rollout reads these tensors.
        """
        flying = self._flying.parts()
        for name, value in self.network.freeze().parts().items():
            flying[name].copy_(value)

    def export(self, contract: dict, made_by: dict) -> Policy:
        t = self.teacher.to("cpu")
        parts = self.average.module.freeze().parts()
        estimator = Estimator.from_parts({name: part.cpu().clone() for name, part in parts.items()})
        return replace(t, contract=contract, made_by=made_by, estimator=estimator)

    def take_up(self, policy: Policy) -> None:
        e = policy.estimator
        n = self.network
        parts = e.parts()
        # shares the network's memory, except for the masked output layer
        taken = n.freeze().parts()
        if {k: v.shape for k, v in parts.items()} != {k: v.shape for k, v in taken.items()}:
            raise ConfigError(
                "--from: the policy has no estimator of this configuration's shape to start from"
            )
        for name, value in parts.items():
            taken[name].copy_(value)
        n.output.load_state_dict({"weight": e.output_weight, "bias": e.output_bias})
        n.normalizer.load_state_dict(normalizer_state(e.mean, e.std - n.normalizer.eps))
        self.average.module.load_state_dict(n.state_dict())


def _map_entries(vision: ob.Layout, state: ob.Layout) -> tuple[Tensor, Tensor]:
    """Return the entry of the vision observation that each estimated entry of a state observation
    corrects, shape (S,), and whether the estimate is learnt, bool, shape (S,).
    """
    known = ob.VEHICLE + 5
    columns = torch.full((state.dimension,), vision.dimension)
    columns[:known] = torch.arange(known)
    if vision.located:
        columns[known : known + 2] = torch.tensor(vision.columns("located")[:2])
    columns[-1:] = torch.tensor(vision.columns("attached"))
    learnt = torch.ones(state.dimension, dtype=torch.bool)
    # the previous action and the latch are known
    learnt[ob.VEHICLE : known] = False
    learnt[-1] = False
    return columns, learnt
