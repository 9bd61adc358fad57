"""Battery: remaining charge, open-circuit voltage and load-dependent sag.

Equations: :class:`sim.params.BatteryParams`.
"""

from typing import Any

import warp as wp


@wp.func
def open_circuit_voltage(p: Any, used: Any):
    """Return the open-circuit voltage [V] at a used fraction of the charge."""
    c = p.battery.ocv
    return c[0] + used * (c[1] + used * (c[2] + used * c[3]))


@wp.func
def battery_sag(p: Any, used: Any, voltage: Any, motor_speed: Any, thrust: Any):
    """Return the derivatives of the used fraction [1/s] and of the terminal voltage [V/s] under the
    rotors' load.
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
    """Return zero derivatives: charge and voltage are constant."""
    return used - used, voltage - voltage
