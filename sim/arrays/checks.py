"""Checks of parameters before they reach a kernel, which would only turn a bad one into a bad state."""

import math

from sim.params import AirParams, ReleaseParams, RopeParams, SimParams, VehicleParams


def require_positive(owner: str, **values: float) -> None:
    """Raise ValueError for the first value that is not finite and above zero, naming it."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{owner}.{name} is {value}: expected a finite value above 0")


def require_not_negative(owner: str, **values: float) -> None:
    """Raise ValueError for the first value that is not finite and 0 or more, naming it."""
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{owner}.{name} is {value}: expected a finite value of 0 or more")


def check_vehicle(vehicle: VehicleParams) -> None:
    """Raise ValueError for a vehicle that the equations do not describe."""
    body, rotors, c, cell = vehicle.body, vehicle.rotors, vehicle.controller, vehicle.battery
    require_positive("vehicle.body", mass=body.mass, inertia=min(body.inertia))
    require_positive("vehicle.thrust", k_f=vehicle.thrust.k_f, torque_ratio=vehicle.thrust.torque_ratio)
    require_positive("vehicle.motor", time_constant=vehicle.motor.time_constant)
    if vehicle.motor.kind == "asymmetric":
        require_positive("vehicle.motor", time_constant_down=vehicle.motor.time_constant_down)
    require_positive("vehicle.thrust", gain=min(vehicle.thrust.gain), torque_gain=vehicle.thrust.torque_gain)
    require_positive(
        "vehicle.controller", setpoint_time_constant=c.setpoint_time_constant, gyro_time_constant=c.gyro_time_constant,
        max_thrust=c.max_thrust,
    )
    require_positive(
        "vehicle.battery", capacity=cell.capacity, time_constant=cell.time_constant, efficiency=cell.efficiency,
        reference_voltage=cell.reference_voltage,
    )
    require_not_negative("vehicle.battery", resistance=cell.resistance, idle_power=cell.idle_power)
    require_not_negative("vehicle.controller", min_thrust=c.min_thrust)
    if not c.min_thrust < c.max_thrust:
        raise ValueError(
            f"vehicle.controller.min_thrust is {c.min_thrust} N: expected less than max_thrust {c.max_thrust} N"
        )
    if not (any(rotors.x) and any(rotors.y)) or abs(sum(rotors.spin)) > 0:
        raise ValueError(
            f"rotors at x={rotors.x}, y={rotors.y} with spin {rotors.spin}: expected four rotors spread along x and y, "
            "two turning each way"
        )


def check_rope(rope: RopeParams) -> None:
    """Raise ValueError for a number of segments outside 1 to 64, or masses and lengths that no rope has."""
    if not 1 <= rope.segments <= 64:
        raise ValueError(f"rope of {rope.segments} segments: expected 1 to 64")
    require_positive("rope", length=rope.length, rope_mass=rope.rope_mass, payload_mass=rope.payload_mass)
    require_not_negative("rope", payload_inertia=rope.payload_inertia, payload_offset=rope.payload_offset)
    require_not_negative("rope", joint_damping=rope.joint_damping)
    require_not_negative("rope", payload_drag=rope.payload_drag, mount_damping=rope.mount_damping)
    require_not_negative("rope", swing_damping=rope.swing_damping, downwash=rope.downwash, compliance=rope.compliance)
    for name in ("payload_side", "payload_lift"):
        if not math.isfinite(getattr(rope, name)):
            raise ValueError(f"rope.{name} is {getattr(rope, name)}: expected a finite value")


def check_numerics(sim: SimParams) -> None:
    """Raise ValueError for steps or limits that are not positive."""
    require_positive("sim", control_period=sim.control_period, substep=sim.substep)
    require_positive("sim", gamma=sim.gamma, max_turn=sim.max_turn)


def check_release(release: ReleaseParams) -> None:
    """Raise ValueError for a negative lag or fewer than two samples of the flight."""
    require_not_negative("release", lag=release.lag, rope_tail=release.rope_tail)
    for name, value in (("lag_tension", release.lag_tension), ("kick_w", sum(release.kick_w)), ("kick_along", release.kick_along)):
        if not math.isfinite(value):
            raise ValueError(f"release.{name} is {getattr(release, name)}: expected finite values")
    if release.rope_tail > 1.0:
        raise ValueError(f"release.rope_tail is {release.rope_tail}: expected a share from 0 to 1")
    if release.clearance_samples < 2:
        raise ValueError(f"release.clearance_samples is {release.clearance_samples}: expected 2 or more")


def check_air(air: AirParams) -> None:
    """Raise ValueError for wind or a ground effect that is not finite."""
    for name, value in (("wind_w", sum(air.wind_w)), ("ground_effect", air.ground_effect)):
        if not math.isfinite(value):
            raise ValueError(f"air.{name} is {getattr(air, name)}: expected finite values")
