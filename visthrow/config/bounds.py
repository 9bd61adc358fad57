"""Bounds of numbers in configurations; what lies outside is a `ConfigError`."""

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
    """Base of dataclasses whose annotations state bounds."""

    error = ConfigError
