"""Tables of modules, and nested dictionaries as TOML, which the standard library only reads."""

import tomllib
from pathlib import Path
from typing import Any


def tables_beside(module: str, name: str = "") -> dict[str, Any]:
    """Read the TOML file that stands beside a module, by its ``__file__``; of the module's own name
    where none is given.
    """
    path = Path(module).with_suffix(".toml")
    return tomllib.loads((path.parent / name if name else path).read_text(encoding="utf-8"))


def dumps(tree: dict[str, Any]) -> str:
    """Write a nested dictionary as TOML text that ``tomllib.loads`` reads back to equal values.

    Raises ValueError for a value without a form in TOML, such as None."""
    import tomlkit

    return tomlkit.dumps(tree)
