"""The quadrotor of the worlds: equations of motion in float64, written for the tests alone.

World frame z up, body frame x forward, y left, z up, quaternions wxyz. The centre of mass may lie
off the frame's origin; positions that are logged are those of the origin. A Warp struct holds one
vehicle's numbers, another one its state."""

import warp as wp

REAL = wp.float64
V3 = wp.vec3d
V4 = wp.vec4d
M3 = wp.mat33d
SINKING = wp.constant(wp.float64(0.3))  # [m/s]
EARTH = 9.81


@wp.struct
class Numbers:
    """What a world's vehicle, rope and payload are.

    SI units; ``believed_`` is what its flight controller assumes.
    """

    mass: REAL
    inertia: V3
    com: V3  # centre of mass off the frame's origin, body frame
    rotor_x: V4
    rotor_y: V4
    rotor_z: REAL
    spin: V4
    rotor_inertia: REAL
    rotor_radius: REAL
    geometric: wp.int32  # 1: plain proportional rate controller
    kp: V3
    ki: V3
    kd: V3
    kf: V3
    integral_limit: V3
    stick_lag: REAL
    gyro_lag: REAL
    geometric_gain: REAL
    thrust_min: REAL
    thrust_max: REAL
    compensation: REAL
    believed_inertia: V3
    believed_x: V4
    believed_y: V4
    believed_kappa: REAL
    believed_thrust: REAL
    lag_up: REAL  # of the motors; 0: none
    lag_down: REAL
    capacity: REAL
    ocv: V4
    resistance: REAL
    sag_lag: REAL
    idle_power: REAL
    efficiency: REAL
    nominal_voltage: REAL
    ideal_battery: wp.int32
    thrust_square: REAL
    thrust_linear: REAL
    per_volt: REAL
    kappa: REAL
    rotor_gain: V4
    drag: V3
    parasitic: REAL
    inflow: REAL
    torque_inflow: REAL
    lift: REAL
    flapping: REAL
    ground: REAL
    wind: V3
    speed_thrust: REAL  # thrust grows with |v_xy| [s/m]: a law outside the catalogue
    slew_thrust: REAL  # thrust grows with the collective's change [s]: likewise
    yaw_swirl: REAL  # side force e_z x v [kg/s]: likewise
    power_drag: REAL  # drag along -|v|^1/2 v [kg/s (s/m)^1/2]: outside the grammar of laws as well
    # force along body z wherever the vehicle sinks faster than SINKING [N]: likewise
    sink_push: REAL
    mount: V3  # from the frame's origin
    length: REAL
    rope_mass: REAL
    ball_mass: REAL
    ball_reach: REAL  # past the rope's end
    ball_inertia: REAL
    joint_damping: REAL
    joint_damping_square: REAL  # [N m s^2]: outside the catalogue
    bending: REAL  # EI [N m^2]
    stretch: REAL  # 1 / EA [1/N]
    rope_drag: REAL  # on the ball, against its velocity across the rope [N s/m]
    ball_drag: REAL  # 1/2 rho C_d A [kg/m]
    ball_side: REAL  # in flight, |v| e_z x v [kg/m]
    ball_lift: REAL  # in flight, |v|^2 upwards across the path [kg/m]
    ball_swirl: REAL  # e_z x v on the ball [N s/m]: outside the catalogue
    jet_push: REAL  # downwash on the ball, along body -z, share of the thrust [-]


@wp.struct
class Body:
    """State of one vehicle; or its time derivative."""

    x: V3  # centre of mass
    q: V4  # wxyz
    v: V3
    w: V3
    spin: V4
    integral: V3
    stick: V3
    gyro: V3
    used: REAL
    volt: REAL


@wp.func
def rotation(q: V4):
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    one = REAL(1.0)
    two = REAL(2.0)
    return M3(
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )


@wp.func
def turn(q: V4, w: V3):
    """Half of q times (0, w)."""
    h = REAL(0.5)
    return V4(
        -h * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]),
        h * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]),
        h * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]),
        h * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]),
    )


@wp.func
def along(b: Body, d: Body, h: REAL):
    out = Body()
    out.x = b.x + h * d.x
    out.q = b.q + h * d.q
    out.v = b.v + h * d.v
    out.w = b.w + h * d.w
    out.spin = b.spin + h * d.spin
    out.integral = b.integral + h * d.integral
    out.stick = b.stick + h * d.stick
    out.gyro = b.gyro + h * d.gyro
    out.used = b.used + h * d.used
    out.volt = b.volt + h * d.volt
    return out


@wp.func
def motor_demand(p: Numbers, b: Body, command: V4, rates: Body):
    """Commanded rotor speeds; fills the derivatives of integral and filters into ``rates``."""
    out = rates
    rate_command = V3(command[1], command[2], command[3])
    mean_x = REAL(0.0)
    mean_y = REAL(0.0)
    for i in range(4):
        mean_x += p.believed_x[i] * p.believed_x[i]
        mean_y += p.believed_y[i] * p.believed_y[i]
    torque = V3()
    limit = p.thrust_max + REAL(0.0)
    ratio = b.volt / p.nominal_voltage
    if p.geometric == 1:
        jw = wp.cw_mul(p.believed_inertia, b.w)
        torque = p.geometric_gain * wp.cw_mul(p.believed_inertia, rate_command - b.w) + wp.cross(
            b.w, jw
        )
    else:
        out.stick = (rate_command - b.stick) / p.stick_lag
        out.gyro = (b.w - b.gyro) / p.gyro_lag
        torque = wp.cw_mul(p.kp, b.stick - b.w) + b.integral
        torque += wp.cw_mul(p.kf, out.stick) - wp.cw_mul(p.kd, out.gyro)
        limit = p.thrust_max * ratio * ratio
    level = V4()
    for i in range(4):
        level[i] = torque[0] * p.believed_y[i] / mean_y - torque[1] * p.believed_x[i] / mean_x
    yaw = torque[2] / (REAL(4.0) * p.believed_kappa)
    f = V4()
    share = REAL(1.0)
    yaw_share = REAL(1.0)
    if p.geometric == 1:
        for i in range(4):
            f[i] = wp.clamp(
                command[0] / REAL(4.0) + level[i] + p.spin[i] * yaw, p.thrust_min, limit
            )
    else:
        room = limit - p.thrust_min
        spread = wp.max(level) - wp.min(level)
        if spread > room:
            share = room / spread
        level = share * level
        # The yaw share moves the rotors of one sense up and the others down; the spread of all four
        # must stay in the room.
        most = REAL(1.0e9)
        least = -REAL(1.0e9)
        for i in range(4):
            for j in range(4):
                if p.spin[i] > REAL(0.0) and p.spin[j] < REAL(0.0):
                    most = wp.min(most, REAL(0.5) * (room - (level[i] - level[j])))
                    least = wp.max(least, -REAL(0.5) * (room - (level[j] - level[i])))
        held = wp.clamp(yaw, least, most)
        if held != yaw:
            yaw_share = wp.max(held / yaw, REAL(0.0))
        for i in range(4):
            f[i] = level[i] + p.spin[i] * held
        base = wp.clamp(command[0] / REAL(4.0), p.thrust_min - wp.min(f), limit - wp.max(f))
        for i in range(4):
            f[i] = wp.max(f[i] + base, REAL(0.0))
        growth = wp.cw_mul(p.ki, b.stick - b.w)
        for i in range(3):
            if growth[i] * b.integral[i] > REAL(0.0):
                kept = share
                if i == 2:
                    kept = yaw_share
                if wp.abs(b.integral[i]) >= p.integral_limit[i]:
                    kept = REAL(0.0)
                growth[i] = growth[i] * kept
        out.integral = growth
    demand = V4()
    scale = REAL(1.0)
    if p.geometric == 0:
        scale = REAL(1.0) + (REAL(1.0) - p.compensation) * (ratio - REAL(1.0))
    for i in range(4):
        demand[i] = wp.sqrt(f[i] / p.believed_thrust) * scale
    return demand, out


@wp.func
def vehicle_load(p: Numbers, b: Body, command: V4, push: V3, twist: V3):
    """Force [N, world] and torque [N m, body] on the vehicle without rope and weight, thrust [N],
    and its inner derivatives.
    """
    d = Body()
    demand, d = motor_demand(p, b, command, d)
    speed = b.spin
    if p.lag_up <= REAL(0.0):
        speed = demand
    else:
        for i in range(4):
            lag = p.lag_up
            if demand[i] < b.spin[i]:
                lag = p.lag_down
            d.spin[i] = (demand[i] - b.spin[i]) / lag
    rot = rotation(b.q)
    air = wp.transpose(rot) * (b.v - p.wind)
    volts = REAL(1.0) + p.per_volt * (b.volt - p.nominal_voltage)
    height = wp.max(b.x[2], p.rotor_radius)
    near = p.rotor_radius / (REAL(4.0) * height)
    cushion = REAL(1.0) + p.ground * (REAL(1.0) / (REAL(1.0) - near * near) - REAL(1.0))
    cushion = cushion * (REAL(1.0) + p.speed_thrust * wp.sqrt(air[0] * air[0] + air[1] * air[1]))
    force = -wp.cw_mul(p.drag, air) - p.parasitic * wp.length(air) * air
    torque = twist
    total = REAL(0.0)
    power = p.idle_power + REAL(0.0)
    momentum = REAL(0.0)
    slew = REAL(0.0)
    for i in range(4):
        thrust = (
            (p.thrust_square * speed[i] * speed[i] + p.thrust_linear * speed[i])
            * volts
            * p.rotor_gain[i]
            * cushion
        )
        slew += REAL(2.0) * p.thrust_square * speed[i] * d.spin[i]
        arm = V3(p.rotor_x[i], p.rotor_y[i], p.rotor_z) - p.com
        hub = air + wp.cross(b.w, arm)
        extra = thrust * (p.lift * (hub[0] * hub[0] + hub[1] * hub[1]) - p.inflow * hub[2])
        drag_torque = p.kappa * thrust * (REAL(1.0) - p.torque_inflow * hub[2])
        torque += wp.cross(arm, V3(REAL(0.0), REAL(0.0), thrust + extra))
        torque += V3(REAL(0.0), REAL(0.0), p.spin[i] * (drag_torque + p.rotor_inertia * d.spin[i]))
        force += V3(REAL(0.0), REAL(0.0), thrust + extra)
        total += thrust
        power += p.kappa * thrust * speed[i] / p.efficiency
        momentum -= p.rotor_inertia * p.spin[i] * speed[i]
    force += V3(REAL(0.0), REAL(0.0), p.slew_thrust * slew)
    force += p.yaw_swirl * V3(-air[1], air[0], REAL(0.0))
    force -= p.power_drag * wp.sqrt(wp.length(air)) * air
    if air[2] < -SINKING:
        force += V3(REAL(0.0), REAL(0.0), p.sink_push)
    torque += p.flapping * total * V3(-air[1], air[0], REAL(0.0))
    torque -= wp.cross(b.w, V3(REAL(0.0), REAL(0.0), momentum))
    if p.ideal_battery == 0:
        amps = power / b.volt
        d.used = amps / (REAL(3600.0) * p.capacity)
        open_volts = p.ocv[0] + b.used * (p.ocv[1] + b.used * (p.ocv[2] + b.used * p.ocv[3]))
        d.volt = (open_volts - p.resistance * amps - b.volt) / p.sag_lag
    return rot * force + push, torque, total, d


@wp.func
def free_motion(p: Numbers, b: Body, force: V3, torque: V3, d: Body):
    """Complete the derivative of a vehicle under a world force without weight and a body torque."""
    out = d
    out.x = b.v
    out.q = turn(b.q, b.w)
    out.v = force / p.mass + V3(REAL(0.0), REAL(0.0), -REAL(EARTH))
    out.w = wp.cw_div(torque - wp.cross(b.w, wp.cw_mul(p.inertia, b.w)), p.inertia)
    return out


@wp.func
def ball_force(p: Numbers, v: V3, rot: M3, thrust: REAL, hanging: wp.int32):
    """Air on the ball [N, world]; the vehicle's jet only while it hangs."""
    air = v - p.wind
    out = -p.ball_drag * wp.length(air) * air + p.ball_swirl * V3(-air[1], air[0], REAL(0.0))
    if hanging == 0:
        level = wp.sqrt(air[0] * air[0] + air[1] * air[1])
        if level > REAL(0.0):
            up = V3(-air[0] * air[2] / level, -air[1] * air[2] / level, level)
            out += wp.length(air) * (
                p.ball_side * V3(-air[1], air[0], REAL(0.0)) + p.ball_lift * up
            )
    if hanging == 1:
        out -= p.jet_push * thrust * (rot * V3(REAL(0.0), REAL(0.0), REAL(1.0)))
    return out
