"""The command that gives a motor's thrust: its thrust map inverted."""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray


def command_of(thrust_map: Sequence[float], thrust: ndarray) -> ndarray:
    """Return the command at which a map gives a thrust.

    ``thrust_map``: thrust by powers 0, 1, 2 of the command [N]; ``thrust``: [N], of any shape.
    """
    constant, linear, quadratic = thrust_map
    if quadratic == 0.0:
        return (thrust - constant) / linear
    inner = linear**2 - 4.0 * quadratic * (constant - thrust)
    return (-linear + np.sqrt(np.maximum(inner, 0.0))) / (2.0 * quadratic)
