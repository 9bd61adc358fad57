"""ThrowEnv: the throwing task as rsl_rl's vectorised environment.

A step is a sequence of device operations. It does not branch on data, the simulator allocates
nothing, and nothing is copied to the host, so a whole rollout can be captured in one CUDA graph
(:mod:`visthrow.training.ppo.ppo_training`). Every observation is a new tensor."""

import torch
import warp as wp
from tensordict import TensorDict
from torch import Tensor

from camera import arrays
from camera.keypoint_noise import DetectorView
from sim.hybrid import HybridSim, rope_variants
from sim.params import RopeParams
from sim.torch_bridge import TorchViews, on_torch_stream
from visthrow.common.compute_device import allow_rounded_products
from visthrow.onboard import actions as act
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob
from visthrow.task import Experiment, draw_plants, plant_of, rewards, terminations
from visthrow.task.fleet import Member, members
from visthrow.training.env.env_base import ThrowEpisodes
from visthrow.training.env.options import FleetSetup, MovingGoals, PoseDelay


class ThrowEnv(ThrowEpisodes):
    """A batch of throws with the observation groups ``actor`` and ``critic``.

    The critic observes the quantities in ``ppo.privileged``. ``exact``: vehicle, goal offset and
    payload history without noise, instead of the actor's observation. ``payload_velocity`` [m/s].
    ``release_timer``: time to separation [s]. ``time``: time since the start [s]. ``mass``: scale
    of the vehicle's mass. ``voltage``: battery voltage [V]. ``goal_velocity`` [m/s], if goals move.
    ``cargo``: scales of payload mass and cable length, if these vary. ``mount``: the camera's
    rotation [rad] and offset [m] from its nominal pose. ``pose_age``: age of measured poses [s].
    ``vehicle``: all properties of the vehicle, in a fleet. We understand that the paper's critic
    receives the first two, 38 numbers.

    Attributes:
        last: results of the last step: ``released``, ``negative`` (bool), ``landing_error`` [m],
            ``duration`` [s] from the policy's start to the payload's landing, ``landing_w`` [m],
            ``clearance`` [m]; each over (E,). If goals move, also ``goal_w`` [m], the goal's
            position at impact.
    """

    def __init__(
        self, experiment: Experiment, device: str = "cpu", seed: int = 0, count: int | None = None
    ):
        """Build the simulator and the buffers and start all episodes.

        Args:
            experiment: plant, camera and task.
            device: "cpu" or "cuda:0".
            seed: seed of the simulator's resets. The noise comes from torch's generator, which the
                caller seeds.
            count: number of environments; default the experiment's.
        """
        self.cfg = experiment
        self.device = device
        task = experiment.task
        self.num_envs = count or experiment.ppo.environments
        self.num_actions = act.ACTIONS
        period = experiment.sim.control_period
        self.max_episode_length = round(task.bounds.time_limit / period)
        fleet = members(experiment)
        ropes, share = self._build(fleet, seed)
        self.layout = ob.layout_of(task.observation)
        like = torch.zeros(self.num_envs, device=device)
        row = torch.arange(self.num_envs, device=device) % len(ropes)
        self._fleet = FleetSetup(fleet, task, row // share) if fleet else None
        unit = self._fleet.time_unit if self._fleet else None
        self.delay = PoseDelay(task.observation, period, like, unit)
        self.goals = MovingGoals(task.target.speed, like) if task.target.moves else None
        self.view = DetectorView(experiment.camera, like)
        self._allocate(like)
        self._cargo: Tensor | None = None
        if task.start.payload_variants > 1:
            mass = experiment.rope.payload_mass
            length = experiment.rope.length
            scales = [[r.payload_mass / mass, r.length / length] for r in ropes]
            self._cargo = like.new_tensor(scales)[row]
        self.reset()

    def _build(self, fleet: list[Member], seed: int) -> tuple[list[RopeParams], int]:
        """Build the simulator; return its ropes and the number of ropes for each plant."""
        experiment = self.cfg
        plants = [member.plant for member in fleet] or draw_plants(experiment, seed)
        start = experiment.task.start
        ropes = [rope for plant in plants for rope in rope_variants(plant.rope, start)]
        share = len(ropes) // len(plants)
        variants = {}
        if fleet or len(plants) > 1:
            repeated = [plant for plant in plants for _ in range(share)]
            variants = {
                "vehicles": [plant.vehicle for plant in repeated],
                "airs": [plant.air for plant in repeated],
                "releases": [plant.release for plant in repeated],
            }
        plant = plant_of(experiment)
        self.sim = HybridSim(plant, self.num_envs, self.device, seed, ropes=ropes, **variants)
        self.views = TorchViews(self.sim)
        return ropes, share

    def _allocate(self, like: Tensor) -> None:
        super()._allocate(like)
        E = self.num_envs
        if self._fleet:
            self.max_thrust = self._fleet.max_thrust
            self.start_action = self._fleet.start_action
            self.view.camera.radius = self._fleet.payload_radius
        self._everywhere = like.new_ones(E, dtype=torch.bool)
        if self.layout.response:
            self.buffers["answers"] = like.new_zeros(E, 1 + self.layout.response, ob.RESPONSE)
        if self.layout.fits:
            self.buffers["goal_fit"] = goal_motion.empty_sums(E, self.device)

    def exact_frame(self, age: float) -> Tensor:
        """Return the state frame without noise, shape (E, 20), of an age [s] of at most a control
        period.
        """
        return self._state_frame(self.delay.exact(age), self.views.goal_w)

    def begin_throws(self, correction: tuple[Tensor, Tensor]) -> TensorDict:
        """Begin throws from the vehicles' present states, with the ``correction`` that a
        calibration in hover estimated.

        From now on keypoints are corrected for the cameras' rotations [rad], shape (E, 3), and for
        relative errors of the focal length, shape (E,)."""
        self.view.correction = correction
        self.episode_length_buf.zero_()
        self.previous_action.copy_(self.start_action.expand_as(self.previous_action))
        return self._look(self._everywhere)

    def reset(self) -> TensorDict:
        """Start a new episode in every environment."""
        self._begin(self._everywhere)
        return self._look(self._everywhere)

    def _look(self, fresh: Tensor) -> TensorDict:
        """Observe and store the observations."""
        self._observations = self._observe(fresh)
        return self._observations

    def carry(self, actions: Tensor, mask: wp.array | None = None) -> TensorDict:
        """Apply unclipped actions, shape (E, 5), for one control period with the latch held shut.
        No episode ends, even in a failure.

        ``mask``: the plants that are stepped, shape (E,), int32; default all.
        """
        self.previous_action.copy_(self._apply(actions, True, mask))
        return self._look(~self._everywhere)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply unclipped actions, shape (E, 5), for one control period and restart finished
        episodes.

        Returns observations, rewards (E,), dones (E,), and an empty dictionary. The time limit is a
        failure and must not be bootstrapped, so there are no ``time_outs``."""
        action = self._apply(actions)
        reward, done = self._judge(action)
        self._count(done)
        self.previous_action.copy_(action)
        self._begin(done)
        return self._look(done), reward, done.float(), {}

    def _apply(self, actions: Tensor, hold: bool = False, mask: wp.array | None = None) -> Tensor:
        """Fly one control period and return the clipped actions."""
        action = self._command(actions)
        asked = act.wants_release(actions, self.cfg.release.threshold)
        self.views.release.copy_(asked & (not hold))
        with on_torch_stream(self.device):
            self.sim.step(mask)
        if self.goals is not None:
            self.views.goal_w.add_(self.goals.velocity * self.cfg.sim.control_period)
        self.episode_length_buf += 1
        return action

    def find_failures(self) -> Tensor:
        """Return whether each flight has failed, bool, shape (E,)."""
        state = self.views.state
        return terminations.negative(
            self.cfg.task.bounds,
            state["pos_w"],
            ob.rotation_from_quat(state["quat_wb"]),
            self.views.out["payload_pos_w"],
            state["status"],
            state["release_timer"] >= 0.0,
            self.episode_length_buf * self.cfg.sim.control_period,
            self.cfg.release.landing_height,
        )

    def _judge(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rewards of the last step, shape (E,), and whether it ended its episode."""
        out = self.views.out
        period = self.cfg.sim.control_period
        p = self.cfg.task.reward
        time = self.episode_length_buf * period
        released = out["separated"] != 0
        negative = ~released & self.find_failures()
        goal = self._goal_in(out["separation_time"] + out["time_to_impact"] - period)
        miss = out["landing_w"] - goal
        error = miss[:, :2].square().sum(-1).sqrt()
        attached = self._carry_reward(action, out["payload_vel_w"])
        margin = self.cfg.release.clearance_margin
        at_release = rewards.release_reward(
            p, error, out["time_to_impact"], out["clearance"], margin
        )
        reward = torch.where(released, at_release, attached) + rewards.carry_time(p, period)
        reward = reward - p.termination * negative
        self.last = {
            "released": released,
            "negative": negative,
            "landing_error": error,
            "duration": time - period + out["separation_time"] + out["time_to_impact"],
            "action": action,
            "landing_w": out["landing_w"].clone(),
            "clearance": out["clearance"].clone(),
        }
        if self.goals is not None:
            self.last["goal_w"] = goal
        return p.scale * reward, released | negative

    def _goal_in(self, time: Tensor) -> Tensor:
        """Return the goals' positions [m], shape (E, 3), after a time [s], shape (E,)."""
        if self.goals is None:
            return self.views.goal_w
        return self.views.goal_w + self.goals.velocity * time[:, None]

    def _begin(self, fresh: Tensor) -> None:
        """Start episodes where ``fresh``, bool, shape (E,), and draw their constant quantities."""
        # an attribute, so that it lives until the launches have read it
        self._fresh = fresh.to(torch.int32)
        with on_torch_stream(self.device):
            self.sim.randomize(self.cfg.task.start, wp.from_torch(self._fresh))
        if self._goal is not None:
            goal_w = self.views.goal_w
            goal_w.copy_(torch.where(fresh[:, None], self._goal, goal_w))
        self._restart(fresh)
        for part in self._parts():
            part.begin(fresh)

    def _parts(self) -> list[DetectorView | PoseDelay | MovingGoals]:
        """Return the parts that draw at the start of an episode, in the order of their draws."""
        parts = [self.view, self.delay, self.goals]
        return [part for part in parts if part is not None]

    @allow_rounded_products(False)
    def _observe(self, fresh: Tensor) -> TensorDict:
        """Return the actor's and the critic's observations of the current state."""
        state = self.views.state
        buffers = self.buffers
        layout = self.layout
        payload = self.views.out["payload_pos_w"]
        rot_wb = ob.rotation_from_quat(state["quat_wb"])
        vehicle = ob.vehicle_part(state["pos_w"], state["vel_w"], state["rate_b"], rot_wb)
        attached = state["attached"].float()
        pose = torch.cat([vehicle, payload], dim=-1)
        pose = self.delay.push(pose, fresh)
        late_goal = self._goal_in(-self.delay.age)
        true_frame = self._state_frame(pose, late_goal)
        measured = self._measure(true_frame)
        valid = None
        if layout.name == "vision":
            if self.cfg.task.observation.oldest > 0.0:
                rot_wb = ob.rotation_in(pose)
            payload_w = pose[:, ob.VEHICLE :]
            points, valid = self.view.look(pose[:, :3], rot_wb, late_goal, payload_w, fresh)
            vehicle_measured = measured[:, : ob.VEHICLE]
            measured = torch.cat([vehicle_measured, points.flatten(1)], dim=-1)
        self.measured = measured, valid
        time = self.episode_length_buf.float() * self.cfg.sim.control_period
        goal_vel = places = answers = None
        setup = self._fleet.observed if self._fleet else None
        if layout.fits:
            fitted = goal_motion.update_goal_fit(
                layout, measured, valid, self.view.camera, buffers["goal_fit"], time, fresh
            )
            buffers["goal_fit"].copy_(fitted.sums)
            _, goal_vel, places, measured, valid = fitted
        if layout.response:
            answer = ob.answer(measured, self.previous_action)
            buffers["answers"].copy_(arrays.push(buffers["answers"], answer, fresh))
            answers = buffers["answers"][:, 1:]
        actor, history = ob.observe(
            layout,
            measured,
            valid,
            self.previous_action,
            attached,
            buffers["history"],
            fresh,
            goal_vel,
            places,
            answers,
            setup,
        )
        buffers["history"].copy_(history)
        critic = self._critic_view(actor, vehicle, payload, time, fresh)
        observed = {"actor": actor, "critic": critic}
        return TensorDict(observed, batch_size=[self.num_envs], device=self.device)

    def _critic_view(
        self, actor: Tensor, vehicle: Tensor, payload: Tensor, time: Tensor, fresh: Tensor
    ) -> Tensor:
        """Return the critic's observation, the quantities in ``ppo.privileged``."""
        state = self.views.state
        buffers = self.buffers
        named = self.cfg.ppo.privileged
        parts = [actor]
        if "exact" in named:
            offset = ob.state_part(state["pos_w"], self.views.goal_w, payload)
            payload_offset = offset[:, 2:]
            true_history = arrays.push(buffers["true_history"], payload_offset, fresh)
            buffers["true_history"].copy_(true_history)
            parts = [vehicle, self.previous_action, offset[:, :2], true_history.flatten(1)]
        quantities = {
            "payload_velocity": self.views.out["payload_vel_w"],
            "release_timer": state["release_timer"][:, None],
            "time": time[:, None],
            "mass": state["mass_scale"][:, None],
            "voltage": state["voltage"][:, None],
            "exact": state["attached"].float()[:, None],
        }
        if self.goals is not None:
            quantities["goal_velocity"] = self.goals.velocity[:, :2]
        if self._cargo is not None:
            quantities["cargo"] = self._cargo
        if "mount" in named:
            mount = self.view.buffers
            quantities["mount"] = torch.cat(
                [mount["extrinsic_rotation"], mount["extrinsic_offset"]], dim=-1
            )
        quantities["pose_age"] = self.delay.age[:, None]
        if self._fleet:
            quantities["vehicle"] = self._fleet.exact
        parts += [value for name, value in quantities.items() if name in named]
        return torch.cat(parts, dim=-1)

    def _tensors(self) -> dict[str, Tensor]:
        """Return all state that the next step depends on, except torch's generators."""
        memory = self.buffers.copy()
        for part in self._parts():
            memory |= part.buffers
        tensors = {
            "episode": wp.to_torch(self.sim.episode),
            "goal_w": self.views.goal_w,
            "length": self.episode_length_buf,
        }
        groups = {
            "sim": self.views.state,
            "out": self.views.out,
            "memory": memory,
            "obs": self._observations,
        }
        for group, named in groups.items():
            tensors |= {f"{group}.{name}": tensor for name, tensor in named.items()}
        return tensors

    def state_dict(self) -> dict[str, Tensor]:
        """Return a copy of all state that the next step depends on, except torch's generators."""
        return {k: v.clone() for k, v in self._tensors().items()}

    def load_state_dict(self, saved: dict[str, Tensor]) -> None:
        """Restore a state of :meth:`state_dict`.

        Raises ValueError: the state comes from an environment of another experiment or size.
        """
        for name, target in self._tensors().items():
            if name not in saved or saved[name].shape != target.shape:
                have = tuple(saved[name].shape) if name in saved else "nothing"
                raise ValueError(
                    f"environment state {name!r}; expected shape {tuple(target.shape)}, got {have}"
                )
            target.copy_(saved[name])
