"""Bounds of numbers in configurations; what lies outside is a `ConfigError`."""

from camera.bounds import Bound, NotNegative, Positive, Share
from camera.bounds import Bounded as _Bounded
from visthrow.common.errors import ConfigError

__all__ = ["Bound", "Bounded", "NotNegative", "Positive", "Share"]


class Bounded(_Bounded):
    """Base of dataclasses whose annotations state bounds."""

    error = ConfigError
