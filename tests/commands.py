"""The command line, run in this process."""

from collections.abc import Iterable

from visthrow import cli


def set_words(settings: Iterable[str]) -> list[str]:
    """Return the words of a command that set keys of its configuration."""
    return [word for setting in settings for word in ("--set", setting)]


def run_command(line: str, *words: str, sets: Iterable[str] = ()) -> int:
    """Run a visthrow command, given by its words in one line, by further ones and by the settings
    of its configuration; returns its exit status.
    """
    return cli.main([*line.split(), *words, *set_words(sets)])
