"""A quadrotor alone, or with a payload on a cable, driven by its logged commands and its measured
attitude.

Where the attitude is measured, the path of the centre of mass follows from thrust, drag and gravity
alone, whatever controller flies; where each motor's command is logged, the rates follow too. No
controller has to be known."""

from collections.abc import Callable, Container, Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, Slerp

from visthrow.common.rotations import cross
from visthrow.diagnose.models.catalogue import ModelEffect
from visthrow.diagnose.models.law_terms import exerted
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS
from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    hermite,
    integrate,
    latent_force,
    triangles,
)
from visthrow.diagnose.models.quadrotor.flyer_params import MOTORS, FlyerParams
from visthrow.diagnose.models.quadrotor.flyer_windows import (
    FINE,
    KNOTS,
    NEIGHBOUR,
    expect_thrust,
    spare,
    windows_of,
    without_each,
)
from visthrow.logs.check.relations import on_grid
from visthrow.logs.flightlog import FlightLog

Slope = Callable[[int, np.ndarray], np.ndarray]
"""Of the half step, and states or velocities of lanes."""

SHORTEST = 1e-3  # of the motors' lag [s]: a lag of nothing divides by it
BLOCK_OF = {"payload_pos_w": 2, "rate_b": 1}  # number of the latent block that a channel shows


class FlyerModel(NumericModel):
    """Windows of flights of one vehicle."""

    table = "flyer"
    latent_step = 1e-2

    def __init__(self, logs: Sequence[FlightLog], params: FlyerParams) -> None:
        """Cut the flights into windows.

        Raises LogError where no log has the channels, or none flies.
        """
        self.describe(logs, params)
        # numbers of the latent blocks, in the order of their forces
        self.blocks = (0, *[BLOCK_OF[name] for name in self.channels if name in BLOCK_OF])
        super().__init__(logs, params)
        self.steps = round(params.window / params.step)
        # see flyer_windows; the stretch is the first axis
        names = in_all([s.data for s in self.stretches], *self.stretches[0].data)
        self._data = {name: np.array([s.data[name] for s in self.stretches]) for name in names}
        self._commanded = params.thrust(self._data["input"])  # [N], (S, fine steps, motors)
        self._spare = spare(params.step)

    def describe(self, logs: Sequence[FlightLog], params: FlyerParams) -> None:
        """Set the channels that are looked at, that drive the model, and that it needs."""
        optional = {"payload_pos_w": params.cable, "rate_b": params.torque}
        simulated = [name for name, part in optional.items() if part is not None]
        self.channels = (params.position, *simulated)
        drivers = in_all(logs, "battery_voltage", "acc_b", "rate_b", NEIGHBOUR)
        self.inputs = (params.attitude, params.input, *drivers)
        self.needed = (params.position, params.attitude, params.input, *simulated)

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
        return windows_of(log, number, self.params, self.channels, self.blocks)

    def _thrusts(self, lanes: Lanes) -> np.ndarray:
        """Thrust of each motor at the half steps [N], shape (half steps, B, motors): of held
        commands by the map, through a lag.

        In the middle of a step stands what makes Simpson's rule, and so the integration, give the
        step's own mean: commands switch there."""
        p = self.params
        fine = self.params.step / FINE
        delay = p.command_delay + self.size_of(lanes, "cmd_delay")
        tau = p.motor_time_constant + self.size_of(lanes, "motor_tau")
        tau = np.maximum(tau, SHORTEST)
        position = (
            p.window + 0.5 * p.step * np.arange(2 * self.steps + 1)[:, None] - delay
        ) / fine  # tables begin one window early
        index = np.clip(position.astype(int), 0, self._commanded.shape[1] - 1)
        share = (position - index)[..., None]
        out = np.empty((2, *position.shape, self._commanded.shape[2]))
        for lag in np.unique(tau):
            keep = np.exp(-fine / lag)
            members = np.flatnonzero(tau == lag)
            after, _ = lfilter(
                [1.0 - keep], [1.0, -keep], self._commanded, 1, keep * self._commanded[:, :1]
            )
            thrust = np.concatenate([self._commanded[:, :1], after], 1)
            whole = cumulative_trapezoid(thrust, axis=1, initial=0.0)
            which = lanes.owner[members]
            rows = index[:, members]
            part = share[:, members]
            begin = thrust[which, rows]
            rise = thrust[which, rows + 1] - thrust[which, rows]
            out[:, :, members] = (
                begin + part * rise,
                whole[which, rows] + part * (begin + 0.5 * part * rise),
            )
        thrust, whole = out
        mean = np.diff(whole[::2], axis=0) * (fine / p.step)
        thrust[1::2] = 1.5 * mean - 0.25 * (thrust[:-1:2] + thrust[2::2])
        curve = self.size_of(lanes, "thrust_curve")[:, None]
        hover = p.total_mass * p.gravity / thrust.shape[2]  # of one input channel [N]
        since = self._data["since"][lanes.owner] + 0.5 * p.step * np.arange(len(thrust))[:, None]
        faded = 1.0 + self.size_of(lanes, "thrust_fade") * since
        curved = 1.0 + curve * (thrust / hover - 1.0)
        return thrust * self._scale(lanes) * curved * faded[..., None]

    def simulate(self, lanes: Lanes) -> np.ndarray:
        """See the base class.

        The state: position and velocity of the vehicle, with a cable its vector to the payload and
        that one's rate, with torques the body rates; behind it, the thrust of each motor."""
        thrust = self._thrusts(lanes)
        step = np.full((len(lanes.owner), 1), self.params.step)
        rot = self._rotations(lanes)
        mount = self._mount(rot)
        slope = self._slope(lanes, thrust, rot, mount)
        path = integrate(slope, self._begin(lanes, mount), self.steps, step)
        return np.concatenate([path, thrust[::2].swapaxes(0, 1)], 2)

    def _rise(self, thrust: np.ndarray) -> np.ndarray:
        """Slope of the whole thrust at the half steps as knots tell it [N/s], shape (half steps,
        B).
        """
        knots = np.linspace(0.0, self.params.window, KNOTS)
        grid = np.linspace(0.0, self.params.window, len(thrust))
        slope = np.gradient(triangles(knots, grid[::2]) @ thrust[::2].sum(2), knots, axis=0)
        return triangles(grid, knots) @ slope

    def knots(self, stretch: Stretch, path: np.ndarray) -> dict[str, np.ndarray]:
        """See the base class; the cable's tension is what accelerates the payload
        against gravity.
        """
        p = self.params
        time = np.unique(stretch.latent_time)
        grid = stretch.data["start"] + p.step * np.arange(len(path))
        halves = np.arange(2 * self.steps + 1) + self._spare
        at_knots = triangles(time, grid)
        values = at_knots @ path
        rot = Rotation.from_matrix(stretch.data["rot"][halves])
        stamps = stretch.data["start"] + 0.5 * p.step * np.arange(len(halves))
        turned = Slerp(stamps, rot)
        rates = (rot[:-1].inv() * rot[1:]).as_rotvec() / (0.5 * p.step)
        rate = triangles(time, grid[:-1] + 0.5 * p.step) @ (0.5 * (rates[::2] + rates[1::2]))
        thrust = values[:, -self._commanded.shape[2] :].sum(1)
        hung = None
        pose = {"time": time, "quat_wb": turned(time).as_quat()}
        if NEIGHBOUR in self.inputs:
            pose[NEIGHBOUR] = on_grid(stamps, stretch.data[NEIGHBOUR][halves], time)
        if p.cable is not None:
            gap = path[:, 6:9] - stretch.data["rot"][halves[::2]] @ np.array(p.cable.mount)
            vel = path[:, 3:6] + path[:, 9:12]
            direction = gap / np.linalg.norm(gap, axis=1, keepdims=True)
            force = p.cable.mass * (np.gradient(vel, p.step, axis=0) + [0.0, 0.0, p.gravity])
            tension = np.maximum(-np.sum(direction * force, 1, keepdims=True), 0.0)
            hung = at_knots @ direction, at_knots @ tension
        return pose | self._quantities(values, rate, thrust, hung)

    def _scale(self, lanes: Lanes) -> np.ndarray:
        """Thrust over what the map says, shape (B, motors)."""
        p = self.params
        volts = (
            (self._data["volts"][lanes.owner] - p.reference_voltage)
            if self.has_voltage
            else np.zeros(len(lanes.owner))
        )
        sag = p.voltage_coefficient + self.size_of(lanes, "battery_sag")
        scale = (1.0 + self.size_of(lanes, "thrust_gain")) * (1.0 + sag * volts)
        motors = self._commanded.shape[2]
        if motors == 1 or p.torque is None:
            return np.repeat(scale[:, None], motors, 1)
        scales = self.stack(lanes, *(f"motor_{name}" for name in MOTORS))
        return scale[:, None] * (1.0 + scales)

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class."""
        p = self.params
        start = stretch.data["start"]
        out = np.empty((len(path), len(stretch.time)))
        for channel, name in enumerate(self.channels):
            rows = stretch.channel == channel
            if not np.any(rows):
                continue
            time = stretch.time[rows].reshape(-1, 3)[:, 0]
            if name == "rate_b":
                grid = start + p.step * np.arange(path.shape[1])
                last = path.shape[2] - self._commanded.shape[2]
                rates = [on_grid(grid, x[:, last - 3 : last], time) for x in path]
                out[:, rows] = np.reshape(rates, (len(path), -1))
                continue
            late = (
                time[None] - self.size_of(lanes, ("pose_delay", "payload_delay")[channel])[:, None]
            )
            value = path[..., 0:3]
            rate = path[..., 3:6]
            if name == "payload_pos_w":
                value = value + path[..., 6:9]
                rate = rate + path[..., 9:12]
            pos = hermite(late, start, p.step, value, rate)
            if channel == 0 and "marker_z" in self.numbers:
                lever = self.stack(lanes, "marker_x", "marker_y", "marker_z")
                rate_index = np.clip(
                    ((time - start) / (0.5 * p.step)).round().astype(int), 0, 2 * self.steps
                )
                pos = pos + np.einsum(
                    "nij,bj->bni", stretch.data["rot"][rate_index + self._spare], lever
                )
            out[:, rows] = pos.reshape(len(path), -1)
        return out

    def without_commands(
        self, theta: Mapping[str, float], windows: Sequence[int]
    ) -> list[np.ndarray]:
        """See the base class; commands that an autopilot logs of its own motors all came."""
        if self.params.input != "command":
            return []
        return [self._without_each(self.size(theta), i) for i in windows]

    def _without_each(self, size: np.ndarray, i: int) -> np.ndarray:
        """Return the change of a window's samples by each command that does not come, shape
        (N, T).
        """
        stretch = self.stretches[i]
        data = stretch.data
        inputs = [data["input"], *without_each(data["sent"], self.params, data["start"])]
        model = copy(self)
        model._commanded = self.params.thrust(np.array(inputs))
        one = self._lanes(size).part(np.full(len(inputs), i))
        model._data = {name: values[one.owner] for name, values in self._data.items()}
        lanes = replace(one, owner=np.arange(len(inputs)))
        seen = self.measure(stretch, model.simulate(lanes), lanes)
        return (seen[1:] - seen[:1]).T

    def _mount(self, rot: np.ndarray) -> np.ndarray:
        """Return where the cable is attached, from the centre of mass, the velocity and the
        acceleration of that point at the half steps, world frame, shape (3, half steps, B or 1, 3).
        """
        cable = self.params.cable
        if cable is None or not any(cable.mount):
            return np.zeros((3, len(rot), 1, 3))
        arm = rot @ np.array(cable.mount)
        rate = np.gradient(arm, 0.5 * self.params.step, axis=0, edge_order=2)
        return np.array(
            [arm, rate, np.gradient(rate, 0.5 * self.params.step, axis=0, edge_order=2)]
        )

    def _begin(self, lanes: Lanes, mount: np.ndarray) -> np.ndarray:
        """States from the unknowns at the window's start."""
        unknown = lanes.nuisance
        if self.params.cable is None:
            return unknown
        length = (self.params.cable.length + self.size_of(lanes, "rope_length"))[:, None]
        down = self._data["direction"][lanes.owner]
        level = ((0, 0), (0, 1))  # a third component of 0
        side = np.pad(unknown[:, 6:8], level)
        direction = down + side - down * np.sum(down * side, 1, keepdims=True)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        swing = np.pad(unknown[:, 8:10], level)
        swing = swing - direction * np.sum(direction * swing, 1, keepdims=True)
        gap = length * direction + mount[0, 0]
        rate = length * swing + mount[1, 0]
        return np.concatenate((unknown[:, :6], gap, rate, unknown[:, 10:]), 1)

    def _slope(self, lanes: Lanes, thrust: np.ndarray, rot: np.ndarray, mount: np.ndarray) -> Slope:
        """Return the derivative of the states under thrusts [N], shape (half steps, B, motors)."""
        p = self.params
        mass = (p.mass + self.size_of(lanes, "mass_quad"))[:, None]
        tilt = self.stack(lanes, "frame_tilt_y", "frame_tilt_x", "") * [1.0, -1.0, 1.0]
        gravity = p.gravity * (tilt - [0.0, 0.0, 1.0])
        wind = self.stack(lanes, "wind_x", "wind_y", "")
        latent = latent_force(lanes.latent, self.steps, len(self.blocks))
        names = [LATENT_BLOCKS[block] for block in self.blocks]
        force_of = self._force(lanes, thrust, rot)
        exerted_of = self._exerted(lanes, thrust, rot)
        pulled = self._pulled(lanes, mass, gravity, mount) if p.cable is not None else None
        turning = self._turning(lanes, thrust) if p.torque is not None else None

        def slope(half: int, state: np.ndarray) -> np.ndarray:
            vel = state[:, 3:6]
            loads = dict(zip(names, latent[half]))
            loads["vehicle force"] = loads["vehicle force"] + force_of(half, vel - wind)
            if self.laws:
                hung = pulled and pulled(half, state, vel - wind, loads)
                for block, load in exerted_of(half, state, hung).items():
                    loads[block] = loads.get(block, 0.0) + load
            parts = [vel, loads["vehicle force"] / mass + gravity]
            if pulled is not None:
                acc, acc_payload, *_ = pulled(half, state, vel - wind, loads)
                parts = [vel, acc, state[:, 9:12], acc_payload - acc]
            if turning is not None:
                parts.append(turning(half, state[:, -3:], loads["vehicle torque"]))
            return np.concatenate(parts, 1)

        return slope

    def _rotations(self, lanes: Lanes) -> np.ndarray:
        """Return the attitudes of lanes at the half steps, shape (half steps, B, 3, 3)."""
        late = self._spare + self.size_of(lanes, "attitude_delay") / (0.5 * self.params.step)
        position = np.arange(2 * self.steps + 1)[:, None] + late
        measured = self._data["rot"]
        index = np.clip(position.astype(int), 0, measured.shape[1] - 2)
        before = measured[lanes.owner, index]
        share = (position - index)[..., None, None]
        return before + share * (measured[lanes.owner, index + 1] - before)

    def _force(self, lanes: Lanes, thrust: np.ndarray, rot: np.ndarray) -> Slope:
        """Return thrust and air's drag on the vehicle [N, world], by its velocity in the air."""
        p = self.params
        total = thrust.sum(2, keepdims=True)
        added = self.stack(lanes, "rotor_drag_xy", "rotor_drag_xy", "rotor_drag_z")
        drag = np.array([p.drag_xy, p.drag_xy, p.drag_z]) + added
        parasitic = self.size_of(lanes, "parasitic")[:, None]
        lift = self.size_of(lanes, "translational_lift")[:, None]
        turn = self.stack(lanes, "marker_rot_x", "marker_rot_y", "")
        lean = self.size_of(lanes, "estimator_lean")[:, None]
        turns = np.any(turn) or np.any(lean)

        def force(half: int, air: np.ndarray) -> np.ndarray:
            vel_b = np.einsum("bji,bj->bi", rot[half], air)
            level = vel_b[:, :1] ** 2 + vel_b[:, 1:2] ** 2
            speed = np.sqrt(level + vel_b[:, 2:3] ** 2)
            force_b = -(drag + parasitic * speed) * vel_b
            force_b[:, 2:3] += total[half] * (1.0 + lift * level)
            if turns:
                off = turn + lean * self._data["lean"][lanes.owner, half + self._spare]
                force_b = force_b + cross(off, force_b)
            return np.einsum("bij,bj->bi", rot[half], force_b)

        return force

    def _pulled(
        self, lanes: Lanes, mass: np.ndarray, gravity: np.ndarray, mount: np.ndarray
    ) -> Callable:
        """Return what gives accelerations of vehicle and payload, the cable's direction, and what
        it pulls with [N], by the half step, states, velocity in the air and loads; it never pushes.
        """
        payload = (self.params.cable.mass + self.size_of(lanes, "mass_payload"))[:, None]
        payload_drag = self.size_of(lanes, "payload_drag")[:, None]
        reduced = 1.0 / (1.0 / payload + 1.0 / mass)

        def pulled(
            half: int, state: np.ndarray, air: np.ndarray, loads: Mapping
        ) -> tuple[np.ndarray, ...]:
            gap = state[:, 6:9] - mount[0, half]
            gap_rate = state[:, 9:12] - mount[1, half]
            vel = air + state[:, 9:12]
            drag = -payload_drag * np.sqrt(_products(vel, vel)) * vel
            free = loads["vehicle force"] / mass + gravity
            free_payload = (drag + loads["payload force"]) / payload + gravity
            length = np.sqrt(_products(gap, gap))
            direction = gap / length
            separation = _products(direction, free_payload - free - mount[2, half])
            relative = separation + _products(gap_rate, gap_rate) / length
            pull = np.maximum(relative * reduced, 0.0)
            pull_w = pull * direction
            return free + pull_w / mass, free_payload - pull_w / payload, direction, pull

        return pulled

    def _exerted(self, lanes: Lanes, thrust: np.ndarray, rot: np.ndarray) -> Callable:
        """Return what gives the forces and torques of the laws in each latent block, by the half
        step, states and what :meth:`_pulled` gives without them.
        """
        rise = self._rise(thrust) if self.laws else None
        total = thrust.sum(2)

        def loads(half: int, state: np.ndarray, hung: tuple | None) -> dict[str, np.ndarray]:
            row = half + self._spare
            before, after = (self._data["rot"][lanes.owner, row + side] for side in (-1, 1))
            turn = np.einsum("bji,bjk->bik", before, after)
            skew = turn[:, [2, 0, 1], [1, 2, 0]] - turn[:, [1, 2, 0], [2, 0, 1]]
            rate = skew / (2.0 * self.params.step)
            values = {
                "time": np.zeros(len(state)),
                "slope": rise[half],
                **{f"axis_{a}": rot[half, :, :, i] for i, a in enumerate("xyz")},
                **self._quantities(state, rate, total[half], hung and hung[2:]),
            }
            if NEIGHBOUR in self.inputs:
                values[NEIGHBOUR] = self._data[NEIGHBOUR][lanes.owner, row]
            return exerted(self.laws, values)

        return loads

    def _quantities(
        self, state: np.ndarray, rate: np.ndarray, thrust: np.ndarray, hung: tuple | None
    ) -> dict[str, np.ndarray]:
        """Return quantities of laws at states; ``hung``: direction and pull [N] of the cable."""
        values = {"pos_w": state[:, :3], "vel_w": state[:, 3:6], "rate_b": rate, "thrust": thrust}
        if hung is None:
            return values
        return values | {
            "payload_pos_w": state[:, :3] + state[:, 6:9],
            "payload_vel_w": state[:, 3:6] + state[:, 9:12],
            "cable_dir_w": hung[0],
            "tension": hung[1][:, 0],
            "mount_b": np.tile(self.params.cable.mount, (len(state), 1)),
        }

    def _turning(self, lanes: Lanes, thrust: np.ndarray) -> Callable:
        """Return what gives the angular acceleration from the motors' thrusts and the offset of the
        centre of mass, by the half step, rates and a torque [N m].
        """
        p = self.params.torque
        scale = 1.0 + self.stack(lanes, "inertia_xy", "inertia_xy", "inertia_z")
        inertia = np.array(p.inertia) * scale
        com_x, com_y = self.stack(lanes, "com_x", "com_y").T
        total = thrust.sum(2)
        lever = np.stack([-com_y * total, com_x * total, 0.0 * total], -1)
        torque = p.of(thrust) + lever

        def turning(half: int, rate: np.ndarray, push: np.ndarray) -> np.ndarray:
            return (torque[half] - cross(rate, inertia * rate) + push) / inertia

        return turning


def in_all(logs: Sequence[Container[str]], *names: str) -> list[str]:
    """Return the names that all logs hold."""
    return [name for name in names if all(name in log for log in logs)]


def _products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner products of rows, shape (B, 1); of a few rows, ``np.sum`` and ``np.linalg.norm`` take
    several times as long.
    """
    return np.einsum("bi,bi->b", a, b)[:, None]
