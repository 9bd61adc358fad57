"""Strict conversion of parsed TOML into frozen dataclasses, which keeps the source of every value
for messages.
"""

import dataclasses
import sys
import types
import typing
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Union

from visthrow.common.errors import ConfigError, suggest

NONE_WORD = "none"  # represents None in optional fields, as TOML has no null
# key of the base whose values a file or table overrides: another file, or a table of the same kind
BASE_KEY = "base"


@dataclass
class Leaf:
    """A TOML value that is not a table, with the file or override that set it."""

    value: Any
    source: str


@dataclass
class ConfigTable:
    """A TOML table, with the file that opened it last."""

    source: str
    items: dict[str, "Leaf | ConfigTable"] = field(default_factory=dict)


@cache
def hints(schema: type) -> dict[str, Any]:
    """Return the resolved annotation of each field in a dataclass's constructor."""
    resolved = typing.get_type_hints(schema)
    return {f.name: resolved[f.name] for f in dataclasses.fields(schema) if f.init}


def dataclass_of(annotation: Any) -> type | None:
    """Return the dataclass X of an annotation ``X`` or ``X | None``; None for others."""
    if dataclasses.is_dataclass(annotation) and isinstance(annotation, type):
        return annotation
    options = typing.get_args(annotation) if is_union(annotation) else ()
    classes = [option for option in map(dataclass_of, options) if option is not None]
    return classes[0] if len(classes) == 1 else None


def dict_values(annotation: Any) -> Any:
    """Return the type X of an annotation ``dict[str, X]`` or ``dict[str, X] | None``; None for
    others.
    """
    options = typing.get_args(annotation) if is_union(annotation) else (annotation,)
    types = [typing.get_args(option)[1] for option in options if typing.get_origin(option) is dict]
    return types[0] if len(types) == 1 else None


def is_union(annotation: Any) -> bool:
    """Return whether an annotation is a union, in either spelling."""
    return typing.get_origin(annotation) in (Union, types.UnionType)


def describe(annotation: Any) -> str:
    """Describe an annotation in words for a user of TOML."""
    if annotation is type(None):
        return f'"{NONE_WORD}"'
    if is_union(annotation):
        return " or ".join(describe(option) for option in typing.get_args(annotation))
    origin = typing.get_origin(annotation)
    args = typing.get_args(annotation)
    if origin is Literal:
        return "one of " + ", ".join(repr(arg) for arg in args)
    if origin is tuple:
        if len(args) == 2 and args[1] is Ellipsis:
            return f"a list of {describe(args[0])}"
        if len(set(args)) == 1:
            return f"a list of {len(args)}, each {describe(args[0])}"
        return f"a list of {len(args)} ({', '.join(describe(arg) for arg in args)})"
    if origin is dict:
        return f"a table of {describe(args[1])}"
    if dataclass_of(annotation) is not None:
        return f"a table with the keys {', '.join(hints(annotation))}"
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}
    return names.get(annotation, str(annotation))


def fail(source: str, path: str, problem: str) -> typing.NoReturn:
    """Raise a ConfigError that names the file (or override) and the key path."""
    raise ConfigError(f"{source}: {path or 'top level'}: {problem}")


def build(annotation: Any, node: Leaf | ConfigTable, path: str = "") -> Any:
    """Convert a node of the parsed tree, at a dotted path, to the type of its annotation.

    Raises ConfigError: a key is unknown or missing, or a value has a wrong type.
    """
    if is_union(annotation):
        return _build_union(annotation, node, path)
    schema = dataclass_of(annotation)
    if schema is not None:
        return _build_dataclass(schema, node, path)
    origin = typing.get_origin(annotation)
    args = typing.get_args(annotation)
    if origin is dict:
        if not isinstance(node, ConfigTable):
            _wrong_type(annotation, node, path)
        return {
            key: build(args[1], item, _join(path, key))
            for key, item in _rows(args[1], node, path).items()
        }
    if isinstance(node, ConfigTable):
        _wrong_type(annotation, node, path)
    if origin is tuple:
        return _build_tuple(annotation, node, path)
    if origin is Literal:
        # True == 1: compare the type too, so that a bool never counts as a number
        if not any(type(node.value) is type(arg) and node.value == arg for arg in args):
            _wrong_type(annotation, node, path)
        return node.value
    return _build_scalar(annotation, node, path)


def _build_union(annotation: Any, node: Leaf | ConfigTable, path: str) -> Any:
    options = typing.get_args(annotation)
    if type(None) in options and isinstance(node, Leaf) and node.value == NONE_WORD:
        return None
    options = [option for option in options if option is not type(None)]
    if len(options) == 1:
        return build(options[0], node, path)
    for option in options:
        try:
            return build(option, node, path)
        except ConfigError:
            continue
    _wrong_type(annotation, node, path)


def _build_dataclass(schema: type, node: Leaf | ConfigTable, path: str) -> Any:
    if not isinstance(node, ConfigTable):
        _wrong_type(schema, node, path)
    types_of = hints(schema)
    unset = dataclasses.MISSING
    for key, item in node.items.items():
        if key not in types_of:
            place = _join(path, key)
            raise ConfigError(f"{item.source}: {place}: unknown key; {suggest(key, types_of)}")
    required = [
        f.name
        for f in dataclasses.fields(schema)
        if f.init and f.default is unset and f.default_factory is unset
    ]
    if missing := [name for name in required if name not in node.items]:
        keys = ", ".join(node.items) or "nothing"
        expected = ", ".join(f"{name} ({describe(types_of[name])})" for name in missing)
        fail(node.source, path, f"missing {expected}; given: {keys}")
    values = {key: build(types_of[key], item, _join(path, key)) for key, item in node.items.items()}
    try:
        return schema(**values)
    except (ValueError, ConfigError) as error:
        fail(node.source, path, str(error))


def _rows(annotation: Any, node: ConfigTable, path: str) -> dict[str, Leaf | ConfigTable]:
    """Return the tables of the same kind in a table, each merged over the table that it names as
    its base; a field ``name`` is set to the heading.
    """
    schema = dataclass_of(annotation)
    if schema is None or BASE_KEY in hints(schema):
        return node.items

    def row(key: str, above: tuple[str, ...]) -> Leaf | ConfigTable:
        item = node.items[key]
        if not isinstance(item, ConfigTable):
            return item
        table = ConfigTable(item.source, {k: v for k, v in item.items.items() if k != BASE_KEY})
        if "name" in hints(schema):
            base_name = table.items.get("name")
            if base_name is not None and not (
                isinstance(base_name, Leaf) and base_name.value == key
            ):
                fail(
                    item.source,
                    _join(_join(path, key), "name"),
                    f"got {_describe(base_name)}; expected the heading, {key!r}",
                )
            table.items["name"] = Leaf(key, item.source)
        base = item.items.get(BASE_KEY)
        if base is None:
            return table
        siblings = {k for k, v in node.items.items() if isinstance(v, ConfigTable)} - {key, *above}
        if not isinstance(base, Leaf) or base.value not in siblings:
            value = _describe(base)
            problem = f"got {value}; expected another table; {suggest(value, siblings)}"
            fail(item.source, _join(_join(path, key), BASE_KEY), problem)
        return merge_tables(row(base.value, (key, *above)), table)

    return {key: row(key, ()) for key in node.items}


def _describe(node: Leaf | ConfigTable) -> str:
    return repr(node.value) if isinstance(node, Leaf) else "a table"


def merge_tables(base: ConfigTable, override: ConfigTable) -> ConfigTable:
    """Return ``base`` with values replaced by those of ``override``, table by table."""
    combined = ConfigTable(override.source, dict(base.items))
    for key, item in override.items.items():
        below = combined.items.get(key)
        if isinstance(item, ConfigTable) and isinstance(below, ConfigTable):
            combined.items[key] = merge_tables(below, item)
        else:
            combined.items[key] = item
    return combined


def _build_tuple(annotation: Any, node: Leaf, path: str) -> tuple:
    args = typing.get_args(annotation)
    if not isinstance(node.value, list):
        _wrong_type(annotation, node, path)
    if len(args) == 2 and args[1] is Ellipsis:
        args = (args[0],) * len(node.value)
    if len(args) != len(node.value):
        fail(
            node.source,
            path,
            f"got a list of {len(node.value)}: {node.value!r}; expected {describe(annotation)}",
        )
    items = (as_node(value, node.source) for value in node.value)
    return tuple(build(arg, item, f"{path}[{i}]") for i, (arg, item) in enumerate(zip(args, items)))


def _build_scalar(annotation: Any, node: Leaf, path: str) -> Any:
    value = node.value
    if annotation is float and type(value) in (int, float):
        if not abs(value) <= sys.float_info.max:
            fail(node.source, path, f"got {value}; expected a finite number")
        return float(value)
    if annotation in (int, bool, str) and type(value) is annotation:
        return value
    _wrong_type(annotation, node, path)


def as_node(value: Any, source: str) -> Leaf | ConfigTable:
    """Wrap a parsed TOML value, tables recursively."""
    return as_table(value, source) if isinstance(value, dict) else Leaf(value, source)


def as_table(values: dict[str, Any], source: str) -> ConfigTable:
    """Wrap a parsed TOML table, recursively."""
    return ConfigTable(source, {key: as_node(item, source) for key, item in values.items()})


def _wrong_type(annotation: Any, node: Leaf | ConfigTable, path: str) -> typing.NoReturn:
    table = isinstance(node, ConfigTable)
    if table:
        actual = f"a table with the keys {', '.join(node.items) or '(none)'}"
    else:
        actual = f"{node.value!r} ({type(node.value).__name__})"
    fail(node.source, path, f"got {actual}; expected {describe(annotation)}")


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key
