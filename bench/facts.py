"""Compare the facts of firmwares with their sources: each row's words must appear on its line.

    python -m bench.facts crazyflie=PATH betaflight=PATH

PATH is a git repository of the firmware, with or without a work tree; rows are read at the tag that
they name.
"""

import subprocess
import sys
from functools import cache

from hil.links.facts import Fact, facts


@cache
def lines(repository: str, version: str, file: str) -> tuple[str, ...]:
    """Return the lines of a file of a version; empty where there is none."""
    command = ["git", "-C", repository, "show", f"{version}:{file}"]
    shown = subprocess.run(command, capture_output=True)
    return tuple(shown.stdout.decode("utf-8", "replace").splitlines())


def stands(fact: Fact, repository: str) -> bool:
    """Return whether the words of a row stand on its line, whatever the spaces."""
    file, _, number = fact.at.rpartition(":")
    cited = lines(repository, fact.version, file)[int(number) - 1 : int(number)]
    return any("".join(fact.text.split()) in "".join(line.split()) for line in cited)


def main() -> int:
    """Compare; 1 where a row is wrong."""
    wrong = checked = 0
    for word in sys.argv[1:]:
        firmware, _, repository = word.partition("=")
        for name, fact in facts(firmware).items():
            checked += 1
            if not stands(fact, repository):
                wrong += 1
                print(f"{firmware} {name}: {fact.text!r} is not at {fact.at} of {fact.version}")
    print(f"{checked - wrong} of {checked} facts stand where their rows say")
    return 1 if wrong or not checked else 0


if __name__ == "__main__":
    sys.exit(main())
