"""Simulation of manoeuvres in one batch, with the diagnosed plant, and logs of them like the
user's.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray

from sim.effects.effect import apply
from sim.effects.setting import AERODYNAMICS
from sim.params import PlantParams, change_values
from sim.scaling.units import Units, convert_units
from visthrow.common import mocap
from visthrow.common.errors import DiagnoseError, LogError
from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import rotate, rotate_back, tilt_deg
from visthrow.diagnose.models.model_interface import Model
from visthrow.diagnose.models.numeric import command_of
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import FlyerParams
from visthrow.diagnose.planning.manoeuvres import PERIOD, Manoeuvre
from visthrow.diagnose.select.result import Diagnosis
from visthrow.diagnose.throw.throw_model import ThrowModel, effects_for
from visthrow.logs.flightlog import STANDARD_CHANNELS, Channel, ChannelSpec, FlightLog
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import load_experiment, plant_of
from visthrow.throws.plants import fly_payloads

SAMPLE_PERIOD = 0.005  # period of the recorded poses [s]: motion capture at 200 Hz
COARSE = 2.0  # integration step of a planned flight's replay, relative to the search's
# hover before a manoeuvre begins, in which a vehicle without payload drops it [s]
APPROACH_SECONDS = 1.5
# angle between rope and rotor axis [deg] beyond which the payload nears the rotors, or a string
# becomes slack
HIGHEST = 75.0

ASTRAY = 0.5
"""Distance from the reference [m] beyond which a flight is aborted; the box of
:meth:`Manoeuvre.limits` has the same margin.
"""

TRACKING = HoverParams(max_speed=8.0, max_tilt=0.9, integral_limit=2.0)
"""Parameters of the hover controller with wide limits, so that it follows a moving reference."""

LOST = 10.0  # largest value of :attr:`SimulatedFlight.used`, for a vehicle that flies off
# mass of a setup's cable relative to its payload; the setup's model has a cable without mass
THREAD = 1e-3

ROWS = ("pos_w", "yaw", "rates_b", "thrust_factor", "release")
"""Fields of a manoeuvre that are flown."""
STEPS = round(PERIOD / SAMPLE_PERIOD)  # samples per row of a reference
SAMPLED = ("pos_w", "quat_wb", "payload_pos_w", "vel_w", "rate_b", "motor_speed", "voltage")
FREE = ChannelSpec("", "none", (), "in the unit in which the model reads it")
"""Specification of a channel without standard name."""


@dataclass(frozen=True)
class Simulated:
    """The model of a simulated manoeuvre."""

    # model of this flight alone, with the diagnosis' catalogue; None if the flight is aborted or
    # cannot be replayed
    model: Model | None
    used: float  # share of the limits, see :attr:`SimulatedFlight.used`


Simulate = Callable[[Sequence[Manoeuvre]], list[Simulated]]


def simulator_of(
    model: Model,
    diagnosis: Diagnosis,
    build: Callable[[Sequence[FlightLog]], Model] | None = None,
    *,
    seed: int = 0,
) -> tuple[Simulate, Callable[[Manoeuvre], Manoeuvre | None]]:
    """Return two functions for a plan: one simulates manoeuvres, the other adapts a manoeuvre to
    this vehicle, or returns None if the vehicle cannot fly it.

    ``diagnosis``: gives the sizes of effects and the sensors' noise; ``build``: makes a setup's
    model of logs. Raises DiagnoseError: the model has no vehicle that flies.
    """
    if isinstance(model, ThrowModel):
        plant = apply(model.entries, model.setting, diagnosis.theta).plant
        adapted = copy
    elif isinstance(model, FlyerModel):
        plant = vehicle_of(model.params, plant_of(load_experiment("state")))
        adapted = partial(adapt_to_payload, params=model.params)
    else:
        raise DiagnoseError(
            "manoeuvres are flown by a vehicle; a plan needs the throw's model, or a quadrotor's"
            " with or without payload"
        )
    noise = _sensor_noise(diagnosis)

    def model_of(flight: SimulatedFlight) -> Model:
        if isinstance(model, ThrowModel):
            return _throw_model(model, noise, flight)
        return build([flight.setup_log(model.params, noise, model.has_voltage)])

    def simulate(manoeuvres: Sequence[Manoeuvre]) -> list[Simulated]:
        flights = fly(plant, manoeuvres, seed, model.device)
        return [flight.simulate(model_of) for flight in flights]

    return simulate, adapted


def _throw_model(
    model: ThrowModel, noise: Mapping[str, float], flight: "SimulatedFlight"
) -> ThrowModel:
    """Return the throw's model of a simulated flight, with those effects of ``model`` that apply to
    it.
    """
    log = flight.log(noise, model.has_voltage)
    carries = flight.manoeuvre.payload
    releases = np.any(flight.manoeuvre.release)
    setting = model.setting
    effects = effects_for(setting, set(log.channels), carries, releases)
    requested = {e.name for e in model.effects}
    names = [name for name in effects if name in requested]
    return ThrowModel(
        [log],
        setting.plant,
        sensing=setting.sensing,
        camera=setting.camera,
        device=model.device,
        substep=COARSE * model.substep,
        only=names,
        carries=carries,
    )


def adapt_to_payload(manoeuvre: Manoeuvre, params: FlyerParams) -> Manoeuvre | None:
    """Return the manoeuvre with the payload of a setup's vehicle, or without; None if the vehicle
    would have to drop its payload.
    """
    carries = params.cable is not None
    if np.any(manoeuvre.release) or (carries and not manoeuvre.payload):
        return None
    return replace(manoeuvre, payload=carries)


def vehicle_of(params: FlyerParams, plant: PlantParams) -> PlantParams:
    """Return the plant of a setup's vehicle: a known plant, scaled to the vehicle's mass at equal
    Froude number, with the parameters that the setup states.
    """
    ratio = plant.vehicle.body.mass / params.mass
    alike = Units(ratio ** (1 / 3), ratio)
    vehicle = convert_units(plant.vehicle, alike)
    rope = convert_units(plant.rope, alike)
    values = {f"aero.{name}": 0.0 for name in AERODYNAMICS}
    values |= {
        "aero.drag_x": params.drag_xy,
        "aero.drag_y": params.drag_xy,
        "aero.drag_z": params.drag_z,
        "body.mass": params.mass,
        "queue.delay": params.command_delay,
        "motor.time_constant": params.motor_time_constant,
        "thrust.voltage_coefficient": 0.0,
        "controller.voltage_compensation": 1.0,
    }
    cable = params.cable
    if cable is not None:
        length = cable.length - rope.payload_offset
        mass = THREAD * cable.mass
        rope = replace(
            rope, length=length, payload_mass=cable.mass, mount=cable.mount, rope_mass=mass
        )
    return replace(plant, vehicle=change_values(vehicle, values), rope=rope)


def _sensor_noise(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the noise of each channel: the model's standard deviation times the estimated
    scale.
    """
    point = diagnosis.work.after
    noise = {}
    for c, name in enumerate(diagnosis.work.problem.model.channels):
        sigma = point.sigma(c) * point.noise.scale[c]
        if np.isfinite(sigma):
            noise[name] = sigma
    return noise


@dataclass(frozen=True)
class SimulatedFlight:
    """A simulated manoeuvre; arrays of :data:`SAMPLED`, without noise, every ``SAMPLE_PERIOD``."""

    manoeuvre: Manoeuvre
    plant: PlantParams
    truth: Mapping[str, ndarray]
    commands: ndarray  # [N, rad/s], shape (rows of the reference, 4)
    rng: np.random.Generator

    @property
    def time(self) -> ndarray:
        """Return the times of the samples [s]."""
        return SAMPLE_PERIOD * np.arange(len(self.truth["pos_w"]))

    def simulate(self, model_of: Callable[["SimulatedFlight"], Model]) -> Simulated:
        """Return the model that ``model_of`` makes of the flight, None if the flight is aborted or
        cannot be replayed; and the share of the limits that it used.
        """
        used = self.used
        try:
            return Simulated(model_of(self) if used < 1.0 else None, used)
        except (DiagnoseError, LogError):
            return Simulated(None, used)

    @property
    def origin_w(self) -> ndarray:
        """Return the position of the body frame's origin [m], shape (N, 3), which motion capture
        reports; the simulator's position is that of the centre of mass.
        """
        com = np.array([self.plant.vehicle.body.com])
        return self.truth["pos_w"] - rotate(self.truth["quat_wb"], com)

    @property
    def used(self) -> float:
        """Return the largest share that the flight used of its limits; it is aborted from 1.

        The limits are ``HIGHEST`` for the swing, ``ASTRAY`` for the distance from the reference,
        and the height of :attr:`Manoeuvre.lowest`.
        """
        planned = self.manoeuvre.pos_w
        off = self.truth["pos_w"][::STEPS] - planned
        height = planned[:, 2] - self.manoeuvre.lowest
        sunk = (-off[:, 2] / height).max()
        distance = np.linalg.norm(off, axis=1)
        astray = distance.max() / ASTRAY
        swing = self.swing / HIGHEST
        used = np.max([swing, astray, sunk])  # NaN counts
        return min(used, LOST) if np.isfinite(used) else LOST

    @property
    def swing(self) -> float:
        """Return the largest angle between the rope and the rotors' axis while the payload hangs
        [deg]; 0 without payload.
        """
        if not self.manoeuvre.payload:
            return 0.0
        released = self.manoeuvre.time[self.manoeuvre.release]
        hanging = self.time < np.min(released, initial=np.inf)
        rope_w = (self.truth["pos_w"] - self.truth["payload_pos_w"])[hanging]
        rope_b = rotate_back(self.truth["quat_wb"][hanging], rope_w)
        return tilt_deg(rope_b).max()

    def log(self, noise: Mapping[str, float], voltage: bool = True) -> FlightLog:
        """Return a flight log like a throw's: poses from motion capture, commands as sent, and the
        battery's voltage if ``voltage``.
        """
        poses = {"pos_w": self.origin_w}
        poses |= {name: self.truth[name] for name in ("payload_pos_w", "quat_wb")}
        values = mocap.add_mocap_noise(poses, {"payload_pos_w": noise["pos_w"], **noise}, self.rng)
        if voltage:
            values["battery_voltage"] = self.truth["voltage"]
        sent = {"command": self.commands, "release_command": self.manoeuvre.release.astype(float)}
        return self._log(_channels(self.time, values) | _channels(self.manoeuvre.time, sent))

    def setup_log(
        self, params: FlyerParams, noise: Mapping[str, float], voltage: bool = False
    ) -> FlightLog:
        """Return a flight log like a setup's: with its channel names, inputs converted by its
        thrust map, and measurements of an IMU on board.
        """
        truth = {**self.truth, "pos_w": self.origin_w}
        names = {"pos_w": params.position, "quat_wb": params.attitude}
        values = {}
        for name in ("pos_w", "payload_pos_w", "rate_b"):
            sd = noise.get(names.get(name, name), 0.0)
            values[name] = truth[name] + sd * self.rng.standard_normal(truth[name].shape)
        force_w = np.gradient(truth["vel_w"], SAMPLE_PERIOD, axis=0) + [0.0, 0.0, GRAVITY]
        values["quat_wb"] = truth["quat_wb"]
        values["acc_b"] = rotate_back(truth["quat_wb"], force_w)
        if voltage:
            battery = self.plant.vehicle.battery.reference_voltage
            values["battery_voltage"] = params.reference_voltage * truth["voltage"] / battery
        measured = _channels(self.time, values)
        channels = {names.get(name, name): channel for name, channel in measured.items()}
        return self._log(channels | self._input(params))

    def _log(self, channels: dict[str, Channel]) -> FlightLog:
        """Return a log of channels, without those of a payload that is not carried."""
        absent = () if self.manoeuvre.payload else ("payload_pos_w", "release_command")
        kept = {name: channel for name, channel in channels.items() if name not in absent}
        return FlightLog(kept, {"period": PERIOD})

    def _input(self, params: FlyerParams) -> dict[str, Channel]:
        """Return the input of a setup's log: thrust converted by the inverse of map, lag and
        delay.
        """
        if params.input in ("command", "thrust_command", "throttle"):
            values = command_of(params.thrust_map, self.commands[:, :1])
            if params.input == "command":
                values = np.hstack((values, self.commands[:, 1:]))
            return _channels(self.manoeuvre.time, {params.input: values})
        thrust = self.plant.vehicle.thrust.k_f * self.truth["motor_speed"] ** 2
        lag = self.plant.vehicle.motor.time_constant
        lagged = thrust + lag * np.gradient(thrust, SAMPLE_PERIOD, axis=0)
        # a held sample stands for the period centred on it
        stamps = self.time - params.command_delay - 0.5 * SAMPLE_PERIOD
        return _channels(stamps, {params.input: command_of(params.thrust_map, lagged)})


def _channels(time: ndarray, values: Mapping[str, ndarray]) -> dict[str, Channel]:
    """Return channels that share their stamps [s]."""
    channels = {}
    for name, array in values.items():
        spec = STANDARD_CHANNELS.get(name, FREE)
        channels[name] = Channel(time, array, spec.unit, spec.frame)
    return channels


def fly(
    plant: PlantParams, manoeuvres: Sequence[Manoeuvre], seed: int, device: str = "cpu"
) -> list[SimulatedFlight]:
    """Simulate manoeuvres in one batch; all hover first where their reference begins, where those
    without payload drop it.
    """
    from sim.hybrid import HybridSim

    count = len(manoeuvres)
    pos_w, yaw, rates_b, thrust_factor, release = (_stack(manoeuvres, name) for name in ROWS)
    plant = replace(plant, sim=replace(plant.sim, control_period=SAMPLE_PERIOD))
    motors = plant.vehicle.controller
    thrusts = {"min_thrust": 4.0 * motors.min_thrust, "max_thrust": 4.0 * motors.max_thrust}
    gains = replace(TRACKING, **thrusts)
    controller = HoverController(gains, PERIOD, count)
    # the goal is ahead of the reference, so that the controller follows velocity and acceleration
    vel_w = np.gradient(pos_w, PERIOD, axis=0)
    push = vel_w + np.gradient(vel_w, PERIOD, axis=0) / gains.velocity_gain
    goals = pos_w + push / gains.position_gain
    sim = HybridSim(plant, count, device)
    sim.place(pos_w[0])
    dropped = ~np.array([m.payload for m in manoeuvres])
    falling = np.full(count, np.nan)  # time since the payload's separation [s]
    commands = []
    samples = []
    falls = []
    for row in range(-round(APPROACH_SECONDS / PERIOD), len(goals)):
        recorded = row >= 0
        i = max(row, 0)
        state = [sim.get(name).astype(float) for name in ("pos_w", "quat_wb", "vel_w")]
        mass = np.where(dropped, plant.vehicle.body.mass, plant.total_mass)
        command = controller.step(*state, goals[i], mass, yaw[i])
        if recorded:
            command[:, 1:] += rates_b[i]
            command[:, 0] *= thrust_factor[i]
            dropped = dropped | release[i]
            commands.append(command)
        sim.set_command(command, dropped)
        for _ in range(STEPS):
            if recorded:
                samples.append([sim.get(name).astype(float) for name in SAMPLED])
                fallen = np.minimum(np.nan_to_num(falling), sim.get("time_to_impact"))
                falls.append((sim.get("payload_vel_w").astype(float), fallen))
            sim.step()
            begun = SAMPLE_PERIOD - sim.get("separation_time")
            falling = np.where(sim.get("separated") != 0, begun, falling + SAMPLE_PERIOD)
    truth = {name: np.array(values) for name, values in zip(SAMPLED, zip(*samples))}
    # the simulator keeps a payload's state at its separation; the falls are computed in one batch
    vel_w, fallen = map(np.array, zip(*falls))
    loose = fallen > 0.0
    begin = truth["payload_pos_w"][loose], vel_w[loose]
    truth["payload_pos_w"][loose] = fly_payloads(plant.rope, plant.air, *begin, fallen[loose])[0]
    sent = np.array(commands)
    flights = []
    for e, manoeuvre in enumerate(manoeuvres):
        rows = len(manoeuvre.time)
        states = {name: values[: rows * STEPS, e] for name, values in truth.items()}
        rng = np.random.default_rng([seed, e])
        flights.append(SimulatedFlight(manoeuvre, plant, states, sent[:rows, e], rng))
    return flights


def _stack(manoeuvres: Sequence[Manoeuvre], name: str) -> ndarray:
    """Stack a field of manoeuvres, shape (rows, manoeuvres, ...); shorter ones repeat their last
    row.
    """
    columns = [getattr(m, name) for m in manoeuvres]
    rows = np.arange(max(map(len, columns)))
    held = [column[np.minimum(rows, len(column) - 1)] for column in columns]
    return np.stack(held, 1)
