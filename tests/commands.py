"""The command line, run in this process."""

import subprocess
import sys
from collections.abc import Iterable
from typing import Any

from visthrow import cli


def set_words(settings: Iterable[str]) -> list[str]:
    """Return the words of a command that set keys of its configuration."""
    return [word for setting in settings for word in ("--set", setting)]


def run_command(line: str, *words: str, sets: Iterable[str] = ()) -> int:
    """Run a visthrow command, given by its words in one line, by further ones and by the settings
    of its configuration; returns its exit status.
    """
    return cli.main([*line.split(), *words, *set_words(sets)])


def start(line: str, *words: Any, **options: Any) -> subprocess.Popen:
    """Start a visthrow command in a process of its own."""
    command = [sys.executable, "-m", "visthrow.cli", *line.split(), *words]
    return subprocess.Popen(command, text=True, **options)


def run_python(*words: Any, **options: Any) -> subprocess.CompletedProcess:
    """Run another interpreter to its end and keep its output."""
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, **options)
