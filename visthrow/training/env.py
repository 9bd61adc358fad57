"""ThrowEnv: the throwing task as rsl_rl's vectorised environment.

A step is a chain of device operations without branches on data, allocations on the simulator's side
or copies to the host, so a whole rollout can be captured in one CUDA graph
(:mod:`visthrow.training.ppo.algorithm`). Every observation is a fresh tensor."""

import math

import torch
import warp as wp
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from camera import history as hist
from camera.keypoints import KEYPOINTS, KeypointCamera, corrected_keypoints, keypoints
from camera.noise import StepDraw, apply_latency, apply_noise
from sim.hybrid import HybridSim, rope_variants
from sim.params import GRAVITY
from sim.torch_bridge import TorchViews, on_torch_stream
from visthrow.onboard import actions as act
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob
from visthrow.task import Experiment, drawn_plants, plant_of
from visthrow.task.fleet import members
from visthrow.training import rewards, terminations
from visthrow.training.device import rounded_products

RESULTS = ("episodes", "released", "landing_error", "duration")
"""Sums over finished episodes; landing error [m] and duration [s] over the released ones."""

POSE = (
    ob.VEHICLE + 3
)  # width of a pose sample: vehicle's part of a frame and the payload's position


class ThrowEnv(VecEnv):
    """Batch of throws. Observation groups: ``actor`` and ``critic``.

    The critic sees what ``ppo.privileged`` names. ``exact``: vehicle, goal offset and payload
    history without noise, else the actor's observation. ``payload_velocity`` [m/s].
    ``release_timer``: to separation [s]. ``time``: since the start [s]. ``mass``: the vehicle's
    scale. ``voltage``: of the battery [V]. ``goal_velocity`` [m/s] and ``cargo``, the scales of
    payload mass and cable length, where the task has them. ``mount``: the camera's rotation [rad]
    and offset [m] from its nominal pose. ``pose_age``: of what is measured [s]. ``vehicle``: of a
    fleet, all of its set-up. The paper's critic, as we read it, receives the first two, 38 numbers.

    Attributes:
        last: what the last step ended: ``released``, ``negative`` (bool), ``landing_error`` [m],
            ``duration`` [s] from the policy's start to the payload's landing, ``landing_w`` [m],
            ``clearance`` [m]; each over (E,). Where goals move, ``goal_w`` [m] too, where the goal
            is at impact.
    """

    def __init__(
        self, experiment: Experiment, device: str = "cpu", seed: int = 0, count: int | None = None
    ):
        """Build simulator and buffers and start all episodes.

        Args:
            experiment, device: plant, camera, task; "cpu" or "cuda:0".
            seed: of the simulator's resets; torch's own generator draws the noise and is the
                caller's to seed.
            count: number of environments; default the experiment's.
        """
        self.cfg = experiment
        self.device = device
        task = experiment.task
        self.num_envs = count or experiment.ppo.environments
        self.num_actions = act.ACTIONS
        self.max_episode_length = round(task.bounds.time_limit / experiment.sim.control_period)
        fleet = members(experiment)
        plants = [member.plant for member in fleet] or drawn_plants(experiment, seed)
        ropes = [rope for plant in plants for rope in rope_variants(plant.rope, task.start)]
        share = len(ropes) // len(plants)
        parts_of = {
            name: [getattr(plant, name) for plant in plants for _ in range(share)]
            for name in ("vehicle", "air", "release")
        }
        if fleet or len(plants) > 1:
            variants = {f"{name}s": parts for name, parts in parts_of.items()}
        else:
            variants = {}
        self.sim = HybridSim(
            plant_of(experiment), self.num_envs, device, seed, ropes=ropes, **variants
        )
        self.views = TorchViews(self.sim)
        self.layout = ob.layout_of(task.observation)
        self._found: tuple[Tensor, Tensor] | None = None  # by a calibration
        self.camera = KeypointCamera(experiment.camera, device)
        E = self.num_envs
        make = {"device": device, "dtype": torch.float32}
        self._max_thrust: float | Tensor = task.action.max_thrust
        self._start_action = torch.tensor(
            act.hover_action(GRAVITY * plant_of(experiment).total_mass, self._max_thrust), **make
        )
        self._setup = self._known = self._clock = None
        if fleet:
            each_of = torch.arange(E, device=device) % len(ropes) // share

            def per_environment(values: list) -> Tensor:
                return torch.tensor(values, **make)[each_of]

            self._max_thrust = per_environment([[m.max_thrust] for m in fleet])
            self._start_action = per_environment([m.first_action for m in fleet])
            self._setup = per_environment([m.setup(task.observation.setup) for m in fleet])
            self._known = per_environment([m.exact for m in fleet])
            self._clock = per_environment([m.units.time for m in fleet])
            self.camera.radius = per_environment([m.plant.rope.payload_radius for m in fleet])
        self._max_rate = torch.tensor(task.action.max_rate, **make)
        self._rate_weights = torch.tensor(task.reward.rate_command, **make)
        self._change_weights = torch.tensor(task.reward.command_change, **make)
        self.episode_length_buf = torch.zeros(E, device=device, dtype=torch.long)
        self._memory = self._remembered()
        self._latency = torch.tensor(experiment.camera.noise.latency, **make)
        self._cargo: Tensor | None = None
        if task.start.payload_variants > 1:
            scales = [
                [r.payload_mass / experiment.rope.payload_mass, r.length / experiment.rope.length]
                for r in ropes
            ]
            self._cargo = torch.tensor([scales[e % len(ropes)] for e in range(E)], **make)
        self.last: dict[str, Tensor] = {}
        self._goal: Tensor | None = None
        self.reset()

    def _remembered(self) -> dict[str, Tensor]:
        """Return the buffers that an episode carries beside the simulator's state."""
        task = self.cfg.task
        E = self.num_envs
        make = {"device": self.device, "dtype": torch.float32}
        observation = task.observation
        latency = self.cfg.camera.noise.history_length
        device = self.device
        if self._clock is None:
            oldest = observation.oldest
        else:
            oldest = observation.oldest / float(self._clock.min())
        memory = {
            "previous": torch.zeros(E, act.ACTIONS, **make),
            "history": torch.zeros(E, 1 + self.layout.history, self.layout.payload, **make),
            "true_history": torch.zeros(E, 1 + self.layout.history, 3, **make),
            "frame_bias": torch.zeros(E, ob.VEHICLE + 5, **make),
            "command_bias": torch.zeros(E, act.COMMANDS, **make),
            "keypoint_bias": torch.zeros(E, KEYPOINTS, 2, **make),
            "extrinsic_rotation": torch.zeros(E, 3, **make),
            "extrinsic_offset": torch.zeros(E, 3, **make),
            "pose_age": torch.zeros(E, **make),
            "poses": torch.zeros(
                E, 1 + max(math.ceil(oldest / self.cfg.sim.control_period - 1e-6), 1), POSE, **make
            ),
            "scale_error": torch.zeros(E, 1, 1, **make),
            "held_points": torch.zeros(E, KEYPOINTS, 2, **make),
            "held_valid": torch.zeros(E, KEYPOINTS, device=device, dtype=torch.bool),
            "late_points": torch.zeros(E, latency, KEYPOINTS, 2, **make),
            "late_valid": torch.zeros(E, latency, KEYPOINTS, device=device, dtype=torch.bool),
            "totals": torch.zeros(len(RESULTS), device=device, dtype=torch.float64),
            "continued": torch.zeros(E, device=device, dtype=torch.bool),
        }
        if self.layout.response:
            memory["answers"] = torch.zeros(E, 1 + self.layout.response, ob.RESPONSE, **make)
        if task.target.moves:
            memory["goal_vel"] = torch.zeros(E, 3, **make)
        if self.layout.fits:
            memory["goal_fit"] = goal_motion.empty_sums(E, device)
        return memory

    @property
    def previous_action(self) -> Tensor:
        """Clipped action of the last step, shape (E, 5)."""
        return self._memory["previous"]

    @property
    def pose_age(self) -> Tensor:
        """Age of what is measured in these episodes [s], shape (E,)."""
        return self._memory["pose_age"]

    def extrinsics(self) -> tuple[Tensor, Tensor] | None:
        """Mounts of these episodes' cameras (:meth:`camera.keypoints.KeypointCamera.extrinsics`);
        None where all are nominal.
        """
        mount = self.cfg.camera.mount
        if mount.rotation_error_std == 0.0 and mount.position_error_std == 0.0:
            return None
        return self.camera.extrinsics(
            self._memory["extrinsic_rotation"], self._memory["extrinsic_offset"]
        )

    def exact_frame(self, age: float) -> Tensor:
        """State frame without noise, shape (E, 20), as it was so long ago [s], at most a control
        period.
        """
        newer, older = self._memory["poses"][:, :2].unbind(1)
        pose = torch.lerp(newer, older, age / self.cfg.sim.control_period)
        offset = ob.state_part(pose[:, :3], self.views.goal_w, pose[:, ob.VEHICLE :])
        return torch.cat([pose[:, : ob.VEHICLE], offset], dim=-1)

    def begin_throws(self, correction: tuple[Tensor, Tensor]) -> TensorDict:
        """Begin throws where the vehicles are, with what a calibration in the hover before found.

        Keypoints are corrected from here on for the cameras' turns [rad], shape (E, 3), and errors
        of focal length [-], shape (E,)."""
        self._found = correction
        fresh = torch.ones(self.num_envs, device=self.device, dtype=torch.bool)
        self.episode_length_buf.zero_()
        self._memory["previous"].copy_(self._start_action.expand_as(self._memory["previous"]))
        self._observations = self._observe(fresh)
        return self._observations

    def fix_goal(self, goal_w: Tensor | None) -> None:
        """Use one goal [m], shape (3,), for all episodes from the next reset on, or drawn ones
        again (None).
        """
        self._goal = goal_w

    def _start(self, fresh: Tensor) -> None:
        """Start episodes where ``fresh``, bool, shape (E,)."""
        self._fresh = fresh.to(torch.int32)
        with on_torch_stream(self.device):
            self.sim.randomize(self.cfg.task.start, wp.from_torch(self._fresh))
        if self._goal is not None:
            self.views.goal_w.copy_(torch.where(fresh[:, None], self._goal, self.views.goal_w))

    def clear_totals(self) -> None:
        """Start the sums again."""
        self._memory["totals"].zero_()

    def episode_means(self) -> dict[str, float]:
        """Means over the episodes that finished since :meth:`clear_totals`, and their number.

        ``released`` is a share of the episodes; ``landing_error`` [m] and ``duration`` [s] are
        means over the released."""
        totals = dict(zip(RESULTS, self._memory["totals"].tolist(), strict=True))
        released = max(totals["released"], 1.0)
        episodes = max(totals["episodes"], 1.0)
        means = {name: totals[name] / released for name in ("landing_error", "duration")}
        return {"released": totals["released"] / episodes, **means, "episodes": totals["episodes"]}

    def reset(self) -> TensorDict:
        """Start a new episode everywhere."""
        fresh = torch.ones(self.num_envs, device=self.device, dtype=torch.bool)
        self._start(fresh)
        self._begin(fresh)
        self._observations = self._observe(fresh)
        return self._observations

    def get_observations(self) -> TensorDict:
        """Observations of the current step."""
        return self._observations.clone()

    def carry(self, actions: Tensor, mask: wp.array | None = None) -> TensorDict:
        """Apply unclipped actions, shape (E, 5), for one control period with the latch shut,
        whatever becomes of it: no episode ends.

        ``mask``: plants that move on, shape (E,), int32; default all.
        """
        self._memory["previous"].copy_(self._apply(actions, True, mask))
        self._observations = self._observe(self._memory["continued"])
        return self._observations

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply unclipped actions, shape (E, 5), for one control period; finished episodes start
        anew.

        Returns observations, rewards (E,), dones (E,), and an empty dictionary: the time limit is a
        negative end and must not be bootstrapped, so there are no ``time_outs``."""
        action = self._apply(actions)
        reward, done = self._judge(action)
        hit = self.last["released"].to(torch.float32)
        rows = torch.stack(
            [
                done.to(torch.float32),
                hit,
                self.last["landing_error"] * hit,
                self.last["duration"] * hit,
            ]
        )
        self._memory["totals"] += rows.sum(-1, dtype=torch.float64)
        self._start(done)
        self._memory["previous"].copy_(action)
        self._begin(done)
        self._observations = self._observe(done)
        return self._observations, reward, done.to(torch.float32), {}

    def _apply(self, actions: Tensor, hold: bool = False, mask: wp.array | None = None) -> Tensor:
        """Fly one control period; returns the clipped actions."""
        task = self.cfg.task
        memory = self._memory
        action = act.clip_action(actions)
        noisy = (
            action[:, : act.COMMANDS]
            + torch.randn_like(memory["command_bias"]) * task.noise.command_step
        )
        noisy = noisy + memory["command_bias"]
        self.views.command.copy_(act.command_from_action(noisy, self._max_thrust, self._max_rate))
        self.views.release.copy_(
            act.release_asked(actions, self.cfg.release.threshold) & (not hold)
        )
        with on_torch_stream(self.device):
            self.sim.step(mask)
        if task.target.moves:
            self.views.goal_w.add_(memory["goal_vel"] * self.cfg.sim.control_period)
        self.episode_length_buf += 1
        return action

    def _judge(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Reward and end of the step just made."""
        task = self.cfg.task
        state = self.views.state
        out = self.views.out
        period = self.cfg.sim.control_period
        p = task.reward
        time = self.episode_length_buf * period
        released = out["separated"] != 0
        latched = state["release_timer"] >= 0.0
        negative = ~released & terminations.negative(
            task.bounds,
            state["pos_w"],
            ob.rotation_from_quat(state["quat_wb"]),
            out["payload_pos_w"],
            state["status"],
            latched,
            time,
            self.cfg.release.landing_height,
        )
        goal = self._goal_in(out["separation_time"] + out["time_to_impact"] - period)
        error = (out["landing_w"] - goal)[:, :2].square().sum(-1).sqrt()
        attached = (
            rewards.kinetic(p, state["vel_w"], state["rate_b"], out["payload_vel_w"])
            + rewards.command(p, action, self._rate_weights)
            + rewards.change(p, action, self._memory["previous"], self._change_weights)
        )
        at_release = (
            rewards.landing(p, error)
            + rewards.time_of_flight(p, out["time_to_impact"])
            + rewards.proximity(p, out["clearance"], self.cfg.release.clearance_margin)
        )
        reward = (
            torch.where(released, at_release, attached)
            + rewards.carry_time(p, period)
            - p.termination * negative
        )
        duration = time - period + out["separation_time"] + out["time_to_impact"]
        copied = {name: out[name].clone() for name in ("landing_w", "clearance")}
        self.last = {
            "released": released,
            "negative": negative,
            "landing_error": error,
            "duration": duration,
            "action": action,
        } | copied
        if task.target.moves:
            self.last["goal_w"] = goal
        return p.scale * reward, released | negative

    def _goal_in(self, time: Tensor) -> Tensor:
        """Goal [m], shape (E, 3), where it is in a time [s], shape (E,)."""
        if not self.cfg.task.target.moves:
            return self.views.goal_w
        return self.views.goal_w + self._memory["goal_vel"] * time[:, None]

    def _begin(self, fresh: Tensor) -> None:
        """Draw what holds for an episode where one begins."""
        memory = self._memory
        noise = self.cfg.task.noise
        camera = self.cfg.camera
        self.episode_length_buf.masked_fill_(fresh, 0)
        torch.where(fresh[:, None], self._start_action, memory["previous"], out=memory["previous"])
        spreads = {
            "frame_bias": noise.observation_bias,
            "command_bias": noise.command_bias,
            "keypoint_bias": camera.noise.bias_std,
            "extrinsic_rotation": camera.mount.rotation_error_std,
            "extrinsic_offset": camera.mount.position_error_std,
            "scale_error": camera.noise.scale_std,
        }
        for name, std in spreads.items():
            if std > 0.0:
                old = memory[name]
                mask = fresh.view(-1, *(1,) * (old.dim() - 1))
                torch.where(mask, torch.randn_like(old) * std, old, out=old)
        low, high = self.cfg.task.observation.latency
        if high > 0.0:
            age = memory["pose_age"]
            sample = low + (high - low) * torch.rand_like(age)
            torch.where(
                fresh, sample if self._clock is None else sample / self._clock, age, out=age
            )
        slow, fast = self.cfg.task.target.speed
        if fast > 0.0:
            velocity = memory["goal_vel"]
            sample = torch.rand_like(velocity[:, :2])
            speed = slow + (fast - slow) * sample[:, 0]
            heading = 2.0 * math.pi * sample[:, 1]
            new = torch.stack(
                [speed * heading.cos(), speed * heading.sin(), torch.zeros_like(speed)], dim=-1
            )
            velocity.copy_(torch.where(fresh[:, None], new, velocity))

    def _late(self, pose: Tensor, fresh: Tensor) -> Tensor:
        """Pose sample as old as the episode's latency, linear between two control steps."""
        memory = self._memory
        observation = self.cfg.task.observation
        poses = hist.push(memory["poses"], pose, fresh)
        age = memory["pose_age"]
        memory["poses"].copy_(poses)
        if observation.oldest == 0.0:
            return pose
        if observation.latency_jitter > 0.0:
            off = observation.latency_jitter * (2.0 * torch.rand_like(age) - 1.0)
            age = age + (off if self._clock is None else off / self._clock)
        age = age / self.cfg.sim.control_period
        before = age.floor().clamp(max=poses.shape[1] - 2.0)
        row = before.long()[:, None, None].expand(-1, 1, poses.shape[2])
        newer, older = (poses.gather(1, row + k)[:, 0] for k in (0, 1))
        return newer + (older - newer) * (age - before)[:, None]

    @rounded_products(False)
    def _observe(self, fresh: Tensor) -> TensorDict:
        """Actor's and critic's view of the current state."""
        state = self.views.state
        memory = self._memory
        noise = self.cfg.task.noise
        payload = self.views.out["payload_pos_w"]
        rot_wb = ob.rotation_from_quat(state["quat_wb"])
        vehicle = ob.vehicle_part(state["pos_w"], state["vel_w"], state["rate_b"], rot_wb)
        attached = state["attached"].to(torch.float32)
        pose = self._late(torch.cat([vehicle, payload], dim=-1), fresh)
        late_goal = self._goal_in(-memory["pose_age"])
        true_frame = torch.cat(
            [pose[:, : ob.VEHICLE], ob.state_part(pose[:, :3], late_goal, pose[:, ob.VEHICLE :])],
            dim=-1,
        )
        measured = (
            true_frame
            + torch.randn_like(true_frame) * noise.observation_step
            + memory["frame_bias"]
        )
        valid = None
        if self.layout.name == "vision":
            if self.cfg.task.observation.oldest > 0.0:
                rot_wb = ob.rotation_in(pose)
            points, valid = self._see(pose[:, :3], rot_wb, late_goal, pose[:, ob.VEHICLE :], fresh)
            measured = torch.cat([measured[:, : ob.VEHICLE], points.flatten(1)], dim=-1)
        self.measured = measured, valid
        time = self.episode_length_buf.to(torch.float32) * self.cfg.sim.control_period
        goal_vel = places = answers = None
        if self.layout.fits:
            fitted = goal_motion.fitted_goal(
                self.layout, measured, valid, self.camera, memory["goal_fit"], time, fresh
            )
            memory["goal_fit"].copy_(fitted.sums)
            _, goal_vel, places, measured, valid = fitted
        if self.layout.response:
            memory["answers"].copy_(
                hist.push(memory["answers"], ob.answer(measured, memory["previous"]), fresh)
            )
            answers = memory["answers"][:, 1:]
        actor, history = ob.observe(
            self.layout,
            measured,
            valid,
            memory["previous"],
            attached,
            memory["history"],
            fresh,
            goal_vel,
            places,
            answers,
            self._setup,
        )
        memory["history"].copy_(history)
        observed = {
            "actor": actor,
            "critic": self._privileged(actor, vehicle, payload, time, fresh),
        }
        return TensorDict(observed, batch_size=[self.num_envs], device=self.device)

    def _privileged(
        self, actor: Tensor, vehicle: Tensor, payload: Tensor, time: Tensor, fresh: Tensor
    ) -> Tensor:
        """Critic's view: what ``ppo.privileged`` names."""
        state = self.views.state
        memory = self._memory
        named = self.cfg.ppo.privileged
        parts = [actor]
        if "exact" in named:
            offset = ob.state_part(state["pos_w"], self.views.goal_w, payload)
            true_history = hist.push(memory["true_history"], offset[:, 2:], fresh)
            memory["true_history"].copy_(true_history)
            parts = [vehicle, memory["previous"], offset[:, :2], true_history.flatten(1)]
        quantities = (
            ("payload_velocity", self.views.out["payload_vel_w"]),
            ("release_timer", state["release_timer"][:, None]),
            ("time", time[:, None]),
            ("mass", state["mass_scale"][:, None]),
            ("voltage", state["voltage"][:, None]),
            ("exact", state["attached"].to(torch.float32)[:, None]),
            ("goal_velocity", memory["goal_vel"][:, :2] if self.cfg.task.target.moves else None),
            ("cargo", self._cargo),
            ("mount", memory["extrinsic_rotation"]),
            ("mount", memory["extrinsic_offset"]),
            ("pose_age", memory["pose_age"][:, None]),
            ("vehicle", self._known),
        )
        parts += [value for name, value in quantities if name in named and value is not None]
        return torch.cat(parts, dim=-1) if len(parts) > 1 else actor

    def _see(
        self, pos_w: Tensor, rot_wb: Tensor, goal_w: Tensor, payload_w: Tensor, fresh: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Keypoints as the detector reports them: errors of mount and focal length, latency, noise,
        drop-out, held images.
        """
        memory = self._memory
        camera = self.cfg.camera
        points, valid = keypoints(self.camera, pos_w, rot_wb, goal_w, payload_w, self.extrinsics())
        if camera.noise.seen_radius < 1.0:
            valid = valid & (points.square().sum(-1) <= camera.noise.seen_radius**2)
        if camera.noise.scale_std > 0.0:
            points = points * (1.0 + memory["scale_error"])
        if camera.noise.latency > 0.0:
            memory["late_points"].copy_(hist.push(memory["late_points"], points, fresh))
            memory["late_valid"].copy_(hist.push(memory["late_valid"], valid, fresh))
            points, valid = apply_latency(
                memory["late_points"], memory["late_valid"], self._latency
            )
        draw = StepDraw(torch.randn_like(points), torch.rand_like(points[..., 0]))
        if camera.noise.wrong_probability > 0.0:
            draw = draw._replace(wrong=torch.rand(*points.shape[:2], 3, device=points.device))
        points, valid = apply_noise(camera.noise, points, valid, memory["keypoint_bias"], draw)
        if camera.noise.held_probability > 0.0:
            repeated = (torch.rand_like(points[:, 0, 0]) < camera.noise.held_probability) & ~fresh
            points = torch.where(repeated[:, None, None], memory["held_points"], points)
            valid = torch.where(repeated[:, None], memory["held_valid"], valid)
            memory["held_points"].copy_(points)
            memory["held_valid"].copy_(valid)
        if self._found is None:
            return (points, valid)
        return corrected_keypoints(self.camera, points, valid, *self._found)

    def _tensors(self) -> dict[str, Tensor]:
        """All that the next step depends on, besides torch's generators."""
        groups = {
            "sim": self.views.state,
            "out": self.views.out,
            "memory": self._memory,
            "obs": self._observations,
        }
        tensors_ = {
            f"{group}.{name}": tensor
            for group, tensors in groups.items()
            for name, tensor in tensors.items()
        }
        return tensors_ | {
            "episode": wp.to_torch(self.sim.episode),
            "goal_w": self.views.goal_w,
            "length": self.episode_length_buf,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Copy of all that the next step depends on, besides torch's generators."""
        return {k: v.clone() for k, v in self._tensors().items()}

    def load_state_dict(self, saved: dict[str, Tensor]) -> None:
        """Take up a state of :meth:`state_dict`; ValueError where it is of an environment of
        another experiment or size.
        """
        for name, target in self._tensors().items():
            if name not in saved or saved[name].shape != target.shape:
                have = tuple(saved[name].shape) if name in saved else "nothing"
                raise ValueError(
                    f"environment state {name!r}; expected shape {tuple(target.shape)}, got {have}"
                )
            target.copy_(saved[name])
