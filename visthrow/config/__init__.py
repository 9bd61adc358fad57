"""Strict configuration: load TOML files as frozen dataclasses.

A file holds exactly the keys of its schema. It can refer to other files in two ways:

- ``base = "other.toml"`` at its top: this file's values override those of the other file, table by
  table.
- A *string* in place of a table is the path of a file that holds this table.

Paths are looked up first in the folder of the file, then in the configs folder, then among the
shipped configs of the same kind, so that a copy of ``configs/train/vision.toml`` finds its ``base =
"state.toml"`` from any folder. Overrides (``"vehicle.body.mass=0.25"``) come last. ``"none"``
stands for None in an optional field. An integer is a valid float; a bool is never a number. NaN and
infinity are refused.

Among tables of the same kind (``[effects.wind_x]``, ``[effects.wind_y]``) one may refer to another:
with ``base = "wind_x"`` its own values override those of that table. A field ``name`` of such
tables is their heading."""

import dataclasses
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from visthrow.common import toml_text
from visthrow.common.errors import ConfigError, suggest
from visthrow.config import schema as _schema
from visthrow.config.kinds import KINDS, kinds_of
from visthrow.config.schema import (
    BASE_KEY,
    NONE_WORD,
    ConfigTable,
    Leaf,
    dataclass_of,
    merge_tables,
)

T = TypeVar("T")


def load(schema: type[T], path: str | Path, overrides: Iterable[str] = ()) -> T:
    """Load a TOML file into a frozen dataclass.

    Raises ConfigError: a file is missing or not valid TOML, a key is unknown or missing, or a value
    has the wrong type. The message names file, key path, the value, what was expected and what
    exists.

    Args:
        schema: Dataclass to fill.
        path: The file.
        overrides: ``"a.b=3"``: key path and TOML value (a bare word is a string), applied in order
            after includes.

    Returns:
        The filled dataclass.
    """
    return _build(schema, _read(schema, Path(path), ()), overrides)


def loads(schema: type[T], text: str, overrides: Iterable[str] = (), name: str = "(text)") -> T:
    """Load TOML text as :func:`load` does a file; ``name``: name of the text in messages. Paths are
    looked up in the configs folder.
    """
    return _build(schema, _parse(schema, text, name, configs_root(), ()), overrides)


def load_dict(
    schema: type[T], values: dict[str, Any], overrides: Iterable[str] = (), name: str = "(values)"
) -> T:
    """Build a config from nested dictionaries, as from :func:`to_dict`; otherwise like
    :func:`loads`.
    """
    tree = _complete(schema, spell_none(values), name, configs_root(), ())
    return _build(schema, tree, overrides)


def _build(schema: type[T], tree: ConfigTable, overrides: Iterable[str]) -> T:
    overrides = tuple(overrides)
    for override in overrides:
        _override(schema, tree, override)
    try:
        built: T = _schema.build(schema, tree)
    except ConfigError as error:
        if overrides:
            error.args = (f"{error} (with {', '.join(overrides)})",)
        raise
    return built


def configs_root() -> Path:
    """Return the folder of shipped configs, in the installed package or in a checkout.

    Raises ConfigError: neither exists.
    """
    package = Path(__file__).resolve().parents[1]
    for root in (package / "configs", package.parent / "configs"):
        if root.is_dir():
            return root
    raise ConfigError(
        f"no configs folder; expected {package / 'configs'} (installed) or"
        f" {package.parent / 'configs'} (in a checkout)"
    )


def find(kind: str, name: str | Path) -> Path:
    """Find a config by name (``find("vehicle", "paper")``) or by an explicit path.

    The kind is a folder of ``configs``: vehicle, rope, camera, task, train, ... Raises ConfigError:
    there is no such config; the message lists the existing ones."""
    root = configs_root()
    text = str(name)
    if text.endswith(".toml") or "/" in text or "\\" in text:
        for candidate in (Path(text), root / kind / text, root / text):
            if candidate.is_file():
                return candidate
    elif (root / kind / f"{text}.toml").is_file():
        return root / kind / f"{text}.toml"
    if not (root / kind).is_dir():
        raise ConfigError(f"no kind of config '{kind}'; {suggest(kind, KINDS)}")
    local_files = [path.name for path in Path().glob("*.toml")]
    raise ConfigError(
        f"no {kind} config '{text}' (no shipped name, and no TOML file of that name);"
        f" {suggest(text, [*available(kind), *local_files])}"
    )


def available(kind: str) -> list[str]:
    """Return the names of the shipped configs of one kind, sorted."""
    return sorted(path.stem for path in (configs_root() / kind).glob("*.toml"))


def to_dict(config: Any, *, defaults: bool = True) -> dict[str, Any]:
    """Convert a config to nested dictionaries of plain values (tuples become lists), for JSON, TOML
    or a comparison.

    ``defaults``: whether to include fields with default values. Raises TypeError: ``config`` is not
    an instance of a dataclass."""
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"got {config!r}; expected an instance of a dataclass")
    values = {f: getattr(config, f.name) for f in dataclasses.fields(config) if f.init}
    return {
        f.name: _plain(value, defaults)
        for f, value in values.items()
        if defaults or not _is_default(f, value)
    }


def dumps(config: Any) -> str:
    """Return a config as TOML that loads back to an equal config."""
    return toml_text.dumps(spell_none(to_dict(config)))


def _is_default(field: "dataclasses.Field[Any]", value: Any) -> bool:
    if field.default_factory is not dataclasses.MISSING:
        return bool(value == field.default_factory())
    return field.default is not dataclasses.MISSING and bool(value == field.default)


def _plain(value: Any, defaults: bool) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value, defaults=defaults)
    if isinstance(value, dict):
        return {key: _plain(item, defaults) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, defaults) for item in value]
    return value


def spell_none(value: Any) -> Any:
    """Return nested values with None replaced by the word that represents it in TOML."""
    if value is None:
        return NONE_WORD
    if isinstance(value, dict):
        return {key: spell_none(item) for key, item in value.items()}
    return [spell_none(item) for item in value] if isinstance(value, list) else value


def _display_path(path: Path) -> str:
    """Return the path of a file, relative to the working folder if the file is in it."""
    resolved = path.resolve()
    cwd = Path.cwd()
    return str(resolved.relative_to(cwd)) if resolved.is_relative_to(cwd) else str(path)


def _read(schema: type, path: Path, stack: tuple[Path, ...]) -> ConfigTable:
    name = _display_path(path)
    resolved = path.resolve()
    if resolved in stack:
        chain = " -> ".join(_display_path(step) for step in (*stack, resolved))
        raise ConfigError(f"{name}: files include or extend each other in a cycle: {chain}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        files = sorted(p.name for p in path.parent.glob("*.toml")) if path.parent.is_dir() else []
        raise ConfigError(f"{name}: no such file; {suggest(path.name, files)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name}: cannot be read as UTF-8 text: {error}") from None
    return _parse(schema, text, name, path.parent, (*stack, resolved))


def _parse(
    schema: type, text: str, name: str, folder: Path, stack: tuple[Path, ...]
) -> ConfigTable:
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: brackets are nested too deeply") from None
    return _complete(schema, raw, name, folder, stack)


def _complete(
    schema: type, raw: dict[str, Any], name: str, folder: Path, stack: tuple[Path, ...]
) -> ConfigTable:
    """Return parsed TOML with included files inserted, merged over the file that it names as its
    base.
    """
    # if a schema has a field called "base", the word is an ordinary key
    base = raw.pop(BASE_KEY, None) if BASE_KEY not in _schema.hints(schema) else None
    tree = _schema.as_table(raw, name)
    _include(schema, tree, folder, stack, "")
    if base is None:
        return tree
    if not isinstance(base, str):
        _schema.fail(name, BASE_KEY, f"got {base!r}; expected the path of one other file")
    return merge_tables(_read(schema, _lookup(schema, base, folder, name, BASE_KEY), stack), tree)


def _include(
    schema: type, tree: ConfigTable, folder: Path, stack: tuple[Path, ...], path: str
) -> None:
    """Replace each string in place of a table by the content of the file that it names."""
    for key, annotation in _schema.hints(schema).items():
        table_type = dataclass_of(annotation)
        node = tree.items.get(key)
        if table_type is None or node is None:
            continue
        place = f"{path}.{key}" if path else key
        if isinstance(node, ConfigTable):
            _include(table_type, node, folder, stack, place)
        elif _names_file(node, annotation):
            tree.items[key] = _read(
                table_type, _lookup(table_type, node.value, folder, node.source, place), stack
            )


def _lookup(schema: type, name: str, folder: Path, source: str, key: str) -> Path:
    root = configs_root()
    kinds = kinds_of(schema)
    for candidate in dict.fromkeys(
        (folder / name, root / name, *(root / kind / name for kind in kinds))
    ):
        if candidate.is_file():
            return candidate
    shipped = {
        path.relative_to(root).as_posix()
        for kind in kinds or ("**",)
        for path in root.glob(f"{kind}/*.toml")
    }
    # a name without folder and ending, as the command line accepts it
    short = [candidate for candidate in sorted(shipped) if Path(candidate).stem == name]
    meant = f"did you mean '{short[0]}'?" if short else suggest(name, shipped)
    _schema.fail(
        source,
        key,
        f"no file '{name}', neither in {_display_path(folder)} nor under configs; {meant}",
    )


def _override(schema: type, tree: ConfigTable, override: str) -> None:
    source = f"override '{override}'"
    path, equals, text = override.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        raise ConfigError(f"{source}; expected key.path=value, for instance vehicle.body.mass=0.25")
    current: Any = schema
    for depth, key in enumerate(keys):
        place = ".".join(keys[:depth])
        table_type = dataclass_of(current)
        if table_type is not None:
            fields = _schema.hints(table_type)
            if key not in fields:
                _schema.fail(source, place, f"unknown key '{key}'; {suggest(key, fields)}")
            current = fields[key]
        elif (values := _schema.dict_values(current)) is not None:
            current = values
        else:
            _schema.fail(
                source,
                place,
                f"has no keys, so '{key}' cannot be set; expected {_schema.describe(current)}",
            )
        if depth < len(keys) - 1:
            child = tree.items.get(key)
            if not isinstance(child, ConfigTable):
                child = tree.items[key] = ConfigTable(source)
            tree = child
    node = _schema.as_node(_toml_value(text.strip()), source)
    tree.items[keys[-1]] = node
    if (table_type := dataclass_of(current)) is not None and _names_file(node, current):
        tree.items[keys[-1]] = _read(
            table_type, _lookup(table_type, node.value, Path.cwd(), source, ".".join(keys)), ()
        )


def _names_file(node: Leaf | ConfigTable, annotation: Any) -> TypeGuard[Leaf]:
    """Return whether a node in place of a table is a string and thus the path of a file, not the
    word for None.
    """
    none = isinstance(node, Leaf) and node.value == NONE_WORD and _schema.is_union(annotation)
    return isinstance(node, Leaf) and isinstance(node.value, str) and not none


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
