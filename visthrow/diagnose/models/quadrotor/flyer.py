"""A quadrotor alone, or with a payload on a cable, driven by its logged commands and its measured
attitude.

Where the attitude is measured, the path of the centre of mass follows from thrust, drag and gravity
alone, whatever controller flies; where each motor's command is logged, the rates follow too. No
controller has to be known."""

from collections.abc import Callable, Container, Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.interpolate import CubicHermiteSpline

from visthrow.common.rotations import cross, normal_part
from visthrow.diagnose.models.catalogue import ModelEffect
from visthrow.diagnose.models.law_terms import exerted
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS
from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    halves,
    integrate,
    triangles,
)
from visthrow.diagnose.models.quadrotor.flyer_params import MOTORS, FlyerParams
from visthrow.diagnose.models.quadrotor.flyer_windows import (
    NEIGHBOUR,
    expect_thrust,
    lagged,
    spare,
    windows_of,
    without_each,
)
from visthrow.logs.check.relations import on_grid
from visthrow.logs.flightlog import FlightLog

Slope = Callable[[int, ndarray], ndarray]
"""Of the half step, and states or velocities of lanes."""

Quantities = Callable[[int, ndarray], dict[str, ndarray]]
"""Of laws, by the half step and states of lanes."""

SHORTEST = 1e-3  # of the motors' lag [s]: a lag of nothing divides by it
BLOCK_OF = {"payload_pos_w": 2, "rate_b": 1}  # number of the latent block that a channel shows


class FlyerModel(NumericModel):
    """Windows of flights of one vehicle."""

    table = "flyer"
    latent_step = 1e-2
    knot_count = 8
    # channels that are states, and which
    columns: Mapping[str, slice] = {}

    def __init__(self, logs: Sequence[FlightLog], params: FlyerParams) -> None:
        """Cut the flights into windows.

        Raises LogError where no log has the channels, or none flies.
        """
        self.describe(logs, params)
        blocks = [0, *[BLOCK_OF[name] for name in self.channels if name in BLOCK_OF]]
        self.pushes = [(block, axis) for block in blocks for axis in range(3)]
        super().__init__(logs, params)
        self.steps = round(params.window / params.step)
        self._spare = spare(params.step)

    def describe(self, logs: Sequence[FlightLog], params: FlyerParams) -> None:
        """Set the channels that are looked at, that drive the model, and that it needs."""
        optional = {"payload_pos_w": params.cable, "rate_b": params.torque}
        simulated = [name for name, part in optional.items() if part is not None]
        self.channels = (params.position, *simulated)
        drivers = in_all(logs, "battery_voltage", "acc_b", "rate_b", NEIGHBOUR)
        self.inputs = (params.attitude, params.input, *drivers)
        self.needed = (params.position, params.attitude, params.input, *simulated)
        turned = 6 if params.cable is None else 12
        self.columns = {"rate_b": slice(turned, turned + 3)}

    @property
    def motors(self) -> int:
        """Return the number of columns of the inputs."""
        return self.stretches[0].data["sent"].values.shape[1]

    @property
    def has_voltage(self) -> bool:
        """Whether all logs tell the battery's voltage."""
        return "battery_voltage" in self.inputs

    def catalogue(self) -> list[ModelEffect]:
        """See the base class; where the voltage is logged, thrust fades with it."""
        effects = super().catalogue()
        return [e for e in effects if not (self.has_voltage and e.name == "thrust_fade")]

    def cut(self, logs: Sequence[FlightLog]) -> list[Stretch]:
        """See the base class; at most ``most_windows``, spread evenly.

        Raises LogError: commands are of another size than carries the vehicle.
        """
        stretches = super().cut(logs)
        limit = self.params.most_windows
        for name in ("battery_voltage", NEIGHBOUR):
            count = sum(name in log for log in logs)
            if 0 < count < len(logs):
                note = f"{name} is not used: only {count} of {len(logs)} logs hold it"
                self.notes = (*self.notes, note)
        if stretches:
            expect_thrust(stretches, self.params)
        if len(stretches) <= limit:
            return stretches
        self.notes = (*self.notes, f"long flights: {limit} windows are looked at, spread over all")
        chosen = np.linspace(0, len(stretches) - 1, limit).round().astype(int)
        return [stretches[i] for i in chosen]

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class."""
        return windows_of(self, log, number)

    def _thrusts(self, lanes: Lanes) -> ndarray:
        """Thrust of each motor at the half steps [N], shape (half steps, B, motors): of held
        commands by the map, through a lag.

        In the middle of a step stands what makes Simpson's rule, and so the integration, give the
        step's own mean: commands switch there."""
        p = self.params
        grid = 0.5 * p.step * np.arange(2 * self.steps + 1)[:, None]
        delay = p.command_delay + self.size_of(lanes, "cmd_delay")
        tau = p.motor_time_constant + self.size_of(lanes, "motor_tau")
        columns = [lanes.owner, delay, np.maximum(tau, SHORTEST)]
        distinct, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
        thrust = np.empty((len(grid), len(lanes.owner), self.motors))
        for number, (owner, late, lag) in enumerate(distinct):
            data = self.stretches[int(owner)].data
            time, inputs = data["sent"]
            at_ends = data["start"] + grid[::2] - late
            ends, integral = lagged(time, p.thrust(inputs), at_ends, lag)
            mean = np.diff(integral, axis=0) / p.step
            lane = which == number
            thrust[::2, lane] = ends[:, None]
            thrust[1::2, lane] = (1.5 * mean - 0.25 * (ends[:-1] + ends[1:]))[:, None]
        curve = self.size_of(lanes, "thrust_curve")[:, None]
        hover = p.total_mass * p.gravity / self.motors  # of one input channel [N]
        since = self.of_windows(lanes, "since") + grid
        faded = 1.0 + self.size_of(lanes, "thrust_fade") * since
        curved = 1.0 + curve * (thrust / hover - 1.0)
        return thrust * self._scale(lanes) * curved * faded[..., None]

    def simulate(self, lanes: Lanes) -> ndarray:
        """See the base class.

        The state: position and velocity of the vehicle, with a cable its vector to the payload and
        that one's rate, with torques the body rates."""
        rot = self._rotations(lanes)
        mount = self._mount(rot)
        slope, _ = self._dynamics(lanes, self._thrusts(lanes), rot, mount)
        return integrate(slope, self._begin(lanes, mount), self.steps, self.params.step)

    def knots(self, lanes: Lanes, paths: ndarray) -> list[Mapping[str, ndarray]]:
        """See the base class."""
        rot = self._rotations(lanes)
        _, quantities = self._dynamics(lanes, self._thrusts(lanes), rot, self._mount(rot))
        moments = [quantities(2 * i, state) for i, state in enumerate(paths.swapaxes(0, 1))]
        names = moments[0].keys() - {"slope"}  # which follows from the thrusts at the knots
        weights = triangles(np.linspace(0.0, self.steps, self.knot_count), np.arange(len(moments)))
        values = {}
        for name in names:
            values[name] = np.tensordot(weights, [moment[name] for moment in moments], 1)
        knots = []
        for i, stretch in enumerate(self.stretches):
            at_knots = {name: value[:, i] for name, value in values.items()}
            knots.append(at_knots | {"time": np.unique(stretch.latent_time)})
        return knots

    def _scale(self, lanes: Lanes) -> ndarray:
        """Thrust over what the map says, shape (B, motors)."""
        p = self.params
        volts = np.zeros(len(lanes.owner))
        if self.has_voltage:
            volts = self.of_windows(lanes, "volts") - p.reference_voltage
        sag = p.voltage_coefficient + self.size_of(lanes, "battery_sag")
        scale = (1.0 + self.size_of(lanes, "thrust_gain")) * (1.0 + sag * volts)
        scales = self.stack(lanes, *(f"motor_{name}" for name in MOTORS))
        return scale[:, None] * (1.0 + scales[:, : self.motors])

    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """See the base class."""
        measured = []
        for channel, name in enumerate(self.channels):
            time = stretch.time[stretch.channel == channel]
            values = self._sampled(name, time, stretch, path, lanes)
            measured.append(values.reshape(len(path), -1))
        return np.concatenate(measured, axis=1)

    def _sampled(
        self, name: str, time: ndarray, stretch: Stretch, path: ndarray, lanes: Lanes
    ) -> ndarray:
        """Return what lanes of a stretch show of a channel, shape (L, n, C); ``time``: of all
        components of its samples, shape (n C,).
        """
        start = stretch.data["start"]
        step = self.params.step
        grid = start + step * np.arange(path.shape[1])
        if name in self.columns:
            states = path[..., self.columns[name]]
            time = time[:: states.shape[2]]
            return np.array([on_grid(grid, lane, time) for lane in states])
        time = time[::3]
        value = path[..., 0:3]
        rate = path[..., 3:6]
        if name == "payload_pos_w":
            value = value + path[..., 6:9]
            rate = rate + path[..., 9:12]
            return _late(time, self.size_of(lanes, "payload_delay"), grid, value, rate)
        pos = _late(time, self.size_of(lanes, "pose_delay"), grid, value, rate)
        lever = self.stack(lanes, "marker_x", "marker_y", "marker_z")
        half = ((time - start) / (0.5 * step)).round().astype(int)
        rot = stretch.data["rot"][np.clip(half, 0, 2 * self.steps) + self._spare]
        return pos + np.einsum("nij,bj->bni", rot, lever)

    def without_commands(self, theta: Mapping[str, float], windows: Sequence[int]) -> list[ndarray]:
        """See the base class; commands that an autopilot logs of its own motors all came."""
        if self.params.input != "command":
            return []
        return [self._without_each(self.size(theta), i) for i in windows]

    def _without_each(self, size: ndarray, i: int) -> ndarray:
        """Return the change of a window's samples by each command that does not come, shape
        (N, T).
        """
        stretch = self.stretches[i]
        inputs = without_each(stretch.data["sent"], self.params, stretch.data["start"])
        model = copy(self)
        model.stretches = [stretch]
        for held in inputs:
            model.stretches.append(replace(stretch, data={**stretch.data, "sent": held}))
        start = np.tile(self._start[i], (len(model.stretches), 1))
        lanes = model._lanes(size, start)
        seen = self.measure(stretch, model.simulate(lanes), lanes)
        return (seen[1:] - seen[:1]).T

    def _mount(self, rot: ndarray) -> Sequence[ndarray]:
        """Return where the cable is attached, from the centre of mass, the velocity and the
        acceleration of that point at the half steps, world frame, each of shape (half steps, B, 3).
        """
        cable = self.params.cable
        if cable is None:
            return ()
        arm = rot @ cable.mount
        rate = np.gradient(arm, 0.5 * self.params.step, axis=0, edge_order=2)
        return arm, rate, np.gradient(rate, 0.5 * self.params.step, axis=0, edge_order=2)

    def _begin(self, lanes: Lanes, mount: Sequence[ndarray]) -> ndarray:
        """States from the unknowns at the window's start."""
        unknown = lanes.nuisance
        if self.params.cable is None:
            return unknown
        length = (self.params.cable.length + self.size_of(lanes, "rope_length"))[:, None]
        down = self.of_windows(lanes, "direction")
        level = ((0, 0), (0, 1))  # a third component of 0
        direction = down + normal_part(np.pad(unknown[:, 6:8], level), down)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        swing = normal_part(np.pad(unknown[:, 8:10], level), direction)
        gap = length * direction + mount[0][0]
        rate = length * swing + mount[1][0]
        return np.concatenate((unknown[:, :6], gap, rate, unknown[:, 10:]), 1)

    def _dynamics(
        self, lanes: Lanes, thrust: ndarray, rot: ndarray, mount: Sequence[ndarray]
    ) -> tuple[Slope, Quantities]:
        """Return what gives the derivative of states, and what gives the quantities of laws there,
        by the half step.

        ``thrust``: [N], shape (half steps, B, motors); ``rot``: attitudes at the half steps."""
        p = self.params
        mass = (p.mass + self.size_of(lanes, "mass_quad"))[:, None]
        tilt = self.stack(lanes, "frame_tilt_y", "frame_tilt_x", "") * [1.0, -1.0, 1.0]
        gravity = p.gravity * (tilt - [0.0, 0.0, 1.0])
        wind = self.stack(lanes, "wind_x", "wind_y", "")
        pushes = self.pushes_at(lanes, halves(self.steps))
        names = [LATENT_BLOCKS[block] for block, _ in self.pushes[::3]]
        latent = dict(zip(names, np.split(pushes, len(names), axis=2)))
        force_of = self._force(lanes, thrust, rot)
        if p.cable is not None:
            pulled = self._pulled(lanes, mass, gravity, wind, mount)
        if p.torque is not None:
            turning = self._turning(lanes, thrust)

        def loads_at(half: int, state: ndarray) -> dict[str, ndarray]:
            loads = {name: push[half] for name, push in latent.items()}
            loads["vehicle force"] = loads["vehicle force"] + force_of(half, state[:, 3:6] - wind)
            return loads

        def hung_at(half: int, state: ndarray) -> tuple[ndarray, ndarray]:
            return pulled(half, state, loads_at(half, state))[2:]

        quantities = self._quantities(lanes, thrust.sum(2), hung_at)

        def slope(half: int, state: ndarray) -> ndarray:
            vel = state[:, 3:6]
            loads = loads_at(half, state)
            if self.laws:
                for block, load in exerted(self.laws, quantities(half, state)).items():
                    loads[block] = loads.get(block, 0.0) + load
            if p.cable is not None:
                acc, acc_payload, *_ = pulled(half, state, loads)
                parts = [vel, acc, state[:, 9:12], acc_payload - acc]
            else:
                parts = [vel, loads["vehicle force"] / mass + gravity]
            if p.torque is not None:
                parts.append(turning(half, state[:, -3:], loads["vehicle torque"]))
            return np.concatenate(parts, 1)

        return slope, quantities

    def _rise(self, total: ndarray) -> ndarray:
        """Return the slope of whole thrusts [N], shape (half steps, B), as knots show it [N/s]."""
        knots = np.linspace(0.0, self.params.window, self.knot_count)
        grid = self.params.window * halves(self.steps)
        at_knots = triangles(knots, grid[::2]) @ total[::2]
        slope = np.gradient(at_knots, knots, axis=0)
        return triangles(grid, knots) @ slope

    def _quantities(self, lanes: Lanes, total: ndarray, hung_at: Callable) -> Quantities:
        """Return what gives the quantities of laws by the half step and states.

        ``total``: thrust [N], shape (half steps, B); ``hung_at``: gives direction and pull [N] of
        the cable by the half step and states."""
        cable = self.params.cable
        tables = {"rate_b": "rate", "quat_wb": "quat"}
        if NEIGHBOUR in self.inputs:
            tables[NEIGHBOUR] = NEIGHBOUR
        measured = {name: self.of_windows(lanes, key) for name, key in tables.items()}
        rise = self._rise(total)

        def quantities(half: int, state: ndarray) -> dict[str, ndarray]:
            values = {name: table[:, half + self._spare] for name, table in measured.items()}
            values["time"] = np.zeros(len(state))
            values["thrust"] = total[half]
            values["slope"] = rise[half]
            values["pos_w"] = state[:, :3]
            values["vel_w"] = state[:, 3:6]
            if cable is not None:
                direction, pull = hung_at(half, state)
                values["payload_pos_w"] = state[:, :3] + state[:, 6:9]
                values["payload_vel_w"] = state[:, 3:6] + state[:, 9:12]
                values["cable_dir_w"] = direction
                values["tension"] = pull[:, 0]
                values["mount_b"] = np.tile(cable.mount, (len(state), 1))
            return values

        return quantities

    def _rotations(self, lanes: Lanes) -> ndarray:
        """Return the attitudes of lanes at the half steps, shape (half steps, B, 3, 3)."""
        late = self._spare + self.size_of(lanes, "attitude_delay") / (0.5 * self.params.step)
        position = np.arange(2 * self.steps + 1)[:, None] + late
        measured = self.of_windows(lanes, "rot")
        index = np.clip(position.astype(int), 0, measured.shape[1] - 2)
        lane = np.arange(len(lanes.owner))
        before = measured[lane, index]
        share = (position - index)[..., None, None]
        return before + share * (measured[lane, index + 1] - before)

    def _force(self, lanes: Lanes, thrust: ndarray, rot: ndarray) -> Slope:
        """Return thrust and air's drag on the vehicle [N, world], by its velocity in the air."""
        p = self.params
        total = thrust.sum(2, keepdims=True)
        added = self.stack(lanes, "rotor_drag_xy", "rotor_drag_xy", "rotor_drag_z")
        drag = np.array([p.drag_xy, p.drag_xy, p.drag_z]) + added
        parasitic = self.size_of(lanes, "parasitic")[:, None]
        lift = self.size_of(lanes, "translational_lift")[:, None]
        turn = self.stack(lanes, "marker_rot_x", "marker_rot_y", "")
        lean = self.size_of(lanes, "estimator_lean")[:, None]
        leaning = self.of_windows(lanes, "lean")
        turns = np.any(turn) or np.any(lean)

        def force(half: int, air: ndarray) -> ndarray:
            vel_b = np.einsum("bji,bj->bi", rot[half], air)
            level = vel_b[:, :1] ** 2 + vel_b[:, 1:2] ** 2
            speed = np.sqrt(level + vel_b[:, 2:3] ** 2)
            force_b = -(drag + parasitic * speed) * vel_b
            force_b[:, 2:3] += total[half] * (1.0 + lift * level)
            if turns:
                off = turn + lean * leaning[:, half + self._spare]
                force_b = force_b + cross(off, force_b)
            return np.einsum("bij,bj->bi", rot[half], force_b)

        return force

    def _pulled(
        self,
        lanes: Lanes,
        mass: ndarray,
        gravity: ndarray,
        wind: ndarray,
        mount: Sequence[ndarray],
    ) -> Callable:
        """Return what gives accelerations of vehicle and payload, the cable's direction, and what
        it pulls with [N], by the half step, states and loads; it never pushes.
        """
        payload = (self.params.cable.mass + self.size_of(lanes, "mass_payload"))[:, None]
        payload_drag = self.size_of(lanes, "payload_drag")[:, None]
        reduced = 1.0 / (1.0 / payload + 1.0 / mass)

        def pulled(half: int, state: ndarray, loads: Mapping) -> tuple[ndarray, ...]:
            arm, rate, acc = (part[half] for part in mount)
            gap = state[:, 6:9] - arm
            gap_rate = state[:, 9:12] - rate
            vel = state[:, 3:6] + state[:, 9:12] - wind
            drag = -payload_drag * np.sqrt(_products(vel, vel)) * vel
            free = loads["vehicle force"] / mass + gravity
            free_payload = (drag + loads["payload force"]) / payload + gravity
            length = np.sqrt(_products(gap, gap))
            direction = gap / length
            separation = _products(direction, free_payload - free - acc)
            relative = separation + _products(gap_rate, gap_rate) / length
            pull = np.maximum(relative * reduced, 0.0)
            pull_w = pull * direction
            return free + pull_w / mass, free_payload - pull_w / payload, direction, pull

        return pulled

    def _turning(self, lanes: Lanes, thrust: ndarray) -> Callable:
        """Return what gives the angular acceleration from the motors' thrusts and the offset of the
        centre of mass, by the half step, rates and a torque [N m].
        """
        p = self.params.torque
        scale = 1.0 + self.stack(lanes, "inertia_xy", "inertia_xy", "inertia_z")
        inertia = p.inertia * scale
        com_x, com_y = self.stack(lanes, "com_x", "com_y").T
        total = thrust.sum(2)
        lever = np.stack([-com_y * total, com_x * total, 0.0 * total], -1)
        torque = p.of(thrust) + lever

        def turning(half: int, rate: ndarray, push: ndarray) -> ndarray:
            return (torque[half] - cross(rate, inertia * rate) + push) / inertia

        return turning


def in_all(logs: Sequence[Container[str]], *names: str) -> list[str]:
    """Return the names that all logs hold."""
    return [name for name in names if all(name in log for log in logs)]


def _late(time: ndarray, delays: ndarray, grid: ndarray, value: ndarray, rate: ndarray) -> ndarray:
    """Return what stamps show of lanes that are late, shape (L, N, 3).

    ``time``: shape (N,); ``delays``: of the lanes [s], shape (L,); ``value, rate``: of the lanes on
    a grid and its derivative, shape (L, T, 3)."""
    out = np.empty((len(value), len(time), 3))
    for delay in np.unique(delays):
        members = delays == delay
        path = CubicHermiteSpline(grid, value[members], rate[members], axis=1)
        out[members] = path(time - delay)
    return out


def _products(a: ndarray, b: ndarray) -> ndarray:
    """Inner products of rows, shape (B, 1); of a few rows, ``np.sum`` and ``np.linalg.norm`` take
    several times as long.
    """
    return np.einsum("bi,bi->b", a, b)[:, None]
