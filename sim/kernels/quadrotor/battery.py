"""Battery: remaining charge, open-circuit voltage and load-dependent sag.

Equations: :class:`sim.params.BatteryParams`.
"""

from typing import Any

import warp as wp


@wp.func
def open_circuit_voltage(p: Any, used: Any):
    """Open-circuit voltage [V] at the fraction of charge used."""
    c = p.battery.ocv
    return c[0] + used * (c[1] + used * (c[2] + used * c[3]))


@wp.func
def battery_sag(p: Any, used: Any, voltage: Any, motor_speed: Any, thrust: Any):
    """Derivatives of the used fraction [1/s] and of the terminal voltage [V/s] under the rotors'
    load.
    """
    power = (
        p.battery.idle_power
        + wp.dot(thrust, motor_speed) * p.thrust.torque_ratio / p.battery.efficiency
    )
    current = power / voltage
    settled = open_circuit_voltage(p, used) - p.battery.resistance * current
    hour = type(voltage)(3600.0)
    return current / (hour * p.battery.capacity), (settled - voltage) / p.battery.time_constant


@wp.func
def battery_ideal(p: Any, used: Any, voltage: Any, motor_speed: Any, thrust: Any):
    """An endless pack at the reference voltage."""
    return used - used, voltage - voltage
