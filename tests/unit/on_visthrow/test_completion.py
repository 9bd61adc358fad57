"""Shells complete commands, actions and options, each by the script that argcomplete writes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from pytest import mark, skip

BIN = Path(sys.executable).parent

BASH = """
eval "$(register-python-argcomplete visthrow)"
COMP_LINE="$1" COMP_POINT=${#1} COMP_TYPE=9
read -ra COMP_WORDS <<<"$1"
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_python_argcomplete visthrow "${COMP_WORDS[COMP_CWORD]}" ""
printf '%s\\n' "${COMPREPLY[@]}"
"""
FISH = """
register-python-argcomplete --shell fish visthrow | source
complete -C "$argv[1]" | string split --fields 1 \\t
"""
ZSH = """
zmodload zsh/zpty
zpty shell zsh -f -i
zpty -w shell 'autoload -U compinit; compinit -u -D'
zpty -w shell 'eval "$(register-python-argcomplete visthrow)"; print RE""ADY'
zpty -r shell out '*READY*'
zpty -n -w shell "$1"$'\\t'
zpty -r shell out "*$2*"
print -r -- $2
"""
SHELLS = {"bash": ["-c", BASH, "-"], "zsh": ["-c", ZSH, "-"], "fish": ["-c", FISH]}
LINES = {
    "visthrow dia": "diagnose",
    "visthrow hil rep": "replay",
    "visthrow hil run --auto-": "--auto-arm",
    "visthrow camera calibrate --boa": "--board",
}


@mark.parametrize("shell", SHELLS)
@mark.parametrize("line", LINES)
def test_a_shell_completes(shell, line):
    if shutil.which(shell) is None:
        skip(f"{shell} is not installed")
    environment = os.environ | {"PATH": f"{BIN}:{os.environ['PATH']}"}
    out = subprocess.run(
        [shell, *SHELLS[shell], line, LINES[line]],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert out.stdout.split() == [LINES[line]], out
