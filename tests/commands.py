"""The command line, run in this process."""

from visthrow import cli


def run_command(line: str, *words: str) -> int:
    """Run a visthrow command, given by its words in one line and by further ones; returns its exit
    status.
    """
    return cli.main([*line.split(), *words])
