"""Tables of modules, and nested dictionaries as TOML, which the standard library only reads."""

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def tables_beside(module: str, name: str = "") -> dict[str, Any]:
    """Read the TOML file that stands beside a module, by its ``__file__``; of the module's own name
    where none is given.
    """
    path = Path(module).with_suffix(".toml")
    return tomllib.loads((path.parent / name if name else path).read_text(encoding="utf-8"))


def dumps(tree: dict[str, Any]) -> str:
    """Write a nested dictionary as TOML text that ``tomllib.loads`` reads back to equal values:
    plain keys first, then tables.

    Raises ValueError if a value has no TOML form (NaN, infinity, None, other types).
    """
    lines: list[str] = []
    _table(tree, "", lines)
    return "\n".join(lines).strip("\n") + "\n"


def _table(tree: dict[str, Any], path: str, lines: list[str], head: str = "[{}]") -> None:
    tables = {key: value for key, value in tree.items() if _holds_tables(value)}
    plain = {key: value for key, value in tree.items() if key not in tables}
    if path and (plain or not tables):
        lines += ["", head.format(path)]
    lines += [f"{_key(key)} = {_value(value, f'{path}.{key}')}" for key, value in plain.items()]
    for key, value in tables.items():
        place = f"{path}.{_key(key)}" if path else _key(key)
        if isinstance(value, dict):
            _table(value, place, lines)
            continue
        for item in value:
            _table(item, place, lines, "[[{}]]")


def _holds_tables(value: Any) -> bool:
    """Whether a value is a table, or a list of tables each of which holds something plain."""
    if not isinstance(value, list | tuple):
        return isinstance(value, dict)
    flat = (isinstance(item, dict) and not all(map(_holds_tables, item.values())) for item in value)
    return bool(value) and all(flat)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # JSON's escapes are TOML's, except that TOML refuses a bare DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any, path: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float) and math.isfinite(value):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item, path) for item in value) + "]"
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{_key(key)} = {_value(item, path)}" for key, item in value.items())
            + "}"
        )
    where = path.removeprefix(".")
    raise ValueError(
        f"{where}: {value!r} has no TOML form: no string, bool, finite number, list or table"
    )
