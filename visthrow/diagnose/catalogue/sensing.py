"""Effects of the sensors."""

from visthrow.diagnose.catalogue.entry import PAYLOAD, POSE, Entry, Key, entry

S = "sensing."
CLOCK = 1e-3
"""By which a stamp may lie before what it stamps: clocks are no better [s]. A pose is not measured before it is there."""

TURN = ("hover turned by 180 deg",)

ENTRIES: tuple[Entry, ...] = (
    entry(
        "mocap_delay_quad",
        "Poses of the vehicle are older than their stamps",
        "y(t) = h(x(t - theta))",
        "s",
        "sensing",
        (-0.05, 0.1),
        5e-3,
        5e-4,
        POSE,
        "crazyflie_ros issue 141; prior 5 ms",
        [Key(f"{S}vehicle_delay")],
        most=lambda setting: setting.sensing.vehicle_delay + CLOCK,
        confused=("cmd_delay",),
        manoeuvres=("IMU or rotor speeds in the log",),
    ),
    entry(
        "mocap_delay_payload",
        "Positions of the payload are older than their stamps",
        "y(t) = h(x(t - theta))",
        "s",
        "sensing",
        (-0.05, 0.1),
        5e-3,
        5e-4,
        PAYLOAD,
        "crazyflie_ros issue 141; prior 5 ms",
        [Key(f"{S}payload_delay")],
        most=lambda setting: setting.sensing.payload_delay + CLOCK,
        confused=("release_lag", "mocap_delay_quad"),
        manoeuvres=("throws",),
    ),
    entry(
        "gyro_delay",
        "Rates of the gyro are older than their stamps",
        "y(t) = h(x(t - theta))",
        "s",
        "sensing",
        (-0.05, 0.1),
        5e-3,
        5e-4,
        ("rate_b",),
        "prior 5 ms",
        [Key(f"{S}gyro_delay")],
        most=lambda setting: setting.sensing.gyro_delay + CLOCK,
        confused=("mocap_delay_quad",),
    ),
    *(
        entry(
            f"gyro_bias_{axis}",
            f"The gyro shows a rate about {axis} that is none",
            "w_measured = w + theta e",
            "rad/s",
            "sensing",
            (-1.0, 1.0),
            0.02,
            1e-3,
            ("rate_b",),
            "MEMS gyros drift by a degree a second after switching on",
            [Key(f"{S}gyro_bias", index=i)],
            confused=(f"marker_rot_{axis}",),
            manoeuvres=("stand still before the flight",),
        )
        for i, axis in enumerate("xyz")
    ),
    *(
        entry(
            f"frame_tilt_{axis}",
            f"The measured frame is turned about {axis}: gravity looks tilted",
            "y = R(theta) h(x)",
            "rad",
            "sensing",
            (-0.2, 0.2),
            0.0175,
            4e-4,
            POSE,
            "wand calibration; prior 1 deg",
            [Key(f"{S}frame_tilt", index=i)],
            confused=("wind_y" if axis == "x" else "wind_x",),
            manoeuvres=("hang the payload", "hover at two places"),
        )
        for i, axis in enumerate("xy")
    ),
    *(
        entry(
            f"marker_rot_{axis}",
            f"The marker body is turned about the vehicle's {axis}",
            "R_measured = R R(theta)",
            "rad",
            "sensing",
            (-0.3, 0.3),
            0.0175,
            6e-4,
            POSE,
            "markers glued on by hand; prior 1 deg",
            [Key(f"{S}marker_rotation", index=i)],
            confused=("com_y" if axis == "x" else "com_x", "camera_tilt"),
            manoeuvres=TURN,
        )
        for i, axis in enumerate("xyz")
    ),
    *(
        entry(
            f"marker_off_{axis}",
            f"The marker body's origin lies off along {axis}",
            "p_measured = p + R theta e",
            "m",
            "sensing",
            (-0.1, 0.1),
            0.010,
            5e-4,
            POSE,
            "markers glued on by hand; prior 10 mm",
            [Key(f"{S}marker_offset", index=i)],
            confused=("com_" + axis, "mount_" + axis),
            manoeuvres=("turns",),
        )
        for i, axis in enumerate("xyz")
    ),
    *(
        entry(
            f"payload_marker_{axis}",
            f"The payload's measured point lies off along world {axis}",
            "p_measured = p_p + theta e",
            "m",
            "sensing",
            (-0.1, 0.1),
            0.010,
            5e-4,
            PAYLOAD,
            "centroid of markers on a ball; prior 10 mm",
            [Key(f"{S}payload_offset", index=i)],
            confused=("rope_length",) if axis == "z" else (f"mount_{axis}",),
            manoeuvres=("swing: the period",),
        )
        for i, axis in enumerate("xyz")
    ),
    entry(
        "frame_scale",
        "Measured lengths are too long or too short",
        "p_measured = (1 + theta) p",
        "1",
        "sensing",
        (-0.1, 0.1),
        1e-3,
        2e-4,
        POSE,
        "wand calibration; prior 0.1 %",
        [Key(f"{S}scale")],
        confused=("rope_length", "thrust_gain"),
        manoeuvres=("a tape",),
    ),
    entry(
        "clock_rate",
        "The sensors' clock runs faster or slower than the commands'",
        "t = (1 - theta) t_stamp",
        "1",
        "sensing",
        (-1e-2, 1e-2),
        5e-5,
        2e-5,
        POSE,
        "crystals: 50 ppm",
        [Key(f"{S}clock_rate")],
        manoeuvres=("a log of ten minutes",),
    ),
)
"""Priors are one standard deviation; floors: a tenth of the channel's noise over a flight."""
