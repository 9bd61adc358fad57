"""Errors that a user can cause and correct: a base class, and a subclass for each kind of mistake.

Every message states what came, what was expected and what exists. The command line prints only the
message."""

from collections.abc import Collection, Iterable
from difflib import get_close_matches


class VisthrowError(Exception):
    """Base of all errors that report a user's mistake or a state of the machine that the user can
    change.
    """


class ConfigError(VisthrowError):
    """A configuration file, an override or a name of a configuration is invalid."""


class PolicyError(VisthrowError):
    """A policy file cannot be read or does not describe a policy."""


class MismatchError(PolicyError):
    """A policy was trained under different conditions than the present ones; ``keys``: dotted keys
    of its contract that differ.
    """

    def __init__(self, message: str, keys: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys


class LogError(VisthrowError):
    """A flight log cannot be read or its channels contradict each other."""


class DiagnoseError(VisthrowError):
    """A diagnosis cannot be made from the given data."""


class TrainError(VisthrowError):
    """Training cannot start, continue or resume."""


class CheckpointError(TrainError):
    """A checkpoint is missing, truncated or of another run."""


class BusyError(VisthrowError):
    """Another process is doing the same work."""


class DeviceError(VisthrowError):
    """The requested compute device does not exist."""


class StorageError(VisthrowError):
    """A result could not be written: full disk, no permission, missing folder."""


LONG_LIST = 30
"""Number of names above which only those similar to a misspelt one are listed."""


def suggest(name: str, existing: Iterable[str]) -> str:
    """Return a hint for an unknown name: the existing names and the most similar one, as in
    ``"did you mean 'mass'? Known: inertia, mass"``.
    """
    names = sorted(existing)
    if not names:
        return "nothing is known here"
    close = get_close_matches(name, names, n=1)
    listed = ", ".join(names)
    label = "known"
    if len(names) > LONG_LIST:
        similar = get_close_matches(name, names, n=5)
        if not similar:
            return f"none of the {len(names)} known names is near it"
        listed = f"{', '.join(similar)}; {len(names) - len(similar)} more exist"
        label = "near it"
    if close:
        return f"did you mean '{close[0]}'? {label.capitalize()}: {listed}"
    return f"{label}: {listed}"


def expect_known(
    names: Iterable[str], existing: Collection[str], subject: str, error: type[VisthrowError]
) -> None:
    """Raise ``error`` for the first unknown name; the message consists of ``subject``, with ``{}``
    replaced by the name, and the hint of :func:`suggest`.
    """
    for name in names:
        if name not in existing:
            raise error(f"{subject.format(name)}; {suggest(name, existing)}")
