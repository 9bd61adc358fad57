"""A quadrotor with or without a payload on a cable, driven by its logged commands and its measured
attitude.

If the attitude is measured, the path of the centre of mass follows from thrust, drag and gravity
with any controller; if each motor's command is logged, so do the rates. The controller need not be
known. The simulator's replay flies the vehicle, with the attitude from the log."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.rotations import multiply, normal_part, quat_of_vector, rotate, vectors_between
from visthrow.diagnose.models.law_terms import describe_knots
from visthrow.diagnose.models.model_interface import Sizes
from visthrow.diagnose.models.numeric import Lanes, Stretch, triangles
from visthrow.diagnose.models.quadrotor.driven import DrivenModel, in_all
from visthrow.diagnose.models.quadrotor.flyer_params import MOST_LATE, FlyerParams
from visthrow.diagnose.models.quadrotor.flyer_plant import replay_of
from visthrow.diagnose.models.quadrotor.flyer_windows import (
    IDLE,
    MOST_MISSING,
    NEIGHBOUR,
    cut_flying,
    guess_start,
    lean_of,
    without_each,
)
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples, interpolate

ROWS = 2  # rows of commands and attitudes per step
SWINGING = 3  # replay steps per row with a payload
NEVER = 1e9  # time of release after a window's start, beyond its end [s]


class FlyerModel(DrivenModel):
    """Windows of flights of one vehicle."""

    table = "flyer"

    def __init__(self, logs: Sequence[FlightLog], params: FlyerParams):
        """See the base class."""
        optional = {"payload_pos_w": params.cable, "rate_b": params.torque}
        simulated = [name for name, part in optional.items() if part is not None]
        self.channels = (params.position, *simulated)
        drivers = in_all(logs, "battery_voltage", "acc_b", "rate_b", NEIGHBOUR)
        self.inputs = (params.attitude, params.input, *drivers)
        self.needed = (params.position, params.attitude, params.input, *simulated)
        self.row = params.step / ROWS  # time between rows [s]
        # additional rows of attitudes before and after a window, for their delay
        self.spare = int(np.ceil(MOST_LATE / self.row)) + 1
        super().__init__(logs, params)
        self.rows = ROWS * self.steps

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class; only windows in which the vehicle flies."""
        params = self.params
        driving = [params.position, params.attitude, params.input]
        if NEIGHBOUR in log:
            driving.append(NEIGHBOUR)
        margin = self.spare
        rows = np.arange(-margin, ROWS * self.steps + 1 + margin)
        stretches = []
        for start, tables, common in cut_flying(log, params, self.channels, driving):
            stamps, positions, _ = tables[0]
            if len(stamps) < 5 or np.min(positions[:, 2]) < params.lowest:
                continue
            times = start + self.row * rows
            quat = log[params.attitude].samples().attitudes(times)
            rate = Samples(times, quat).rates(params.step).at(times)
            lean = lean_of(log, params.attitude, params.estimator_rate, times)
            by_name = dict(zip(self.channels, tables))
            guess, spread, direction = guess_start(by_name, params, quat[margin], rate[margin])
            data = common | {"turned": np.hstack((quat, rate, lean)), "direction": direction}
            if NEIGHBOUR in log:
                data[NEIGHBOUR] = log[NEIGHBOUR].samples().at(times[margin:])
            span = start, start + params.window
            stretches.append(self.lay_out(number, "flight", tables, span, data, guess, spread))
        return stretches

    def without_windows(self, logs: Sequence[FlightLog]) -> str:
        """Return the largest height and thrust of the logs, with those that windows need."""
        params = self.params
        heights = [np.max(log[params.position].samples().values[:, 2]) for log in logs]
        weight = params.gravity * params.total_mass
        shares = []
        for log in logs:
            sent = log[params.input].samples().values
            thrusts = params.thrust(sent[:, :1] if params.input == "command" else sent)
            shares.append(np.max(thrusts.sum(axis=1)) / weight)
        return (
            f": {params.position} rises to {max(heights):.3g} m, windows are above lowest ="
            f" {params.lowest:g} m; the thrust by {params.input} and thrust_map carries up to"
            f" {max(shares):.3g} of the weight, windows at least {IDLE:g}; no channel may have a"
            f" gap of {MOST_MISSING:g} s"
        )

    def simulate(self, lanes: Lanes) -> ndarray:
        """See the base class; samples in the order of the replay's sensors."""
        return self._fly(lanes).samples.swapaxes(0, 1)

    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """See the base class."""
        poses = 2 * np.count_nonzero(stretch.channel == 0) // 3
        others_end = poses + np.count_nonzero(stretch.channel) // 3
        samples = np.concatenate([path[:, :poses:2], path[:, poses:others_end]], axis=1)
        return samples.reshape(len(path), -1)

    def knots(self, lanes: Lanes) -> list[Mapping[str, ndarray]]:
        """See the base class."""
        flown = self._fly(lanes, keep=True).knots
        cable = self.params.cable
        mount = None if cable is None else cable.mount
        level = self._level(lanes)
        listed = []
        for i, stretch in enumerate(self.stretches):
            rows = slice(i * self.knot_count, (i + 1) * self.knot_count)
            values = {name: value[rows] for name, value in flown.items()}
            if NEIGHBOUR in self.inputs:
                at_knots = np.linspace(0, self.rows, self.knot_count).round().astype(int)
                values[NEIGHBOUR] = rotate(level[i], stretch.data[NEIGHBOUR][at_knots])
            listed.append(describe_knots(values, np.unique(stretch.latent_time), mount))
        return listed

    def without_commands(self, theta: Sizes, windows: Sequence[int]) -> list[ndarray]:
        """See the base class; motors' commands that an autopilot logs itself are never lost."""
        if self.params.input != "command":
            return []
        return [self._change_without_each(self.size(theta), i) for i in windows]

    def _change_without_each(self, size: ndarray, i: int) -> ndarray:
        """Return the change of a window's samples if each acting command is lost in turn, shape
        (N, commands).
        """
        stretch = self.stretches[i]
        inputs = without_each(stretch.data["sent"], self.params, stretch.data["start"])
        model = copy(self)
        model.stretches = [stretch]
        for commands in inputs:
            model.stretches.append(replace(stretch, data={**stretch.data, "sent": commands}))
        start = np.tile(self._start[i], (len(model.stretches), 1))
        lanes = model._lanes(size, start)
        samples = self.measure(stretch, model.simulate(lanes), lanes)
        return (samples[1:] - samples[:1]).T

    def _fly(self, lanes: Lanes, keep: bool = False) -> Any:
        """Replay lanes (``sim.kernels.replay.lanes.Replayed``).

        ``keep``: whether to return the quantities at each lane's knots."""
        driven = np.column_stack([lanes.owner, lanes.theta])
        _, first, window = np.unique(driven, axis=0, return_index=True, return_inverse=True)
        flights = lanes.part(first)  # lanes that differ in initial state or force share a flight
        tables = self._commands(flights) | self._attitudes(flights)
        begun = {name: table[window, 0] for name, table in tables.items()}
        sizes, plant = np.unique(lanes.theta, axis=0, return_inverse=True)
        replay = replay_of(self.params, self.laws, dict(zip(self.numbers, sizes.T)))
        count = len(lanes.owner)
        push = np.argmax(np.abs(lanes.latent), axis=1)  # at most one acts in a lane
        size = lanes.latent[np.arange(count), push]
        block, axis = np.array(self.pushes)[push // self.knot_count].T
        none = np.full(count, -1)
        swings = 1 if self.params.cable is None else SWINGING
        flown = {
            "window": window,
            "plant": plant,
            "state": np.arange(count),
            "axis": np.where(size == 0.0, -1, 3 * block + axis),
            "knot": push % self.knot_count,
            "size": size,
            "substep": np.full(count, self.row / swings),
            "keep": self.knot_count * np.arange(count) if keep else none,
            "shared": np.zeros(count, dtype=int),
            **dict.fromkeys(("resume", "parent", "skip"), none),
        }
        return replay.run(
            self._begin(lanes, begun),
            self._recording(flights, tables),
            flown,
            self.params.window / (self.knot_count - 1),
            self.knot_count * count,
        )

    def _commands(self, lanes: Lanes) -> dict[str, ndarray]:
        """Return the time [s], each motor's thrust [N] and the slope of their sum [N/s] in each row
        of the lanes, shape (B, rows, ...).
        """
        thrusts = self.thrusts(lanes, self.rows)
        ends = thrusts[::2]
        means = (ends[:-1] + 4.0 * thrusts[1::2] + ends[1:]) / 6.0
        each = np.broadcast_to(means, (*means.shape[:2], 4)) * (means.shape[2] / 4.0)
        # slope of the total thrust, interpolated between the knots
        knots = np.linspace(0.0, self.params.window, self.knot_count)
        rows = self.row * np.arange(self.rows)
        at_knots = triangles(knots, self.row * np.arange(self.rows + 1)) @ ends.sum(2)
        slope = triangles(rows, knots) @ np.gradient(at_knots, knots, axis=0)
        time = self.of_windows(lanes, "start")[:, None] + rows
        return {"command_time": time, "command": each.swapaxes(0, 1), "thrust_rate": slope.T}

    def _attitudes(self, lanes: Lanes) -> dict[str, ndarray]:
        """Return the imposed attitudes, their rates and angular accelerations in each row, shape
        (B, rows, ...): the measured ones, corrected by the lanes' effects.
        """
        late = self.spare + self.size_of(lanes, "attitude_delay") / self.row
        measured = self.of_windows(lanes, "turned")
        rows = np.arange(measured.shape[1])
        imposed = rows[: self.rows + 1]
        shown = [interpolate(rows, table, begin + imposed) for table, begin in zip(measured, late)]
        quat, rate, lean = np.split(np.array(shown), [4, 7], axis=2)
        quat /= np.linalg.norm(quat, axis=2, keepdims=True)
        turn = self.stack(lanes, "marker_rot_x", "marker_rot_y", "")[:, None]
        turn = turn + self.size_of(lanes, "estimator_lean")[:, None, None] * lean
        level = self._level(lanes)[:, None]
        quat = _product(level, _product(quat, quat_of_vector(turn)))
        turned = vectors_between(quat[:, :-1].reshape(-1, 4), quat[:, 1:].reshape(-1, 4))
        acc = np.diff(rate, axis=1) / self.row
        if self.params.torque is not None:  # torques turn the vehicle
            acc = 0.0 * acc
        neighbour = np.zeros_like(acc)
        if NEIGHBOUR in self.inputs:
            neighbour = rotate(level, self.of_windows(lanes, NEIGHBOUR)[:, : self.rows])
        return {
            "attitude": quat[:, :-1],
            "rate_b": rate[:, :-1],  # used if no torque is simulated
            "turn_b": turned.reshape(acc.shape) / self.row,
            "turn_acc_b": acc,
            "neighbour_pos_w": neighbour,
        }

    def _level(self, lanes: Lanes) -> ndarray:
        """Return the attitude of the measured frame in the world, a quaternion, shape (B, 4)."""
        return quat_of_vector(self.stack(lanes, "frame_tilt_x", "frame_tilt_y", ""))

    def _recording(self, flights: Lanes, tables: Mapping[str, ndarray]) -> Any:
        """Return the windows to replay, and the stamps of each sensor's samples in them
        (``sim.kernels.replay.lanes.Recording``).

        ``tables``: commands and attitudes of each flight, shape (B, rows, ...).
        """
        from sim.kernels.replay.kernel import ATTACHED, NO_PAYLOAD
        from sim.kernels.replay.lanes import Recording

        count = len(flights.owner)
        start = self.of_windows(flights, "start")
        first = self.rows * np.arange(count)
        fields = {
            "start": start,
            "end": start + self.params.window,
            "first_knot": start,
            "knots": self.knot_count,
            "payload": NO_PAYLOAD if self.params.cable is None else ATTACHED,
            "latch": start + NEVER,
            "clock_zero": start,
            "command_first": first,
            "command_last": first + self.rows,
        }
        data = {name: table.reshape(-1, *table.shape[2:]) for name, table in tables.items()}
        channels = {"vehicle": self.params.position, "payload": "payload_pos_w", "gyro": "rate_b"}
        for sensor, name in channels.items():
            number = self.channels.index(name) if name in self.channels else -1
            shown = [s.time[s.channel == number][::3] for s in self.stretches]
            counts = np.array(list(map(len, shown)))
            fields[f"{sensor}_count"] = counts[flights.owner]
            fields[f"{sensor}_first"] = (np.cumsum(counts) - counts)[flights.owner]
            data[f"{sensor}_time"] = np.concatenate(shown)
        unused = np.array([0.0, 0.0, 0.0, 1.0])  # attitudes are imposed, not compared
        data["vehicle_quat"] = np.tile(unused, (len(data["vehicle_time"]), 1))
        windows = {name: np.broadcast_to(value, count) for name, value in fields.items()}
        return Recording(windows, data)

    def _begin(self, lanes: Lanes, begun: Mapping[str, ndarray]) -> dict[str, ndarray]:
        """Return the initial states of a replay from the lanes' initial states.

        ``begun``: commands and attitude of each lane at its start."""
        from sim.kernels.replay.lanes import still

        p = self.params
        unknown = lanes.nuisance
        state = still(len(unknown), 1)
        level = self._level(lanes)
        state["pos_w"] = rotate(level, unknown[:, :3])
        state["vel_w"] = rotate(level, unknown[:, 3:6])
        state["quat_wb"] = begun["attitude"]
        state["rate_b"] = begun["rate_b"] if p.torque is None else unknown[:, -3:]
        state["motor_speed"] = begun["command"]
        if p.cable is not None:
            down = self.of_windows(lanes, "direction")
            flat = ((0, 0), (0, 1))  # a third component of 0
            direction = down + normal_part(np.pad(unknown[:, 6:8], flat), down)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            swing = normal_part(np.pad(unknown[:, 8:10], flat), direction)
            state["cable_dir_w"][:, 0] = rotate(level, direction)
            state["cable_vel_w"][:, 0] = rotate(level, swing)
            mass = p.cable.mass + self.size_of(lanes, "mass_payload")
            length = p.cable.length + self.size_of(lanes, "rope_length")
            state["stiffness"][:, 0] = mass * p.gravity * length
        return state


def _product(a: ndarray, b: ndarray) -> ndarray:
    """Return products of quaternions, shape (..., 4)."""
    return np.stack(multiply(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)), -1)
