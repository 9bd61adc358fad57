"""Effects of the rigid body, the command link and the rate controller."""

from visthrow.diagnose.catalogue.entry import POSE, Entry, Key, entry

C = "plant.vehicle.controller."
AXES = "xyz"


def _geometric(setting) -> bool:
    return setting.plant.vehicle.controller.kind == "geometric"


ENTRIES: tuple[Entry, ...] = (
    entry(
        "cmd_delay", "Commands act later or earlier", "u(t - tau_d - theta), held", "s", "command queue", (-1.0, 0.2), 0.02, 1e-3, POSE,
        "Kaufmann et al. 2023; prior 30 +- 20 ms", [Key("plant.vehicle.queue.delay")],
        confused=("mocap_delay_quad", "motor_tau"), manoeuvres=("throws", "IMU or rotor speeds in the log"),
        most=lambda s: s.plant.vehicle.queue.delay,
    ),
    entry(
        "rate_gain", "The rate controller is stiffer or softer about roll and pitch", "p, i, d gains times (1 + theta)", "1", "rate controller",
        (-0.9, 3.0), 0.2, 1e-2, POSE, "Betaflight's tuning range",
        [Key(f"{C}{name}", index=i, scale=True) for name in ("p_gain", "i_gain", "d_gain") for i in (0, 1)],
        confused=("inertia_x", "inertia_y"), manoeuvres=("add a bar of known inertia", "gyro in the log"),
        applies=lambda s: not _geometric(s),
    ),
    entry(
        "rate_gain_yaw", "The rate controller is stiffer or softer about yaw", "p, i, d gains of yaw times (1 + theta)", "1",
        "rate controller", (-0.9, 3.0), 0.2, 2e-2, POSE, "Betaflight's tuning range",
        [Key(f"{C}{name}", index=2, scale=True) for name in ("p_gain", "i_gain", "d_gain")],
        confused=("inertia_z", "yaw_drag_coeff"), manoeuvres=("yaw doublets",), applies=lambda s: not _geometric(s),
    ),
    entry(
        "feedforward", "The rate controller's feed-forward is another", "k_ff (1 + theta) r'", "1", "rate controller", (-1.0, 4.0), 0.5, 5e-2,
        POSE, "Betaflight's tuning range", [Key(f"{C}feedforward_gain", scale=True)], confused=("setpoint_lag",),
        manoeuvres=("rate doublets",), applies=lambda s: not _geometric(s) and any(s.plant.vehicle.controller.feedforward_gain),
    ),
    entry(
        "setpoint_lag", "The set-point is smoothed more or less", "r' = (w_cmd - r) / (T_r + theta)", "s", "rate controller", (-1.0, 0.1), 4e-3,
        1e-3, POSE, "Betaflight's set-point smoothing", [Key(f"{C}setpoint_time_constant")], confused=("cmd_delay",),
        manoeuvres=("rate doublets",), applies=lambda s: not _geometric(s), most=lambda s: s.plant.vehicle.controller.setpoint_time_constant - 1e-3,
    ),
    entry(
        "d_filter", "The derivative term is filtered more or less", "g' = (w - g) / (T_g + theta)", "s", "rate controller", (-1.0, 0.05), 2e-3, 1e-3,
        POSE, "Betaflight's D-term filter", [Key(f"{C}gyro_time_constant")], confused=("rate_gain",), manoeuvres=("rate doublets",),
        applies=lambda s: not _geometric(s), most=lambda s: s.plant.vehicle.controller.gyro_time_constant - 1e-3,
    ),
    entry(
        "geometric_gain", "The simple rate controller is stiffer or softer", "k (1 + theta) J (w_cmd - w)", "1", "rate controller", (-0.9, 3.0), 0.2,
        1e-2, POSE, "range of a rate loop", [Key(f"{C}geometric_gain", scale=True)], confused=("inertia_x", "inertia_y"),
        manoeuvres=("rate doublets",), applies=_geometric,
    ),
    *(
        entry(
            f"inertia_{axis}", f"The moment of inertia about {axis} is another", "J (1 + theta)", "1", "rigid body", (-0.8, 3.0), 0.2,
            2e-2 if axis == "z" else 6e-3, POSE, "Rucker and Wensing 2022: a body's inertia from its motion; prior 20 %",
            [Key("plant.vehicle.body.inertia", index=i, scale=True)], confused=("rate_gain_yaw" if axis == "z" else "rate_gain",),
            manoeuvres=("swings of the payload: the rope's torque is known", "add a bar of known inertia"),
        )
        for i, axis in enumerate(AXES)
    ),
    entry(
        "mass_quad", "The vehicle is heavier or lighter", "m + theta", "kg", "rigid body", (-1.0, 0.5), 0.010, 3e-4, POSE,
        "scales; prior 10 g unweighed", [Key("plant.vehicle.body.mass")], confused=("thrust_gain",), manoeuvres=("weigh",),
        most=lambda s: 0.8 * s.plant.vehicle.body.mass,
    ),
    *(
        entry(
            f"com_{axis}", f"The centre of mass lies off the frame's origin along {axis}", "tau = (r - theta e) x F", "m", "rigid body",
            (-0.05, 0.05), 5e-3, 1e-3 if axis == "z" else 1e-4, POSE, "a battery strapped on by hand; prior 5 mm",
            [Key("plant.vehicle.body.com", index=i)], confused=("marker_off_" + axis, "mount_" + axis),
            manoeuvres=("hover turned by 180 deg", "thrust steps"),
        )
        for i, axis in enumerate(AXES)
    ),
)  # fmt: skip
"""Priors are one standard deviation; floors from the landing (5 mm) and the numerics."""
