"""Effects of the reference plant that the training simulator lacks. All are off by default."""

from dataclasses import dataclass

from camera.field_bounds import BoundedFields, NotNegative, NotNegativeVector, Positive, Vector


@dataclass(frozen=True)
class ReferenceExtras(BoundedFields):
    """Optional effects of the reference plant.

    A field that ends in ``_sigma`` is the standard deviation of a normal draw for each environment
    at each reset. A field that ends in ``_jitter`` is the half-width of a uniform draw at each
    event. The others are values. Zero disables an effect."""

    # 1/2 rho C_d A of the payload, on the rope and in flight [kg/m]
    payload_drag: NotNegative = 0.0
    wind_mean_w: Vector = (0.0, 0.0, 0.0)  # world frame [m/s]
    # of an Ornstein-Uhlenbeck process on each axis [m/s]; it also runs between resets
    wind_sigma_w: NotNegativeVector = (0.0, 0.0, 0.0)
    wind_time_constant: Positive = 1.0  # of that process [s]
    # of the whole rope, tension over elongation, lumped at its end [N/m]; 0: inextensible
    stretch_stiffness: NotNegative = 0.0
    stretch_damping: NotNegative = 0.0  # [N s/m]
    extra_joint_damping: NotNegative = 0.0  # added to RopeParams.joint_damping [N m s]
    com_offset: Vector = (0.0, 0.0, 0.0)  # centre of mass from the frame's origin, body frame [m]
    com_offset_sigma: NotNegativeVector = (0.0, 0.0, 0.0)  # [m]
    thrust_gain_error: float = 0.0  # relative, equal for all motors [-]
    thrust_gain_sigma: NotNegative = 0.0  # relative, equal for all motors [-]
    motor_gain_sigma: NotNegative = 0.0  # relative, independent for each motor [-]
    delay_jitter: NotNegative = 0.0  # of each command about QueueParams.delay [s]
    release_lag_jitter: NotNegative = 0.0  # about ReleaseParams.lag [s]
    mocap_position_sigma: NotNegative = 0.0  # each axis, each sample [m]
    mocap_angle_sigma: NotNegative = 0.0  # each axis, each sample [rad]
    # of the filtered velocity, each axis, each sample [m/s]
    mocap_velocity_sigma: NotNegative = 0.0
    gyro_sigma: NotNegative = 0.0  # each axis, each sample [rad/s]
    mocap_latency: NotNegative = 0.0  # age of a measured pose [s]
    battery_start_used: NotNegative = 0.0  # largest used fraction at reset, uniform from 0 [-]
    payload_mass_sigma: NotNegative = 0.0  # relative [-]
    rope_length_sigma: NotNegative = 0.0  # relative [-]
