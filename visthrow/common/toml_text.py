"""Read TOML tables of modules, and write nested dictionaries as TOML."""

import tomllib
from pathlib import Path
from typing import Any


def tables_beside(module: str, name: str = "") -> dict[str, Any]:
    """Read a TOML file in the folder of a module, given by its ``__file__``; default the file with
    the module's name.
    """
    path = Path(module).with_suffix(".toml")
    return tomllib.loads((path.parent / name if name else path).read_text(encoding="utf-8"))


def dumps(tree: dict[str, Any]) -> str:
    """Return a nested dictionary as TOML, which ``tomllib.loads`` reads back to equal values.

    Raises ValueError: TOML cannot represent a value, such as None."""
    import tomlkit

    return tomlkit.dumps(tree)
