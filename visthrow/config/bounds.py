"""Bounds of numbers in configurations; what lies outside is a `ConfigError`."""

from camera.field_bounds import (
    Bound,
    BoundedFields,
    NotNegative,
    Positive,
    Share,
    Spread,
    Vector,
)
from visthrow.common.errors import ConfigError

__all__ = ["Bound", "Bounded", "NotNegative", "Positive", "Share", "Spread", "Vector"]


class Bounded(BoundedFields):
    """Base of dataclasses whose annotations state bounds."""

    error = ConfigError
