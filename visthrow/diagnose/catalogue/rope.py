"""Effects of the rope, the payload and the release."""

from visthrow.diagnose.catalogue.entry import PAYLOAD, POSE, Entry, Key, entry

R = "plant.rope."
BOTH = POSE + PAYLOAD

ENTRIES: tuple[Entry, ...] = (
    entry(
        "rope_length", "The rope is longer or shorter", "L + theta", "m", "rope", (-1.0, 0.5), 0.020, 5e-4, BOTH, "tape: 1 mm; prior 20 mm",
        [Key(f"{R}length")], confused=("payload_offset", "payload_marker_z"), manoeuvres=("swing: the period", "hang: the geometry"),
        most=lambda s: 0.8 * s.plant.rope.length,
    ),
    entry(
        "mass_payload", "The payload is heavier or lighter", "m_p + theta", "kg", "payload", (-1.0, 0.2), 3e-3, 3e-4, BOTH,
        "tennis ball, ITF: 56.0 to 59.4 g", [Key(f"{R}payload_mass")], confused=("rope_mass", "downwash"), manoeuvres=("weigh",),
        most=lambda s: 0.8 * s.plant.rope.payload_mass,
    ),
    entry(
        "rope_mass", "The rope is heavier or lighter", "m_r + theta, along its length", "kg", "rope", (-1.0, 0.05), 2e-3, 3e-4, BOTH,
        "cords weigh 1 to 6 g a metre", [Key(f"{R}rope_mass")], confused=("mass_payload",), manoeuvres=("weigh",),
        most=lambda s: 0.8 * s.plant.rope.rope_mass,
    ),
    *(
        entry(
            f"mount_{axis}", f"The rope is mounted elsewhere along {axis}", "torque (r + theta e) x T n", "m", "rope mount", (-0.1, 0.1), 0.010, 5e-4, BOTH,
            "the shaft's place, measured by hand; prior 10 mm", [Key(f"{R}mount", index=i)],
            confused=("com_" + axis, "rope_length" if axis == "z" else "marker_off_" + axis), manoeuvres=("hover with and without load",),
        )
        for i, axis in enumerate("xyz")
    ),
    entry(
        "joint_damping", "The rope bends with more or less loss", "-(d + theta) (w_i - w_(i-1)) in every joint", "N m s", "rope", (-1e-2, 1e-3), 1e-5, 2e-6,
        BOTH, "loss of a braid's bending, hardly known", [Key(f"{R}joint_damping")], confused=("rope_damping", "mount_damping"),
        manoeuvres=("swing and decay",), most=lambda s: s.plant.rope.joint_damping,
    ),
    entry(
        "mount_damping", "The rope's mount rubs", "-theta (w_1 - w) in the uppermost joint", "N m s", "rope mount", (0.0, 1e-2), 1e-4, 1e-5, BOTH,
        "friction of a shaft", [Key(f"{R}mount_damping")], confused=("rope_damping", "joint_damping"), manoeuvres=("swing and decay",),
    ),
    entry(
        "rope_damping", "The swing is damped", "F = -theta v across the rope", "N s/m", "rope", (0.0, 0.1), 2e-3, 2e-4, BOTH,
        "pendulum decay", [Key(f"{R}swing_damping")], confused=("payload_drag", "mount_damping"), manoeuvres=("swing and decay: linear or quadratic",),
    ),
    entry(
        "payload_inertia", "The payload turns with another inertia", "J_p (1 + theta)", "1", "payload", (-1.0, 4.0), 0.5, 0.05, BOTH,
        "hollow sphere 2/3 m r^2", [Key(f"{R}payload_inertia", scale=True)], confused=("rope_length",), manoeuvres=("snap stop",),
        applies=lambda s: s.plant.rope.payload_inertia > 0.0,
    ),
    entry(
        "payload_offset", "The payload's centre lies further from the knot", "b + theta", "m", "payload", (-1.0, 0.1), 0.005, 5e-4, BOTH,
        "ball's radius, ITF: 65.4 to 68.6 mm", [Key(f"{R}payload_offset")], confused=("rope_length",), manoeuvres=("snap stop",),
        most=lambda s: s.plant.rope.payload_offset,
    ),
    entry(
        "payload_drag", "The payload feels drag", "F = -(k + theta) |v| v", "kg/m", "payload air", (-1.0, 0.05), 4e-4, 1e-4, PAYLOAD,
        "Cross and Lindsey 2014: C_d 0.507 +- 0.024 in flight", [Key(f"{R}payload_drag")], confused=("wind_x", "rope_damping"),
        manoeuvres=("long throws",), most=lambda s: s.plant.rope.payload_drag,
    ),
    entry(
        "downwash", "The rotors' jet pushes the payload", "F = -theta T z_b while it hangs", "1", "payload air", (0.0, 0.5), 0.02, 2e-3, BOTH,
        "Bauersfeld 2025: 2 to 9 % of the ball's weight", [Key(f"{R}downwash")], confused=("mass_payload",), manoeuvres=("swing out of the jet",),
    ),
    entry(
        "release_lag", "The payload leaves later or earlier", "t_r = t_cmd + tau_r + theta", "s", "release", (-1.0, 0.3), 0.03, 2e-3, PAYLOAD,
        "the paper, Sec. III-B; prior 110 +- 30 ms", [Key("plant.release.lag")], confused=("mocap_delay_payload", "kick_along"),
        manoeuvres=("throws at three speeds",), most=lambda s: s.plant.release.lag,
    ),
    entry(
        "lag_tension", "The release takes longer under load", "tau_r + theta (T - m_p g)", "s/N", "release", (-0.2, 0.2), 0.01, 2e-3, PAYLOAD,
        "friction of a shaft", [Key("plant.release.lag_tension")], confused=("release_lag",), manoeuvres=("throws at two tensions",),
    ),
    entry(
        "kick_along", "The release pushes the payload along the rope", "v += theta n", "m/s", "release", (-2.0, 2.0), 0.2, 1e-2, PAYLOAD, "linkage",
        [Key("plant.release.kick_along")], confused=("release_lag",), manoeuvres=("throws at three speeds",),
    ),
    *(
        entry(
            f"kick_{axis}", f"The release pushes the payload along world {axis}", "v += theta e", "m/s", "release", (-2.0, 2.0), 0.2, 1e-2, PAYLOAD,
            "linkage", [Key("plant.release.kick_w", index=i)], confused=("release_lag",), manoeuvres=("throws at three speeds",),
        )
        for i, axis in enumerate("xyz")
    ),
    entry(
        "rope_tail", "The rope leaves with the payload", "share theta of the rope's momentum and drag", "1", "release", (-1.0, 1.0), 0.5, 0.1, PAYLOAD,
        "the paper's shaft frees the loop", [Key("plant.release.rope_tail")], confused=("payload_drag",), manoeuvres=("cut the rope",),
        most=lambda s: s.plant.release.rope_tail,
    ),
)  # fmt: skip
"""Priors are one standard deviation; floors from the landing (5 mm) and the numerics."""
