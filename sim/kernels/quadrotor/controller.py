"""Low-level controller: body-rate command to motor-speed set-points.

Equations: :class:`sim.params.ControllerParams`.
"""

from typing import Any

import warp as wp


@wp.func
def speeds_of_thrusts(p: Any, f: Any):
    """Return the motor speeds [rad/s], shape (4,), of thrusts [N], shape (4,), by the quadratic
    map.
    """
    speed = f
    for i in range(4):
        speed[i] = wp.sqrt(wp.max(f[i], f[i] - f[i]) / p.thrust.k_f)
    return speed


@wp.func
def clip_yaw(p: Any, roll_pitch: Any, yaw: Any, room: Any):
    """Clip the yaw part of a motor's thrust [N] so that the thrusts of all four differ by at most
    ``room`` [N]; ``roll_pitch``: their roll and pitch part [N].
    """
    big = type(yaw)(1.0e6)
    high_plus = -big
    low_plus = big
    high_minus = -big
    low_minus = big
    for i in range(4):
        if p.rotors.spin[i] > yaw - yaw:
            high_plus = wp.max(high_plus, roll_pitch[i])
            low_plus = wp.min(low_plus, roll_pitch[i])
        else:
            high_minus = wp.max(high_minus, roll_pitch[i])
            low_minus = wp.min(low_minus, roll_pitch[i])
    half = type(yaw)(0.5)
    upper = half * (room - (high_plus - low_minus))
    lower = -half * (room - (high_minus - low_plus))
    return wp.clamp(yaw, lower, upper)


@wp.func
def mix(p: Any, collective: Any, torque_b: Any, max_thrust: Any):
    """Distribute thrust [N] and torque [N m] to four rotors. In saturation, yaw is reduced first,
    then the collective thrust, then roll and pitch.

    Returns the thrust of each rotor [N], shape (4,), and the delivered shares of the roll and pitch
    demand and of the yaw demand, 0 to 1."""
    zero = collective - collective
    room = max_thrust - p.controller.min_thrust
    roll_pitch = p.mixer.roll * torque_b[0] + p.mixer.pitch * torque_b[1]
    spread = wp.max(roll_pitch) - wp.min(roll_pitch)
    scale = type(collective)(1.0)
    if spread > room:
        scale = room / spread
    roll_pitch = roll_pitch * scale
    yaw_wanted = p.mixer.yaw[0] * p.rotors.spin[0] * torque_b[2]
    yaw = clip_yaw(p, roll_pitch, yaw_wanted, room)
    share = roll_pitch + p.rotors.spin * yaw
    quarter = collective / type(collective)(4.0)
    base = wp.clamp(quarter, p.controller.min_thrust - wp.min(share), max_thrust - wp.max(share))
    f = share
    for i in range(4):
        f[i] = wp.max(share[i] + base, zero)
    yaw_share = type(collective)(1.0)
    if yaw != yaw_wanted:
        yaw_share = wp.max(yaw / yaw_wanted, zero)
    return f, scale, yaw_share


@wp.func
def rate_controller_betaflight(
    p: Any, command: Any, rate_b: Any, integral: Any, setpoint: Any, gyro: Any, voltage: Any
):
    """Compute a PID law with feed-forward, filtered gyro and smoothed set-point, after Betaflight.

    Returns motor-speed set-points [rad/s], shape (4,), and the derivatives of integral, set-point
    filter and gyro filter."""
    c = p.controller
    rate_command = type(rate_b)(command[1], command[2], command[3])
    setpoint_rate = (rate_command - setpoint) / c.setpoint_time_constant
    gyro_rate = (rate_b - gyro) / c.gyro_time_constant
    error = setpoint - rate_b
    torque = (
        wp.cw_mul(c.p_gain, error)
        + integral
        - wp.cw_mul(c.d_gain, gyro_rate)
        + wp.cw_mul(c.feedforward_gain, setpoint_rate)
    )
    ratio = voltage / p.battery.reference_voltage
    f, share, yaw_share = mix(p, command[0], torque, c.max_thrust * ratio * ratio)
    integral_rate = wp.cw_mul(c.i_gain, error)
    zero = voltage - voltage
    for i in range(3):
        if integral_rate[i] * integral[i] > zero:
            delivered = share
            if i == 2:
                delivered = yaw_share
            if wp.abs(integral[i]) >= c.integral_limit[i]:
                delivered = zero
            integral_rate[i] = integral_rate[i] * delivered
    one = type(voltage)(1.0)
    speed = speeds_of_thrusts(p, f) * (one + (one - c.voltage_compensation) * (ratio - one))
    return speed, integral_rate, setpoint_rate, gyro_rate


@wp.func
def rate_controller_motor_mixing(
    p: Any, command: Any, rate_b: Any, integral: Any, setpoint: Any, gyro: Any, voltage: Any
):
    """Compute a PID law whose output is added to the motor commands, with iterm_relax, as in
    Betaflight's firmware.

    Returns the same values as `rate_controller_betaflight`; the set-point filter is that of
    iterm_relax.
    """
    c = p.controller
    zero = voltage - voltage
    one = type(voltage)(1.0)
    rate_command = type(rate_b)(command[1], command[2], command[3])
    setpoint_rate = (rate_command - setpoint) / c.setpoint_time_constant
    gyro_rate = (rate_b - gyro) / c.gyro_time_constant
    error = rate_command - rate_b - wp.cw_mul(c.gyro_share, gyro - rate_b)
    integral_rate = wp.cw_mul(c.i_gain, error)
    for i in range(3):
        if i < 2:
            integral_rate[i] = integral_rate[i] * wp.max(
                one - wp.abs(rate_command[i] - setpoint[i]) / c.relax_threshold, zero
            )
        if integral_rate[i] * integral[i] > zero and wp.abs(integral[i]) >= c.integral_limit[i]:
            integral_rate[i] = zero
    torque = (
        wp.cw_mul(c.p_gain, error)
        + integral
        - wp.cw_mul(c.d_gain, gyro_rate)
        + wp.cw_mul(c.feedforward_gain, setpoint_rate)
    )
    two = type(voltage)(2.0)
    quarter = type(voltage)(0.25)
    idle = wp.sqrt(c.min_thrust / c.max_thrust)
    share = p.mixer.roll * torque[0] + p.mixer.pitch * torque[1] + p.mixer.yaw * torque[2]
    share = share / (two * wp.sqrt(c.mix_thrust * c.max_thrust))
    spread = wp.max(share) - wp.min(share)
    if spread > one - idle:
        share = share * ((one - idle) / spread)
    base = wp.sqrt(wp.max(command[0], zero) * quarter / c.max_thrust)
    base = wp.clamp(base, idle - wp.min(share), one - wp.max(share))
    full = wp.sqrt(c.max_thrust / p.thrust.k_f)
    full = full * (one + (one - c.voltage_compensation) * (voltage / c.calibration_voltage - one))
    speed = share
    for i in range(4):
        speed[i] = wp.max(share[i] + base, zero) * full
    return speed, integral_rate, setpoint_rate, gyro_rate


@wp.func
def rate_controller_geometric(
    p: Any, command: Any, rate_b: Any, integral: Any, setpoint: Any, gyro: Any, voltage: Any
):
    """Compute a proportional law with the gyroscopic term; each rotor's thrust is clipped on its
    own (the paper's ablation).

    Returns the same values as `rate_controller_betaflight`; the derivatives are zero."""
    rate_command = type(rate_b)(command[1], command[2], command[3])
    momentum = wp.cw_mul(p.body.inertia, rate_b)
    torque = p.controller.geometric_gain * wp.cw_mul(
        p.body.inertia, rate_command - rate_b
    ) + wp.cross(rate_b, momentum)
    f = p.mixer.roll * torque[0] + p.mixer.pitch * torque[1] + p.mixer.yaw * torque[2]
    quarter = command[0] / type(voltage)(4.0)
    for i in range(4):
        f[i] = wp.clamp(f[i] + quarter, p.controller.min_thrust, p.controller.max_thrust)
    zero = rate_b - rate_b
    return speeds_of_thrusts(p, f), zero, zero, zero


@wp.func
def motor_speeds(
    p: Any, command: Any, rate_b: Any, integral: Any, setpoint: Any, gyro: Any, voltage: Any
):
    """Return the command, motor-speed set-points [rad/s], shape (4,), without a controller."""
    zero = rate_b - rate_b
    return command, zero, zero, zero
