"""The training simulator's vehicle as a plant of the fake autopilot (`hil.rehearsal.process`).

``hil`` does not import the simulator; it loads ``"visthrow.throws.wire_plant:make"`` by name.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from sim.params import change_values
from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import rotate_back
from visthrow.task import Experiment, plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.plants import HybridPlant, random_ropes

MECHANISM = 0.06
"""Time from the trip of the latch to separation with a firmware in the loop [s]: a fast servo, so
that this and the firmware's delay together fit the lag with which the policies were trained.
"""

# share of the weight at which the thrust lifts a vehicle off its stand; a hover controller commands
# less than the weight if the vehicle stands above its set-point
CARRIED = 0.8


class HybridWirePlant:
    """One vehicle with its payload; NumPy arrays without a batch axis.

    Attributes:
        period: step [s], the longest time that a command waits.
        home_w: hover point [m]. mass: mass with and without payload [kg]. max_thrust: thrust that a
            normalised thrust of 1 stands for [N].
    """

    period = 0.005

    def __init__(self, experiment: Experiment, seed: int):
        """Place the vehicle near its hover point, with a slightly tilted rope."""
        self._plant = self._build(experiment)
        self.home_w = np.array([0.0, 0.0, experiment.task.start.spawn_height])
        self.mass = (plant_of(experiment).total_mass, experiment.vehicle.body.mass)
        self.max_thrust = experiment.task.action.max_thrust
        rng = np.random.default_rng(seed)
        place = self.home_w + 0.1 * rng.uniform(-1, 1, (1, 3))
        self._plant.reset(place, random_ropes(rng, 1, experiment.rope.segments, 0.05))

    def _build(self, experiment: Experiment) -> HybridPlant:
        return HybridPlant(self._fine(experiment))

    def _fine(self, experiment: Experiment) -> Experiment:
        """Return the experiment with this plant's period and without latency."""
        observation = "task.observation"
        values = {f"{observation}.latency": (0.0, 0.0), f"{observation}.latency_jitter": 0.0}
        return change_values(experiment, values | {"sim.control_period": self.period})

    def step(self, command: ndarray, release: bool, after: float = 0.0) -> None:
        """Advance by one period under collective thrust [N] and body rates [rad/s], shape (4,).

        ``release``: whether the latch trips in this period or has tripped before. ``after``: time
        from the start of the period to the trip [s]."""
        first = release and not self._plant.state.latched[0]
        self._plant.step(np.asarray(command)[None], np.array([release]))
        if first and after > 0.0:
            self._plant.postpone(after)

    @property
    def time(self) -> float:
        """Return the time since the start [s]."""
        return self._plant.time

    @property
    def state(self) -> dict[str, ndarray]:
        """Return the true pos_w, quat_wb, vel_w, rate_b, payload_pos_w and attached."""
        state = self._plant.state
        names = ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w", "attached")
        return {name: getattr(state, name)[0] for name in names}

    @property
    def landing(self) -> dict[str, list[float] | float | None]:
        """Return the payload's landing and separation, None before they happen."""
        landing = self._plant.landing
        report: dict[str, list[float] | float | None]
        report = dict.fromkeys(("landing_w", "landing_time", "separation_time"))
        if landing.landed[0]:
            report["landing_w"] = landing.point_w[0].tolist()
            report["landing_time"] = float(landing.time[0])
        if not np.isnan(landing.separation_time[0]):
            report["separation_time"] = float(landing.separation_time[0])
        return report


def make(policy: str, seed: int, changes: Sequence[str] = ()) -> HybridWirePlant:
    """Build the plant that a policy (a shipped name or a file) was trained on, with ``key=value``
    changes of its configuration.
    """
    return HybridWirePlant(load_policy(policy, None, changes).experiment, seed)


class HybridMotorPlant(HybridWirePlant):
    """A vehicle without its rate controller, for a firmware that outputs motor commands.

    The electronic speed controllers set rotor speeds of
    ``full_speed * command * voltage / reference``, so thrust is proportional to the squares of
    command and battery voltage. At the reference voltage the full command yields the controller's
    full thrust. At first the vehicle rests on a stand, with the rope hanging, until its rotors
    nearly carry its weight. After a touchdown it stands level on the ground.

    Attributes:
        force_b: specific force, as an accelerometer measures it [m/s^2], body frame. held: whether
            the vehicle stands. touchdown: speed of the first touchdown [m/s]; None before.
        quat_wb, rate_b: current attitude xyzw and body rates [rad/s].
    """

    period = 0.002

    def __init__(self, experiment: Experiment, seed: int):
        super().__init__(experiment, seed)
        controller = experiment.vehicle.controller
        thrust = experiment.vehicle.thrust
        battery = experiment.vehicle.battery
        self._full_speed = (controller.max_thrust / thrust.k_f) ** 0.5
        mixing = controller.kind == "motor_mixing"
        self._k_f = thrust.k_f
        self._reference = controller.calibration_voltage if mixing else battery.reference_voltage
        self._plant.stop_motors()
        self._stand: dict[str, ndarray] | None = self._plant.hold()
        self._look()
        self.force_b = np.array([0.0, 0.0, GRAVITY])
        self._ground = experiment.vehicle.collision_radius
        self._floor = experiment.rope.payload_radius
        self.touchdown: float | None = None

    def look(self) -> dict[str, ndarray]:
        """Return the current position, attitude, velocity, body rates, motor speeds [rad/s],
        voltage [V] and used share of the charge.
        """
        names = ("pos_w", "quat_wb", "vel_w", "rate_b", "motor_speed", "voltage", "charge_used")
        return {name: value[0] for name, value in zip(names, self._plant.look(*names))}

    def rope(self) -> list[ndarray]:
        """Return directions of the rope's segments and their derivatives [1/s], shapes (L, 3),
        world frame.
        """
        return [value[0] for value in self._plant.look("cable_dir_w", "cable_vel_w")]

    def _look(self) -> None:
        self._now = self.look()
        self.quat_wb = self._now["quat_wb"]
        self.rate_b = self._now["rate_b"]

    def _build(self, experiment: Experiment) -> HybridPlant:
        # the firmware's delay replaces the simulated ones
        values = {"vehicle.queue.delay": 0.0, "release.lag": MECHANISM}
        return HybridPlant(self._fine(change_values(experiment, values)), motors=True)

    @property
    def held(self) -> bool:
        """Return whether the vehicle stands."""
        return self._stand is not None

    @property
    def state(self) -> dict[str, ndarray]:
        """Return the true state; a hanging ball is kept above the ground."""
        state = super().state
        ball = state["payload_pos_w"].copy()
        ball[2] = max(ball[2], self._floor)
        return state | {"payload_pos_w": ball}

    def step(self, command: ndarray, release: bool, after: float = 0.0) -> None:
        """Advance by one period under motor commands, 0 to 1, shape (4,); release: see
        `HybridWirePlant`.
        """
        vel_w = self._now["vel_w"]
        drive = np.clip(command, 0.0, 1.0) * self._now["voltage"]
        speed = self._full_speed * drive / self._reference
        super().step(speed, release and not self.held, after)
        self._look()
        if self._stand is None and self._now["pos_w"][2] < self._ground:
            self._set_down()
        elif self._stand is None:
            push_w = (self._now["vel_w"] - vel_w) / self.period + np.array([0.0, 0.0, GRAVITY])
            self.force_b = rotate_back(self.quat_wb, push_w)
        elif self._k_f * np.sum(self._now["motor_speed"] ** 2) < CARRIED * self.weight:
            self._plant.hold(self._stand)
            self._look()
        else:
            self._stand = None

    @property
    def voltage(self) -> float:
        """Return the battery's voltage under load [V]."""
        return float(self._now["voltage"])

    @property
    def weight(self) -> float:
        """Return the weight of the vehicle with its payload, if attached [N]."""
        return self.mass[0 if self._plant.state.attached[0] else 1] * GRAVITY

    def _set_down(self) -> None:
        """Place the vehicle on the ground, at rest and level, with a straight rope."""
        if self.touchdown is None:
            self.touchdown = -float(self._now["vel_w"][2])
        _, _, z, w = self.quat_wb
        level = np.array([0.0, 0.0, z, w]) / max(np.hypot(z, w), 1e-9)
        stand = self._plant.hold()
        for name in ("vel_w", "rate_b", "cable_vel_w"):
            stand[name][:] = 0.0
        stand["quat_wb"][:] = level
        stand["cable_dir_w"][:] = (0.0, 0.0, -1.0)
        stand["pos_w"][..., 2] = self._ground
        self._stand = stand
        self.force_b = np.array([0.0, 0.0, GRAVITY])
        self._plant.hold(stand)
        self._look()


def make_motors(policy: str, seed: int, changes: Sequence[str] = ()) -> HybridMotorPlant:
    """Build the plant of :func:`make` with motor commands."""
    return HybridMotorPlant(load_policy(policy, None, changes).experiment, seed)
