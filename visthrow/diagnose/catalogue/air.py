"""Effects of the vehicle's aerodynamics and of the air it flies in."""

from visthrow.diagnose.catalogue.entry import POSE, Entry, Key, entry

A = "plant.vehicle.aero."
BOTH_WAYS = ("passes both ways",)


def _flies(setting) -> bool:
    return setting.plant.vehicle.aero.kind != "none"


ENTRIES: tuple[Entry, ...] = (
    entry(
        "rotor_drag", "The rotors' drag grows with speed otherwise", "F_b = -(d + theta) (v_x, v_y, v_z / 2)", "kg/s", "aerodynamics", (-0.5, 1.0),
        0.05, 2e-3, POSE, "Faessler et al. 2018; Kai et al. 2017; along the shafts about half",
        [Key(f"{A}drag_x"), Key(f"{A}drag_y"), Key(f"{A}drag_z", factor=0.5)], confused=("wind_x", "parasitic"), manoeuvres=BOTH_WAYS,
        applies=_flies, most=lambda s: min(s.plant.vehicle.aero.drag_x, s.plant.vehicle.aero.drag_y, 2 * s.plant.vehicle.aero.drag_z),
    ),
    entry(
        "rotor_drag_z", "Drag along the shafts is another", "F_z = -(d_z + theta) v_z", "kg/s", "aerodynamics", (-0.5, 1.0), 0.05, 4e-3, POSE,
        "Faessler et al. 2018", [Key(f"{A}drag_z")], confused=("inflow", "rotor_drag"), manoeuvres=("vertical sine with two loads",),
        applies=_flies, most=lambda s: s.plant.vehicle.aero.drag_z,
    ),
    entry(
        "parasitic", "The body's drag grows with the square of speed otherwise", "F = -(c + theta) |v| v", "kg/m", "aerodynamics", (-0.1, 0.3), 0.01,
        1e-3, POSE, "NeuroBEM, Bauersfeld et al. 2021", [Key(f"{A}parasitic")], confused=("rotor_drag",), manoeuvres=("speed sweep to 5 m/s",),
        applies=_flies, most=lambda s: s.plant.vehicle.aero.parasitic,
    ),
    entry(
        "translational_lift", "Thrust grows with horizontal speed otherwise", "f_i (1 + (k_h + theta) v_xy^2)", "s^2/m^2", "aerodynamics", (-0.05, 0.05),
        0.01, 3e-4, POSE, "Faessler et al. 2018 (k_h); Svacha et al. 2017", [Key(f"{A}translational_lift")], confused=("rotor_drag_z",),
        manoeuvres=("level passes at 1 to 5 m/s",), applies=_flies,
    ),
    entry(
        "inflow", "Thrust falls with climbing speed otherwise", "f_i (1 - (k_v + theta) v_z)", "s/m", "aerodynamics", (-0.2, 0.3), 0.05, 2e-3, POSE,
        "momentum theory: 1 / (4 v_h)", [Key(f"{A}inflow")], confused=("rotor_drag_z",), manoeuvres=("vertical sine with two loads",), applies=_flies,
    ),
    entry(
        "flapping", "Blade flapping turns the vehicle otherwise", "tau = (k + theta) T (e_z x v_b)", "s", "aerodynamics", (-0.02, 0.02), 1e-3, 5e-5, POSE,
        "Mahony et al. 2012", [Key(f"{A}flapping")], confused=("com_x", "com_y"), manoeuvres=BOTH_WAYS, applies=_flies,
    ),
    *(
        entry(
            f"wind_{axis}", f"The air moves along world {axis}", "v_air = v - theta e", "m/s", "environment", (-3.0, 3.0), 0.5, 0.06 if axis == "z" else 0.03,
            POSE, "Fanger and Christensen 1984: draughts of rooms to 0.4 m/s; prior 0.5 m/s", [Key("plant.air.wind_w", index=i)],
            confused=("frame_tilt_y" if axis == "x" else "frame_tilt_x" if axis == "y" else "thrust_gain",),
            manoeuvres=("hover at two yaws", "hover with and without load"),
        )
        for i, axis in enumerate("xyz")
    ),
    entry(
        "ground_effect", "Thrust grows near the ground", "f_i (1 + theta (1 / (1 - (R / 4 z)^2) - 1))", "1", "environment", (0.0, 6.0), 1.0, 0.3, POSE,
        "Cheeseman and Bennett 1955; Sanchez-Cuevas et al. 2017", [Key("plant.air.ground_effect")], confused=("thrust_gain",),
        manoeuvres=("hover at 0.10, 0.15 and 0.3 m",),
    ),
    entry(
        "air_density", "The air is denser or thinner", "thrust, aerodynamics and the payload's drag times (1 + theta)", "1", "environment", (-0.3, 0.3),
        0.05, 2e-3, POSE, "barometer; 3 % over 10 K",
        [Key("plant.vehicle.thrust.gain", scale=True), Key("plant.rope.payload_drag", scale=True),
         *(Key(f"{A}{name}", scale=True) for name in ("drag_x", "drag_y", "drag_z", "parasitic"))],
        confused=("thrust_gain",), manoeuvres=("read a barometer",),
    ),
)  # fmt: skip
"""Priors are one standard deviation; floors from the landing (5 mm) and the numerics."""
