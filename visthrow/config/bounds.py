"""Bounds of numbers in configurations; a number outside raises `ConfigError`."""

from camera.field_bounds import (
    Bound,
    BoundedFields,
    NotNegative,
    NotNegativeVector,
    Positive,
    Share,
    Vector,
)
from visthrow.common.errors import ConfigError

__all__ = ["Bound", "Bounded", "NotNegative", "NotNegativeVector", "Positive", "Share", "Vector"]


class Bounded(BoundedFields):
    """Base of dataclasses with bounds in their annotations."""

    error = ConfigError
