"""TeamEnv: the cooperative task as rsl_rl's vectorised environment, with one row for each vehicle.

One policy flies all rows, either each from its own observation, or all rows of a world from all
their observations. The rows of a world end together. As in
:class:`visthrow.training.env.ThrowEnv`, a step does not branch on data, so a rollout can be
captured."""

import math
from typing import ClassVar

import torch
import warp as wp
from tensordict import TensorDict
from torch import Tensor

from camera import arrays
from camera.keypoint_noise import DetectorView
from sim.torch_bridge import TorchViews, on_torch_stream
from visthrow.common.compute_device import allow_rounded_products
from visthrow.common.free_fall import free_flight
from visthrow.cooperative.team import TeamExperiment, interpolate, layout_of, members
from visthrow.cooperative.team_sim import TeamSim
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.task import plant_of, rewards, terminations
from visthrow.training.env.env_base import ThrowEpisodes


class TeamEnv(ThrowEpisodes):
    """Worlds of a team, with the observation groups ``actor`` and ``critic``.

    The critic observes all vehicles without noise, its own first, the load with its velocity, the
    time, every latch, mass and voltage, and the age of the others' poses.

    Attributes:
        earliest: first control step of an episode in which requests count, shape ().
        last: results of the last step, each over the worlds: ``released``, ``negative``,
            ``contact`` (bool), ``landing_error`` [m], ``duration`` [s], ``landing_w`` [m],
            ``clearance`` [m], ``gap`` [m], ``apart``, the time between first and last separation
            [s], and the load's position ``load_w`` [m] and velocity ``load_vel_w`` [m/s] at the end
            of the step.
    """

    results: ClassVar = ThrowEpisodes.results | {"contact": "episodes"}

    def __init__(
        self,
        experiment: TeamExperiment,
        device: str = "cpu",
        seed: int = 0,
        count: int | None = None,
        build=None,
    ):
        """Build the simulator and the buffers and start all episodes.

        Args:
            experiment: plant, camera and task. device: "cpu" or "cuda:0".
            seed: seed of the simulator's resets; torch's generator draws everything else.
            count: number of vehicles; default the experiment's.
            build: another solver of the bodies; see :class:`TeamSim`.
        """
        self.cfg = experiment
        self.device = device
        task = experiment.task
        team = experiment.team
        self.rows = count or experiment.ppo.environments
        self.num_envs = self.rows // team.flown
        self.num_actions = team.flown * act.ACTIONS
        self.team = team.vehicles
        self.worlds = self.rows // team.vehicles
        if self.rows % self.team:
            raise ValueError(f"{self.rows} rows; expected a multiple of {self.team}")
        self.max_episode_length = round(task.bounds.time_limit / experiment.sim.control_period)
        options = members(experiment) | ({} if build is None else {"build": build})
        plant = plant_of(experiment)
        self.sim = TeamSim(plant, self.worlds, self.team, device, seed, **options)
        self.views = TorchViews(self.sim)
        self.load_w, self.load_vel_w = (
            wp.to_torch(array, requires_grad=False) for array in self.sim.load
        )
        self.layout = layout_of(experiment)
        like = torch.zeros(self.rows, device=device)
        self.view = DetectorView(experiment.camera, like)
        ropes = like.new_tensor([r.segment_length for r in options["ropes"]])
        rows = torch.arange(self.rows, device=device)
        self._segment = ropes[rows % len(ropes)]
        self._mount = like.new_tensor(plant.rope.mount)
        samples = experiment.release.clearance_samples
        self._fractions = torch.linspace(0.0, 1.0, samples, device=device)
        self._allocate(like)
        self.earliest = like.new_zeros((), dtype=torch.long)
        self.reset()

    def _allocate(self, like: Tensor) -> None:
        super()._allocate(like)
        worlds = self.worlds
        steps = 2 + math.ceil(self.cfg.team.age[1] / self.cfg.sim.control_period)
        self.buffers |= {
            "pose_age": torch.zeros_like(like),
            "age": like.new_zeros(worlds),
            "poses": like.new_zeros(self.rows, steps, ob.VEHICLE + 3),
            "requests": like.new_zeros(worlds, steps),
            "first": like.new_zeros(worlds),
            "tripped": like.new_zeros(worlds),
        }

    def _rows(self, of_worlds: Tensor) -> Tensor:
        """Repeat values of worlds, shape (W, ...), for their rows."""
        shape = (self.worlds, self.team, *of_worlds.shape[1:])
        return of_worlds.unsqueeze(1).expand(shape).flatten(0, 1)

    def _worlds(self, of_rows: Tensor) -> Tensor:
        """Return values of rows with shape (W, V, ...)."""
        return of_rows.unflatten(0, (self.worlds, self.team))

    def _join(self, of_rows: Tensor) -> Tensor:
        """Return values of rows with one line for each actor; a central actor has those of all
        members side by side.
        """
        return of_rows.reshape(self.num_envs, -1).float()

    def _neighbour(self, of_rows: Tensor, k: int) -> Tensor:
        """Return the values of the k-th vehicle after each row's own in its world."""
        return self._worlds(of_rows).roll(-k, 1).flatten(0, 1)

    def reset(self) -> TensorDict:
        """Start a new episode in every world."""
        fresh = torch.ones(self.worlds, device=self.device, dtype=torch.bool)
        self._start(fresh)
        self._observations = self._observe(self._rows(fresh))
        return self._observations

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply unclipped actions, shape (E, 5) or (W, V 5), for one control period and restart
        worlds that end.
        """
        action = self._apply(actions.reshape(-1, act.ACTIONS))
        reward, done = self._judge(action)
        self._count(done, (self.last["contact"] & done).float())
        self.previous_action.copy_(action)
        self._start(done)
        rows = self._rows(done)
        self._observations = self._observe(rows)
        paid = self._join(reward).mean(1)
        return self._observations, paid, self._join(rows).amax(1), {}

    def _apply(self, actions: Tensor) -> Tensor:
        """Fly one control period and return the clipped actions.

        The latches trip together, when all members requested it one link delay before.
        """
        memory = self.buffers
        action = self._command(actions)
        requests = self._worlds(act.wants_release(actions, self.cfg.release.threshold)).all(1)
        requests &= self.episode_length_buf[:: self.team] >= self.earliest
        fresh = torch.zeros_like(requests)
        memory["requests"].copy_(arrays.push(memory["requests"], requests.float(), fresh))
        steps = (memory["age"] / self.cfg.sim.control_period - 1e-3).ceil().long()
        agreed = memory["requests"].gather(1, steps[:, None])[:, 0] > 0.5
        self.views.release.copy_(self._rows(agreed))
        tripped = memory["tripped"]
        tripped += (agreed | (tripped > 0.0)).float()
        with on_torch_stream(self.device):
            self.sim.step()
        self.episode_length_buf += 1
        return action

    def gap(self) -> Tensor:
        """Return the smallest gap between vehicles, cables and load [m], shape (W,).

        A vehicle is a sphere with the propellers' reach. The simulator checks the distance between
        a vehicle and its own cable (``ROPE_IN_ROTOR``). Cables meet at the load, so gaps between
        cables are not checked.
        """
        state = self.views.state
        reach = self.cfg.team.rotor_reach
        pos = state["pos_w"]
        attached = state["attached"] != 0
        steps = state["cable_dir_w"].cumsum(0) * self._segment[:, None]
        arm = ob.rotation_from_quat(state["quat_wb"]) @ self._mount
        joints = (pos + arm + steps).transpose(0, 1)
        load = self._rows(self.load_w) - pos
        radius = self.cfg.rope.payload_radius + self.cfg.vehicle.collision_radius
        gaps = [load.norm(dim=-1) - radius]
        for k in range(1, self.team):
            gaps.append((self._neighbour(pos, k) - pos).norm(dim=-1) - 2.0 * reach)
            offsets = self._neighbour(joints, k) - pos[:, None]
            cable = offsets.square().sum(-1).amin(-1).sqrt()
            gaps.append(torch.where(self._neighbour(attached, k), cable - reach, 10.0))
        return self._worlds(torch.stack(gaps).amin(0)).amin(1)

    def _handle_landings(self, time: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the worlds whose last vehicle separated in this step, and the results of their
        landings.
        """
        out = self.views.out
        memory = self.buffers
        separated = self._worlds(out["separated"]) != 0
        attached = self._worlds(self.views.state["attached"] != 0).any(1)
        when = torch.where(separated, self._worlds(out["separation_time"]), -1.0)
        last = when.argmax(1)
        begin = time - self.cfg.sim.control_period
        earliest = torch.where(separated, when, 1e6).amin(1) + begin
        memory["first"].copy_(torch.minimum(memory["first"], earliest))
        rows = self.team * torch.arange(self.worlds, device=self.device) + last
        chosen = {name: out[name][rows] for name in ("landing_w", "time_to_impact")}
        end = begin + when.amax(1)
        chosen["duration"] = end + chosen["time_to_impact"]
        chosen["apart"] = end - memory["first"]
        chosen["load_w"] = self.load_w.clone()
        chosen["load_vel_w"] = self.load_vel_w.clone()
        chosen["clearance"] = self._clearance(chosen["time_to_impact"])
        return separated.any(1) & ~attached, chosen

    def _clearance(self, flight: Tensor) -> Tensor:
        """Return the smallest distance between the flying load and any vehicle, which is assumed
        not to move [m], shape (W,).
        """
        time = (flight[:, None] * self._fractions)[:, :, None]
        path = free_flight(self.load_w[:, None], self.load_vel_w[:, None], time)
        offsets = path[:, :, None] - self._worlds(self.views.state["pos_w"])[:, None]
        return offsets.norm(dim=-1).flatten(1).amin(1)

    def _judge(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rewards of the rows and whether their worlds end, for the last step."""
        task = self.cfg.task
        state = self.views.state
        team = self.cfg.team
        p = task.reward
        period = self.cfg.sim.control_period
        release = self.cfg.release
        time = self.episode_length_buf * period
        load = self._rows(self.load_w)
        released, landing = self._handle_landings(time[:: self.team])
        gap = self.gap()
        contact = (gap < 0.0) & ~released
        turn = ob.rotation_from_quat(state["quat_wb"])
        latched = state["release_timer"] >= 0.0
        place = (state["pos_w"], turn, load)
        height = release.landing_height
        ended = terminations.negative(task.bounds, *place, state["status"], latched, time, height)
        negative = ~released & (self._worlds(ended).any(1) | contact)
        miss = landing["landing_w"] - self.views.goal_w[:: self.team]
        error = miss[:, :2].norm(dim=-1)
        attached = self._carry_reward(action, self._rows(self.load_vel_w))
        at_release = rewards.release_reward(
            p, error, landing["time_to_impact"], landing["clearance"], release.clearance_margin
        )
        shared = rewards.carry_time(p, period) - p.termination * negative.float()
        shared = shared - team.contact_cost * contact.float()
        shared = shared - team.margin_cost * (team.margin - gap).clamp(0.0, team.margin)
        reward = torch.where(self._rows(released), self._rows(at_release), attached)
        self.last = {"released": released, "negative": negative, "contact": contact}
        self.last |= landing | {"landing_error": error, "gap": gap}
        return p.scale * (reward + self._rows(shared)), released | negative

    def _start(self, fresh: Tensor) -> None:
        """Start episodes in the worlds where ``fresh``, bool, shape (W,)."""
        task = self.cfg.task
        memory = self.buffers
        rows = self._rows(fresh)
        mask = rows.to(torch.int32)
        with on_torch_stream(self.device):
            self.sim.randomize(task.start, wp.from_torch(mask))
            self._form(fresh)
            self.sim.adopt(wp.from_torch(mask))
        self._kept = mask  # an attribute, so that it lives until the launches have read it
        self._restart(rows)
        memory["requests"].masked_fill_(fresh[:, None], 0.0)
        memory["first"].masked_fill_(fresh, 1e6)
        memory["tripped"].masked_fill_(fresh, 0.0)
        self.view.begin(rows)
        age = memory["pose_age"]
        latency = interpolate(task.observation.latency, torch.rand_like(age))
        torch.where(rows, latency, age, out=age)
        age = memory["age"]
        part = (2.0 * torch.rand_like(age) - 1.0).clamp(min=0.0)
        torch.where(fresh, interpolate(self.cfg.team.age, part), age, out=age)

    def _form(self, fresh: Tensor) -> None:
        """Move vehicles of starting worlds into a formation around the load, and draw a goal."""
        team = self.cfg.team
        state = self.views.state
        goal = self.views.goal_w
        draw = torch.rand(self.worlds, 4, device=self.device)
        heading = 2.0 * math.pi * draw[:, 0]
        distance = interpolate(team.goal, draw[:, 1])
        x, y = (distance * part for part in (heading.cos(), heading.sin()))
        goals = torch.stack([x, y, torch.zeros_like(x)], -1)
        if self._goal is not None:
            goals = self._goal.expand_as(goals)
            heading = torch.atan2(goals[:, 1], goals[:, 0])
        spread = math.radians(team.across_deg) * (2.0 * draw[:, 2] - 1.0)
        tilt = self._rows(torch.deg2rad(interpolate(team.tilt_deg, draw[:, 3])))
        rows = torch.arange(self.rows, device=self.device)
        place = 2.0 * math.pi / self.team * (rows % self.team)
        azimuth = self._rows(heading + spread) + 0.5 * math.pi + place
        x, y = (-tilt.sin() * part for part in (azimuth.cos(), azimuth.sin()))
        down = torch.stack([x, y, -tilt.cos()], -1)
        load, vel = (self._rows(state[name][:: self.team]) for name in ("pos_w", "vel_w"))
        load = load.clone()
        load[:, 2] -= self.cfg.rope.length * tilt.cos()
        turn = ob.rotation_from_quat(state["quat_wb"])
        turning = torch.linalg.cross(state["rate_b"], self._mount.expand_as(state["rate_b"]))
        length = self._segment * self.cfg.rope.segments
        formed = {"cable_dir_w": down, "cable_vel_w": torch.zeros_like(down)}
        formed["pos_w"] = load - length[:, None] * down - turn @ self._mount
        formed["vel_w"] = vel - (turn @ turning[..., None])[..., 0]
        where = self._rows(fresh)[:, None]
        goal.copy_(torch.where(where, self._rows(goals), goal))
        for name, value in formed.items():
            state[name].copy_(torch.where(where, value, state[name]))

    @allow_rounded_products(False)
    def _observe(self, fresh: Tensor) -> TensorDict:
        """Return the actor's and the critic's observations of the current state; ``fresh``: whether
        a row's episode begins.
        """
        state = self.views.state
        memory = self.buffers
        load = self._rows(self.load_w)
        goal = self.views.goal_w
        rot_wb = ob.rotation_from_quat(state["quat_wb"])
        vehicle = ob.vehicle_part(state["pos_w"], state["vel_w"], state["rate_b"], rot_wb)
        poses = arrays.push(memory["poses"], torch.cat([vehicle, load], -1), fresh)
        memory["poses"].copy_(poses)
        period = self.cfg.sim.control_period
        pose = arrays.interpolate_at_latency(poses, memory["pose_age"] / period)
        frame = self._measure(self._state_frame(pose, goal))
        valid = None
        if self.layout.name == "vision":
            eye = (pose[:, :3], ob.rotation_in(pose))
            points, valid = self.view.look(*eye, goal, pose[:, ob.VEHICLE :], fresh)
            frame = torch.cat([frame[:, : ob.VEHICLE], points.flatten(1)], -1)
        messages = self._messages(poses, frame[:, :3])
        attached = state["attached"].float()
        actor, history = ob.observe(
            self.layout,
            frame,
            valid,
            memory["previous"],
            attached,
            memory["history"],
            fresh,
            setup=messages,
        )
        memory["history"].copy_(history)
        critic = self._critic_view(vehicle, load, attached, fresh)
        observed = {"actor": self._join(actor), "critic": self._join(critic)}
        return TensorDict(observed, batch_size=[self.num_envs], device=self.device)

    def _messages(self, poses: Tensor, pos_w: Tensor) -> Tensor:
        """Return the delayed poses of the other vehicles, their age in control periods, and the
        control steps since the latches tripped.
        """
        noise = self.cfg.task.noise.observation_step
        age = self._rows(self.buffers["age"]) / self.cfg.sim.control_period
        late = arrays.interpolate_at_latency(poses, age)
        parts = []
        for k in range(1, self.team):
            neighbour = self._neighbour(late, k)
            place = neighbour[:, :3] + torch.randn_like(pos_w) * noise - pos_w
            parts += [place, neighbour[:, 9 : ob.VEHICLE]]
        tripped = self._rows(self.buffers["tripped"])
        return torch.cat([*parts, torch.stack([age, tripped], -1)], -1)

    def _critic_view(
        self, vehicle: Tensor, load: Tensor, attached: Tensor, fresh: Tensor
    ) -> Tensor:
        """Return the critic's observation."""
        state = self.views.state
        memory = self.buffers
        offset = ob.state_part(state["pos_w"], self.views.goal_w, load)
        history = arrays.push(memory["true_history"], offset[:, 2:], fresh)
        memory["true_history"].copy_(history)
        numbers = [state[name] for name in ("release_timer", "mass_scale", "voltage")]
        numbers = torch.stack([*numbers, attached], -1)
        view = torch.cat([vehicle, memory["previous"], state["cable_dir_w"][0], numbers], -1)
        parts = [view] + [self._neighbour(view, k) for k in range(1, self.team)]
        time = self.episode_length_buf[:, None] * self.cfg.sim.control_period
        parts += [offset[:, :2], history.flatten(1), self._rows(self.load_vel_w), time]
        return torch.cat([*parts, self._rows(memory["age"])[:, None]], -1)
