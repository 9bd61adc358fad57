"""Errors of the onboard side that a user can cause and mend."""

from visthrow.common.errors import ConfigError, VisthrowError


class FrameError(ConfigError):
    """The axes, the quaternion order or an offset of a pose source describe no frame."""


class LinkError(VisthrowError):
    """A device string is refused, or its port cannot be opened."""


class SourceError(VisthrowError):
    """A recording cannot be read, or its columns are not what the mapping says."""


class RunError(VisthrowError):
    """A run cannot start, or its folder cannot be replayed."""
