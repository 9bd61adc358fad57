"""What the readers of autopilot logs share: which message of a log speaks of which body, and on which clock."""

import contextlib
import importlib
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

from hil.errors import SourceError
from hil.poses.pose import BODIES, Pose
from visthrow.common.errors import ConfigError, suggest


@dataclass(frozen=True)
class LogBody:
    """The message of one body in an autopilot's log.

    Raises:
        ConfigError: an unknown body, or an instance below 0.
    """

    body: str  # "vehicle", "payload" or "goal"
    message: str  # see hil.sources.dataflash and hil.sources.ulog for those that carry poses
    instance: int = 0  # core of XKF1; instance of a ULog topic
    file: str | None = None  # of a logger of its own, say on the payload; else the source's file
    time_offset: float = 0.0  # added to this log's times [s]: loggers do not share a clock

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise ConfigError(f"body '{self.body}'; {suggest(self.body, BODIES)}")
        if self.instance < 0 or not math.isfinite(self.time_offset):
            raise ConfigError(f"instance {self.instance}, time_offset {self.time_offset}; expected 0 or more, and a time")


def read_logs(
    path: str | Path, bodies: tuple[LogBody, ...], known: tuple[str, ...], read: Callable[[Path, LogBody], list[Pose]],
) -> list[Pose]:  # fmt: skip
    """Poses of all bodies, arrivals counted from the first one.

    Args:
        path: of the source.
        bodies: which message of which file speaks of whom.
        known: messages that the reader makes poses of.
        read: poses of one body in a file, arrivals on the log's clock.

    Raises:
        SourceError: no body, a message that carries no pose, or what ``read`` raises.
    """
    if not bodies:
        raise SourceError(f"source.logs is empty; expected a body and one of the messages {', '.join(known)}")
    poses: list[Pose] = []
    for body in bodies:
        if body.message not in known:
            raise SourceError(f"message '{body.message}' of the {body.body} carries no pose; {suggest(body.message, known)}")
        file = Path(body.file or path)
        found = [replace(pose, arrival=pose.arrival + body.time_offset) for pose in read(file, body)]
        if not found:
            raise SourceError(f"{file}: {body.message} (instance {body.instance}) holds no pose of the {body.body}")
        poses += found
    start = min(pose.arrival for pose in poses)
    return [replace(pose, arrival=pose.arrival - start) for pose in poses]


def load_extra(module: str, extra: str) -> ModuleType:
    """Import an optional package.

    Raises:
        SourceError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise SourceError(
            f"this source needs the package '{module}'; install it with: pip install 'visthrow[{extra}]'"
        ) from None


@contextlib.contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a parser makes of a file that is none of its own into one error, and keep it from printing.

    Raises:
        SourceError: instead of any other exception.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    except SourceError:
        raise
    except Exception as error:  # parsers of binary files raise what comes
        detail = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(f"{path}: cannot be read: {detail}; expected {what}") from error
