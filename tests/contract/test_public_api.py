"""The public API is what CONVENTIONS.md says, and all of it is checked for strict types (``make
lint`` runs the checker).
"""

import re
import tomllib
from pathlib import Path

from tests.places import ROOT


def list_modules() -> list[str]:
    """Return the modules of the section "Public API" of CONVENTIONS.md, of its list alone."""
    section = (
        (ROOT / "CONVENTIONS.md")
        .read_text(encoding="utf-8")
        .split("## Public API")[1]
        .split("\n## ")[0]
    )
    return [
        name
        for line in section.splitlines()
        if line.startswith("- ")
        for name in re.findall(r"`([\w.]+)`", line)
    ]


def test_the_checker_is_strict_on_the_whole_public_api():
    mypy = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert mypy["strict"]
    assert sorted(mypy["modules"]) == sorted(list_modules())
    assert len(list_modules()) > 20


def test_no_public_module_silences_the_checker():
    """An ignore of a whole file, or one that does not say which error, would hide what
    comes later.
    """
    for name in list_modules():
        path = ROOT / Path(*name.split("."))
        text = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(
            encoding="utf-8"
        )
        assert not re.search(r"#\s*mypy:|#\s*type:\s*ignore(?!\[)", text), name
