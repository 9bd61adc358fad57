"""Errors of the onboard side that a user can cause and correct."""

from visthrow.common.errors import ConfigError, VisthrowError


class FrameError(ConfigError):
    """The axes, the quaternion order or an offset of a pose source describe no frame."""


class LinkError(VisthrowError):
    """A device string is refused, or its port cannot be opened."""


class SourceError(VisthrowError):
    """A source cannot be opened or read: a recording, a mapping of its columns, a client that is
    missing, a camera without a picture.
    """


class RunError(VisthrowError):
    """A run cannot start, or its folder cannot be replayed."""
