"""The worlds' vehicle: the values of the paper's configs, read as data, and how a hidden effect
changes them.
"""

import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
RELEASE_LAG = 0.11
LANDING_HEIGHT = 0.04


def nominal() -> SimpleNamespace:
    """All numbers of a world without a hidden effect; fields of
    :class:`bench.worlds.vehicle.Numbers` and a few beside.
    """
    v = tomllib.loads((CONFIGS / "vehicle" / "paper.toml").read_text())
    r = tomllib.loads((CONFIGS / "rope" / "paper.toml").read_text())
    release = tomllib.loads((CONFIGS / "release" / "paper.toml").read_text())
    c = v["controller"]
    b = v["battery"]
    a = v["aero"]
    t = v["thrust"]
    return SimpleNamespace(
        mass=v["body"]["mass"],
        inertia=np.array(v["body"]["inertia"]),
        com=np.zeros(3),
        rotor_x=np.array(v["rotors"]["x"]),
        rotor_y=np.array(v["rotors"]["y"]),
        rotor_z=v["rotors"]["z"],
        spin=np.array(v["rotors"]["spin"]),
        rotor_inertia=v["rotors"]["inertia"],
        rotor_radius=v["rotors"]["radius"],
        geometric=0,
        kp=np.array(c["p_gain"]),
        ki=np.array(c["i_gain"]),
        kd=np.array(c["d_gain"]),
        kf=np.array(c["feedforward_gain"]),
        integral_limit=np.array(c["integral_limit"]),
        stick_lag=c["setpoint_time_constant"],
        gyro_lag=c["gyro_time_constant"],
        geometric_gain=c["geometric_gain"],
        thrust_min=c["min_thrust"],
        thrust_max=c["max_thrust"],
        compensation=c["voltage_compensation"],
        believed_inertia=np.array(v["body"]["inertia"]),
        believed_x=np.array(v["rotors"]["x"]),
        believed_y=np.array(v["rotors"]["y"]),
        believed_kappa=t["torque_ratio"],
        believed_thrust=t["k_f"],
        lag_up=v["motor"]["time_constant"],
        lag_down=v["motor"]["time_constant"],
        capacity=b["capacity"],
        ocv=np.array(b["ocv"]),
        resistance=b["resistance"],
        sag_lag=b["time_constant"],
        idle_power=b["idle_power"],
        efficiency=b["efficiency"],
        nominal_voltage=b["reference_voltage"],
        ideal_battery=0,
        thrust_square=t["k_f"],
        thrust_linear=t["k_1"],
        per_volt=t["voltage_coefficient"],
        kappa=t["torque_ratio"],
        rotor_gain=np.ones(4),
        drag=np.array([a["drag_x"], a["drag_y"], a["drag_z"]]),
        parasitic=a["parasitic"],
        inflow=a["inflow"],
        torque_inflow=a["torque_inflow"],
        lift=a["translational_lift"],
        flapping=a["flapping"],
        ground=0.0,
        wind=np.zeros(3),
        speed_thrust=0.0,
        slew_thrust=0.0,
        yaw_swirl=0.0,
        power_drag=0.0,
        sink_push=0.0,
        mount=np.array(r["mount"]),
        length=r["length"],
        rope_mass=r["rope_mass"],
        ball_mass=r["payload_mass"],
        ball_reach=r["payload_offset"],
        ball_inertia=r["payload_inertia"],
        joint_damping=r["joint_damping"],
        joint_damping_square=0.0,
        bending=0.0,
        stretch=0.0,
        rope_drag=0.0,
        ball_drag=0.0,
        ball_side=0.0,
        ball_lift=0.0,
        ball_swirl=0.0,
        jet_push=0.0,
        # Not in the equations of motion: queue, release, sensors.
        delay=v["queue"]["delay"],
        release_lag=release["lag"],
        lag_per_newton=0.0,
        lag_jitter=0.0,
        kick=np.zeros(3),
        quad_stamp=0.0,
        ball_stamp=0.0,
        frame_tilt=np.zeros(3),
        marker_turn=np.zeros(3),
        marker_off=np.zeros(3),
        ball_marker_off=np.zeros(3),
        frame_scale=0.0,
        clock_ppm=0.0,
        camera_turn=np.zeros(3),
        camera_place=np.zeros(3),
        camera_focal=0.0,
        camera_centre=np.zeros(2),
        camera_k1=0.0,
        camera_late=0.0,
        camera_row=0.0,
        camera_ball=0.0,
    )


EXTRA = (
    "delay",
    "release_lag",
    "lag_per_newton",
    "lag_jitter",
    "kick",
    "quad_stamp",
    "ball_stamp",
    "frame_tilt",
    "marker_turn",
    "marker_off",
    "ball_marker_off",
    "frame_scale",
    "clock_ppm",
    "camera_turn",
    "camera_place",
    "camera_focal",
    "camera_centre",
    "camera_k1",
    "camera_late",
    "camera_row",
    "camera_ball",
)


def _scale(name):
    def change(w, theta):
        setattr(w, name, getattr(w, name) * (1.0 + theta))

    return change


def _add(name, axis=None):
    def change(w, theta):
        if axis is None:
            setattr(w, name, getattr(w, name) + theta)
        else:
            value = getattr(w, name).copy()
            value[axis] += theta
            setattr(w, name, value)

    return change


def _motor_tau(w, theta):
    w.lag_up += theta
    w.lag_down += theta


def _rotor_drag(w, theta):
    w.drag = w.drag + theta * np.array([1.0, 1.0, 0.5])


def _rate_gain(w, theta):
    w.kp = w.kp * (1 + theta)
    w.ki = w.ki * (1 + theta)
    w.kd = w.kd * (1 + theta)


def _no_aero(w, _):
    w.drag = np.zeros(3)
    w.parasitic = 0.0
    w.inflow = 0.0
    w.torque_inflow = 0.0
    w.lift = 0.0
    w.flapping = 0.0


def _geometric(w, _):
    w.geometric = 1


CHANGES = {
    "thrust_gain": _scale("thrust_square"),
    "thrust_curve": _add("thrust_linear"),
    "motor_tau": _motor_tau,
    "cmd_delay": _add("delay"),
    "rate_gain": _rate_gain,
    "inertia_x": lambda w, t: _add("inertia", 0)(w, t * w.inertia[0]),
    "inertia_y": lambda w, t: _add("inertia", 1)(w, t * w.inertia[1]),
    "inertia_z": lambda w, t: _add("inertia", 2)(w, t * w.inertia[2]),
    "mass_quad": _add("mass"),
    "com_x": _add("com", 0),
    "com_y": _add("com", 1),
    "motor_1": _add("rotor_gain", 0),
    "motor_2": _add("rotor_gain", 1),
    "motor_3": _add("rotor_gain", 2),
    "motor_4": _add("rotor_gain", 3),
    "battery_sag": _add("per_volt"),
    "rotor_drag": _rotor_drag,
    "parasitic": _add("parasitic"),
    "translational_lift": _add("lift"),
    "inflow": _add("inflow"),
    "flapping": _add("flapping"),
    "yaw_drag_coeff": _scale("kappa"),
    "rotor_gyro": _scale("rotor_inertia"),
    "rope_length": _add("length"),
    "mass_payload": _add("ball_mass"),
    "rope_mass": _add("rope_mass"),
    "mount_x": _add("mount", 0),
    "mount_y": _add("mount", 1),
    "mount_z": _add("mount", 2),
    "rope_damping": _add("rope_drag"),
    "joint_damping": _add("joint_damping"),
    "payload_drag": _add("ball_drag"),
    "downwash": _add("jet_push"),
    "release_lag": _add("release_lag"),
    "lag_tension": _add("lag_per_newton"),
    "kick_x": _add("kick", 0),
    "kick_z": _add("kick", 2),
    "mocap_delay_quad": _add("quad_stamp"),
    "mocap_delay_payload": _add("ball_stamp"),
    "frame_tilt_x": _add("frame_tilt", 0),
    "frame_tilt_y": _add("frame_tilt", 1),
    "marker_rot_x": _add("marker_turn", 0),
    "marker_rot_y": _add("marker_turn", 1),
    "marker_rot_z": _add("marker_turn", 2),
    "marker_off_x": _add("marker_off", 0),
    "marker_off_z": _add("marker_off", 2),
    "wind_x": _add("wind", 0),
    "wind_y": _add("wind", 1),
    "ground_effect": _add("ground"),
    "rope_elastic": lambda w, t: _add("stretch")(w, t / w.length),
    "payload_side": _add("ball_side"),
    "payload_lift": _add("ball_lift"),
    "lag_jitter": _add("lag_jitter"),
    # The camera.
    "camera_tilt_x": _add("camera_turn", 0),
    "camera_tilt_y": _add("camera_turn", 1),
    "camera_tilt_z": _add("camera_turn", 2),
    "camera_lever_x": _add("camera_place", 0),
    "camera_lever_y": _add("camera_place", 1),
    "camera_lever_z": _add("camera_place", 2),
    "camera_focal": _add("camera_focal"),
    "camera_k1": _add("camera_k1"),
    "camera_center_x": _add("camera_centre", 0),
    "camera_center_y": _add("camera_centre", 1),
    "camera_latency": _add("camera_late"),
    "camera_line_time": _add("camera_row"),
    "keypoint_radius": _add("camera_ball"),
    # Laws outside the catalogue.
    "law_speed_thrust": _add("speed_thrust"),
    "law_slew_thrust": _add("slew_thrust"),
    "law_vehicle_swirl": _add("yaw_swirl"),
    "law_ball_swirl": _add("ball_swirl"),
    "law_joint_square": _add("joint_damping_square"),
    "law_bending": _add("bending"),
    "law_power_drag": _add("power_drag"),
    "law_sink_push": _add("sink_push"),
    # The paper's ablations, as what the plant lacks or has.
    "no_aero": _no_aero,
    "geometric": _geometric,
}
"""What hides in a world: name to a change of its numbers by theta, in SI units (relative for gains
and inertias).
"""


def hide(effects: dict[str, float]) -> SimpleNamespace:
    """Numbers of a world in which these effects are hidden."""
    world = nominal()
    for name, theta in effects.items():
        CHANGES[name](world, theta)
    return world
