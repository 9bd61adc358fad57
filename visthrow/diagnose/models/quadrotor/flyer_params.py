"""Parameters of a quadrotor that its logged commands drive, and of one whose attitude is measured:
the table ``flyer`` of a setup.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy import ndarray

from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bounded, NotNegative, Positive

MOST_LATE = 0.15  # by which attitudes may be late or early [s]
MOTORS = ("fl", "fr", "rl", "rr")


@dataclass(frozen=True)
class CableParams(Bounded):
    """Payload on a cable without mass: a rod, which also pushes."""

    length: Positive  # to the payload's centre [m]
    mass: Positive  # of the payload [kg]
    # where the cable is attached, from the vehicle's centre of mass [m], body frame
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TorqueParams(Bounded):
    """A map from commands of single motors to rates."""

    inertia: tuple[Positive, Positive, Positive]  # [kg m^2]
    arm_x: Positive  # of each rotor from the centre of mass, along x and along y [m]
    arm_y: Positive
    torque_ratio: NotNegative  # drag torque over thrust [m]
    # +1 turns clockwise seen from above; order of the rotors as everywhere
    spin: tuple[float, float, float, float]

    def of(self, thrusts: ndarray) -> ndarray:
        """Return the torque of four rotors' thrusts, shape (..., 4), about the middle of them
        [N m], shape (..., 3).
        """
        front_left, front_right, rear_left, rear_right = np.moveaxis(thrusts, -1, 0)
        right_up = front_left + rear_left - front_right - rear_right
        nose_down = rear_left + rear_right - front_left - front_right
        turn = (self.torque_ratio * thrusts) @ self.spin
        return np.stack([self.arm_y * right_up, self.arm_x * nose_down, turn], -1)


@dataclass(frozen=True)
class QuadrotorParams(Bounded):
    """The vehicle that is assumed first.

    Raises ConfigError where the map does not rise.
    """

    input: str  # channel of the commands
    mass: Positive  # of the vehicle alone [kg]
    gravity: Positive  # [m/s^2]
    # thrust of a motor (of all, for a thrust command) by powers 0, 1, 2 of its input [N]
    thrust_map: tuple[float, float, float]
    motor_time_constant: NotNegative  # [s]
    command_delay: float  # below 0 where the log stamps its inputs late [s]
    reference_voltage: Positive  # at which the map holds [V]
    voltage_coefficient: float  # thrust changes by this share a volt [1/V]
    window: Positive  # [s]
    step: Positive  # of the integration [s]
    every: int  # the measured samples taken: every n-th
    most_windows: int  # spread evenly over all logs

    @property
    def total_mass(self) -> float:
        """Return the mass of all that flies [kg]."""
        return self.mass

    def thrust(self, inputs: ndarray) -> ndarray:
        """Return the thrust that the map gives for inputs [N]."""
        return np.polynomial.polynomial.polyval(inputs, self.thrust_map)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thrust_map[1] <= 0.0 and self.thrust_map[2] <= 0.0:
            raise ConfigError(f"thrust_map {self.thrust_map} does not rise")


@dataclass(frozen=True)
class FlyerParams(QuadrotorParams):
    """A vehicle whose position and attitude are measured.

    Raises ConfigError where torque has no motors' commands or a mounted cable, or where the
    map does not rise.
    """

    # channel of the commands
    input: Literal[
        "motor_command", "motor_speed", "motor_output", "thrust_command", "throttle", "command"
    ]
    position: str  # channel of the measured position
    attitude: str  # channel of the measured attitude
    drag_xy: NotNegative  # rotor drag [kg/s]
    drag_z: NotNegative  # [kg/s]
    lowest: float  # windows keep above this height [m]
    # at which an estimate of the attitude takes other forces than thrust for tilt [1/s]
    estimator_rate: Positive = 1.0
    torque: TorqueParams | None = None  # None: rates are not simulated
    cable: CableParams | None = None  # None: no payload

    @property
    def total_mass(self) -> float:
        """Return the mass of vehicle and payload [kg]."""
        return self.mass + (self.cable.mass if self.cable is not None else 0.0)

    @property
    def relative_mass(self) -> float:
        """Return the vehicle's mass in 0.21 kg, the mass that the catalogue's forces refer to."""
        return self.mass / 0.21

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.torque is not None and self.input not in ("motor_command", "motor_speed"):
            raise ConfigError(
                f"torque needs commands of single motors; the input is '{self.input}'"
            )
        if self.torque is not None and self.cable is not None and any(self.cable.mount):
            raise ConfigError(
                f"cable.mount {self.cable.mount} beside torque: the model has no torque of a cable;"
                " expected one of them alone"
            )
