"""Effects that the reference plant can show and the training simulator lacks; every one is off by
default.
"""

from dataclasses import dataclass, fields

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class ReferenceExtras:
    """Switchable effects of the reference plant.

    Fields that end in ``_sigma`` are standard deviations of a normal draw at each reset, one an
    environment; fields that end in ``_jitter`` are half-widths of a uniform draw at each event; the
    others are values. Zero switches off. Raises ValueError: a negative value where only the sign of
    0 or more makes sense."""

    payload_drag: float = 0.0  # 1/2 rho C_d A of the payload, on the rope and in flight [kg/m]
    wind_mean_w: Vector = (0.0, 0.0, 0.0)  # world frame [m/s]
    wind_sigma_w: Vector = (
        0.0,
        0.0,
        0.0,
    )  # of an Ornstein-Uhlenbeck process, each axis [m/s]; drawn on, not at reset only
    wind_time_constant: float = 1.0  # of that process [s]
    stretch_stiffness: float = (
        0.0  # of the whole rope, tension over elongation, lumped at its end [N/m]; 0: inextensible
    )
    stretch_damping: float = 0.0  # [N s/m]
    extra_joint_damping: float = 0.0  # added to RopeParams.joint_damping [N m s]
    com_offset: Vector = (0.0, 0.0, 0.0)  # centre of mass from the frame's origin, body frame [m]
    com_offset_sigma: Vector = (0.0, 0.0, 0.0)  # [m]
    thrust_gain_error: float = 0.0  # relative, all motors alike [-]
    thrust_gain_sigma: float = 0.0  # relative, all motors alike [-]
    motor_gain_sigma: float = 0.0  # relative, each motor for itself [-]
    delay_jitter: float = 0.0  # of each command about QueueParams.delay [s]
    release_lag_jitter: float = 0.0  # about ReleaseParams.lag [s]
    mocap_position_sigma: float = 0.0  # each axis, each sample [m]
    mocap_angle_sigma: float = 0.0  # each axis, each sample [rad]
    mocap_velocity_sigma: float = 0.0  # of the filtered velocity, each axis, each sample [m/s]
    gyro_sigma: float = 0.0  # each axis, each sample [rad/s]
    mocap_latency: float = 0.0  # age of a measured pose [s]
    battery_start_used: float = 0.0  # largest used fraction at reset, uniform from 0 [-]
    payload_mass_sigma: float = 0.0  # relative [-]
    rope_length_sigma: float = 0.0  # relative [-]

    def __post_init__(self) -> None:
        signed = {"wind_mean_w", "com_offset", "thrust_gain_error"}
        for item in fields(self):
            value = getattr(self, item.name)
            if (
                item.name not in signed
                and min(value if isinstance(value, tuple) else (value,)) < 0.0
            ):
                raise ValueError(f"extras: {item.name} is {value}, expected 0 or more")
