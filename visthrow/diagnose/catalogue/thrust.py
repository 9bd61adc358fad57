"""Effects of the thrust map, the motors and the battery."""

from visthrow.diagnose.catalogue.entry import POSE, Entry, Key, entry

GAIN = "plant.vehicle.thrust.gain"
MOTORS = ("front left", "front right", "rear left", "rear right")

ENTRIES: tuple[Entry, ...] = (
    entry(
        "thrust_gain", "The rotors give another thrust than the map says", "f_i = (1 + theta) k_f Omega_i^2", "1", "thrust map",
        (-0.5, 0.5), 0.10, 2e-3, POSE, "Agilicious, Foehn et al. 2022; prior: thrust stands repeat to a few per cent",
        [Key(GAIN, scale=True)], confused=("mass_quad", "battery_sag", "air_density"),
        manoeuvres=("weigh", "hover with and without a weighed load"),
    ),
    entry(
        "thrust_curve", "The thrust map has a linear term", "f_i = k_f Omega_i^2 + theta Omega_i", "N s/rad", "thrust map",
        (-4e-4, 4e-4), 5e-5, 1e-6, POSE, "arXiv 2404.07837: 5 % at 0.3 and 3 times the weight",
        [Key("plant.vehicle.thrust.k_1")], confused=("thrust_gain", "battery_sag"), manoeuvres=("thrust steps 0.4 to 3 g",),
    ),
    *(
        entry(
            f"motor_{i + 1}", f"The {place} rotor gives another thrust than the others", "f_i = (1 + theta) k_f Omega_i^2", "1",
            "thrust map", (-0.6, 0.6), 0.05, 2e-3, POSE, "fault detection literature; prior: rotors of one kit differ by 1 to 2 %",
            [Key(GAIN, index=i, scale=True)], confused=("com_x", "com_y"), manoeuvres=("yaw doublets",),
        )
        for i, place in enumerate(MOTORS)
    ),
    entry(
        "yaw_drag_coeff", "The rotors' drag torque is another", "tau_i = (1 + theta) kappa f_i", "1", "thrust map", (-0.8, 2.0), 0.2,
        2e-2, POSE, "blade-element theory; prior: 20 % between propellers", [Key("plant.vehicle.thrust.torque_gain", scale=True)],
        confused=("rate_gain_yaw",), manoeuvres=("yaw doublets",),
    ),
    entry(
        "rotor_gyro", "The rotors' inertia about their shafts is another", "tau_z = (1 + theta) J_r sum s_i Omega_i'", "1",
        "rigid body", (-1.0, 4.0), 0.5, 5e-2, POSE, "Agilicious, Foehn et al. 2022", [Key("plant.vehicle.rotors.inertia", scale=True)],
        confused=("yaw_drag_coeff",), manoeuvres=("thrust steps at fixed yaw",),
        applies=lambda s: s.plant.vehicle.rotors.inertia > 0.0,
    ),
    entry(
        "motor_tau", "The motors follow with another time constant", "Omega' = (Omega* - Omega) / (tau_m + theta)", "s", "motor",
        (-1.0, 0.2), 0.015, 1e-3, POSE, "arXiv 2404.07837; prior 33 +- 15 ms",
        [Key("plant.vehicle.motor.time_constant"), Key("plant.vehicle.motor.time_constant_down")],
        confused=("cmd_delay", "rate_gain"), manoeuvres=("rate doublets", "thrust steps"),
        applies=lambda s: s.plant.vehicle.motor.kind != "instant", most=lambda s: s.plant.vehicle.motor.time_constant - 2e-3,
    ),
    entry(
        "motor_tau_down", "The motors slow down with another time constant than they speed up", "Omega' by tau_m + theta where falling",
        "s", "motor", (-1.0, 0.2), 0.015, 1.5e-3, POSE, "arXiv 2404.07837", [Key("plant.vehicle.motor.time_constant_down")],
        confused=("motor_tau",), manoeuvres=("thrust steps up and down",),
        applies=lambda s: s.plant.vehicle.motor.kind == "asymmetric", most=lambda s: s.plant.vehicle.motor.time_constant_down - 2e-3,
    ),
    entry(
        "battery_sag", "Thrust falls or rises with the battery's voltage otherwise", "f_i = k_f Omega_i^2 (1 + (c_u + theta)(u - u_ref))",
        "1/V", "battery", (-0.5, 0.5), 0.1, 1e-2, POSE, "Bauersfeld and Scaramuzza 2022",
        [Key("plant.vehicle.thrust.voltage_coefficient")], confused=("thrust_gain",),
        manoeuvres=("a fresh pack, an empty one, a fresh one",), applies=lambda s: s.plant.vehicle.battery.kind == "sag",
    ),
)  # fmt: skip
"""Priors are one standard deviation; floors from the landing (5 mm) and the numerics (diagnosis of step sizes)."""
