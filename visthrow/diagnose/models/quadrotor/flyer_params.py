"""Parameters of a quadrotor driven by its logged commands, and of one whose position and attitude
are measured: the table ``flyer`` of a setup.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy import ndarray

from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bounded, NotNegative, Positive

MOST_LATE = 0.15  # largest delay of attitudes, late or early [s]
MOTORS = ("fl", "fr", "rl", "rr")


@dataclass(frozen=True)
class CableParams(Bounded):
    """Payload on a massless cable, modelled as a rod, which can also push."""

    length: Positive  # to the payload's centre [m]
    mass: Positive  # of the payload [kg]
    # where the cable is attached, from the vehicle's centre of mass [m], body frame
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TorqueParams(Bounded):
    """Inertia and rotor geometry, which determine body rates from the motors' thrusts."""

    inertia: tuple[Positive, Positive, Positive]  # [kg m^2]
    arm_x: Positive  # distance of each rotor from the centre of mass along x [m]
    arm_y: Positive  # along y [m]
    torque_ratio: NotNegative  # drag torque over thrust [m]
    # +1 turns clockwise seen from above; front left, front right, rear left, rear right
    spin: tuple[float, float, float, float]

    def of(self, thrusts: ndarray) -> ndarray:
        """Return the torque of four rotors' thrusts [N], shape (..., 4), about the rotors' centre
        [N m], shape (..., 3).
        """
        front_left, front_right, rear_left, rear_right = np.moveaxis(thrusts, -1, 0)
        right_up = front_left + rear_left - front_right - rear_right
        nose_down = rear_left + rear_right - front_left - front_right
        turn = (self.torque_ratio * thrusts) @ self.spin
        return np.stack([self.arm_y * right_up, self.arm_x * nose_down, turn], -1)


@dataclass(frozen=True)
class QuadrotorParams(Bounded):
    """The vehicle before any effect is found.

    Raises ConfigError: the thrust map does not rise.
    """

    input: str  # channel of the commands
    mass: Positive  # of the vehicle without payload [kg]
    gravity: Positive  # [m/s^2]
    # coefficients of powers 0, 1, 2 of the input in a motor's thrust [N]; in the thrust of all
    # motors for a thrust command
    thrust_map: tuple[float, float, float]
    motor_time_constant: NotNegative  # [s]
    command_delay: float  # negative if the log stamps its inputs late [s]
    reference_voltage: Positive  # for which the map is valid [V]
    voltage_coefficient: float  # relative change of thrust per volt [1/V]
    window: Positive  # length of a window [s]
    step: Positive  # of the integration [s]
    every: int  # use every n-th measured sample
    most_windows: int  # largest number of windows, spread evenly over all logs

    @property
    def total_mass(self) -> float:
        """Return the flying mass [kg]."""
        return self.mass

    def thrust(self, inputs: ndarray) -> ndarray:
        """Return the thrust that the map gives for inputs [N]."""
        return np.polynomial.polynomial.polyval(inputs, self.thrust_map)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thrust_map[1] <= 0.0 and self.thrust_map[2] <= 0.0:
            raise ConfigError(
                f"thrust_map {self.thrust_map} does not rise; expected the second or third number"
                " above 0"
            )


@dataclass(frozen=True)
class FlyerParams(QuadrotorParams):
    """A vehicle whose position and attitude are measured.

    Raises ConfigError: ``torque`` without commands of single motors or with ``cable.mount``, or a
    thrust map that does not rise.
    """

    # channel of the commands
    input: Literal[
        "motor_command", "motor_speed", "motor_output", "thrust_command", "throttle", "command"
    ]
    position: str  # channel of the measured position
    attitude: str  # channel of the measured attitude
    drag_xy: NotNegative  # rotor drag [kg/s]
    drag_z: NotNegative  # [kg/s]
    lowest: float  # smallest height in a window [m]
    # rate at which the attitude estimate mistakes forces other than thrust for tilt [1/s]
    estimator_rate: Positive = 1.0
    torque: TorqueParams | None = None  # None: rates are not simulated
    cable: CableParams | None = None  # None: no payload

    @property
    def total_mass(self) -> float:
        """Return the mass of vehicle and payload [kg]."""
        return self.mass + (self.cable.mass if self.cable is not None else 0.0)

    @property
    def relative_mass(self) -> float:
        """Return the vehicle's mass relative to 0.21 kg, for which the catalogue states forces."""
        return self.mass / 0.21

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.torque is not None and self.input not in ("motor_command", "motor_speed"):
            raise ConfigError(
                f"torque with the input '{self.input}'; expected commands of single motors:"
                " motor_command or motor_speed"
            )
        if self.torque is not None and self.cable is not None and any(self.cable.mount):
            raise ConfigError(
                f"cable.mount {self.cable.mount} with torque: the model has no torque of a cable;"
                " expected only one of them"
            )
