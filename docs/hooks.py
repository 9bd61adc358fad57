"""MkDocs hooks: pages that print themselves, and a site that reads without a network.

``<!-- help -->`` in a page becomes what each command prints with ``--help``. ``<!-- keys: vehicle
paper -->`` becomes tables of the keys of that configuration, ``<!-- keys: diagnose jugglebot ball
-->`` of one of its tables: unit, bounds, shipped value, meaning, and source."""

import ast
import contextlib
import dataclasses
import inspect
import io
import os
import re
import textwrap
import tomllib
import typing
from pathlib import Path
from typing import Any

from camera import field_bounds
from visthrow import __version__, cli, config
from visthrow.config import kinds, schema

os.environ["COLUMNS"] = "88"
HELP, KEYS = "<!-- help -->", re.compile(r"<!-- keys: (\w+) (\w+) ?(\w*) -->")
ACTION = re.compile(r"^    ([a-z]+)(?:  |$)", re.MULTILINE)
SHIM, OWN_SHIM = "https://unpkg.com/iframe-worker/shim", "assets/iframe-worker.js"
"""What lets the search of a site work that is read from a folder."""


def on_config(config: Any) -> Any:
    """Name version and licence at the foot of every page."""
    config.copyright = f"visthrow {__version__}, MIT licence"
    return config


def on_page_markdown(markdown: str, **_) -> str:
    """Fill in help texts and tables of keys."""
    if HELP in markdown:
        markdown = markdown.replace(HELP, helps())
    return KEYS.sub(lambda place: keys_of(*place.groups()), markdown)


def on_page_content(html: str, **_) -> str:
    """Remove the roles of docstrings, and point a notebook's links at pages of the site."""
    html = re.sub(r":(?:class|func|meth|mod|data|attr|exc):(?=<code>|`|<a)", "", html)
    return re.sub(r'href="([^":]+)\.md(#[^"]*)?"', r'href="\1.html\2"', html)


def on_post_page(output: str, page, **_) -> str:
    """Take the search's script from the site itself."""
    return output.replace(SHIM, "../" * page.url.count("/") + OWN_SHIM)


def on_post_template(output_content: str, **_) -> str:
    """The same for the page that is shown where there is none."""
    return output_content.replace(SHIM, OWN_SHIM)


def helps() -> str:
    """Return the help of every command, and of each action of those that have actions."""
    parts = []
    for command in cli.COMMANDS:
        text = help_of([command])
        listed = text.partition("positional arguments:\n  ACTION")[2].partition("\n\n")[0]
        actions = ACTION.findall(listed)
        pages = {f"{command} {action}": help_of([command, action]) for action in actions}
        pages = pages or {command: text}
        parts += [f"## {name}\n\n```text\n{page}```" for name, page in pages.items()]
    return "\n\n".join(parts)


def help_of(words: list[str]) -> str:
    """Return the help of a command or of a command's own command."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    return text.getvalue()


def keys_of(kind: str, name: str, only: str = "") -> str:
    """Return a table of keys for each TOML table of a shipped configuration, or for one of them."""
    path = config.find(kind, name)
    cls = kinds.schema_of(kind, path.stem)
    values = config.to_dict(config.load(cls, path))
    raw, sources = _read(path)
    tables = list(_tables(cls, values, raw, sources, ""))
    return "\n\n".join(
        text for head, text in tables if not only or re.match(rf"\[+{only}[].]", head)
    )


def _read(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the values that a file and its bases state, and the comment beside each dotted key."""
    text = path.read_text(encoding="utf-8")
    raw, comments, table = tomllib.loads(text), {}, ""
    for line in text.splitlines():
        if found := re.match(r"\[+([\w.]+)\]", line):
            table = found[1] + "."
        elif found := re.match(r"(\w+) = .*?  # (.*)", line):
            comments[table + found[1]] = found[2].strip()
    if "base" in raw and isinstance(raw["base"], str):
        base = path.parent / raw["base"]
        base = base if base.exists() else config.configs_root() / raw["base"]
        below, beside = _read(base)
        return _merge(below, raw), beside | comments
    return raw, comments


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    both = {
        k: v for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)
    }
    return below | above | {key: _merge(below[key], value) for key, value in both.items()}


def _tables(cls: type, values: Any, raw: Any, sources: dict[str, str], head: str):
    """Yield the heading and the text of a table's keys, then of the tables in it."""
    meanings, inner, rows = _comments(cls), [], []
    limits = field_bounds._bounds(cls) if issubclass(cls, field_bounds.BoundedFields) else {}
    for key, annotation in schema.hints(cls).items():
        value = values.get(key) if isinstance(values, dict) else None
        stated = raw.get(key) if isinstance(raw, dict) else None
        part = _part(annotation)
        meaning, unit = meanings.get(key, ""), ""
        if found := re.search(r" ?\[([^\]]+)\]$", meaning):
            meaning, unit = meaning[: found.start()], found[1]
        kind = str(limits[key]) if key in limits else schema.describe(annotation)
        if part is not None:
            many = "[[{}]]" if isinstance(value, list) else "[{}]"
            inner.append((part, value, stated, many.format(f"{head}{key}"), f"{head}{key}."))
            kind, value = "a table", stated if isinstance(stated, str) else "below"
        source = sources.get(head + key, "")
        rows.append([f"`{key}`", unit, kind, f"`{_shorten(value)}`", meaning, source])
    title = f"[{head[:-1]}]" if head else f"{cls.__name__}: top level"
    yield title, _markdown(title, inspect.getdoc(cls) or "", rows)
    for part, value, stated, name, below in inner:
        if isinstance(stated, str):
            continue  # a file of its own, shown as its own kind
        first = value[0] if isinstance(value, list) and value else value
        yield from _tables(part, first, stated, sources, below) if name else ()


def _part(annotation: Any) -> type | None:
    """Return the dataclass of a table, of each table of a list, or of a table of tables."""
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) is tuple and arguments:
        annotation = arguments[0]
    return schema.dataclass_of(schema.dict_values(annotation) or annotation)


def _comments(cls: type) -> dict[str, str]:
    """Return the comment of each field: in the lines of its annotation, or above them."""
    lines = textwrap.dedent(inspect.getsource(cls)).splitlines()
    comments = {}
    for base in cls.__mro__[1:-1]:
        comments |= _comments(base) if dataclasses.is_dataclass(base) else {}
    for node in ast.parse("\n".join(lines)).body[0].body:
        if isinstance(node, ast.AnnAssign):
            beside = [line.partition("# ")[2] for line in lines[node.lineno - 1 : node.end_lineno]]
            above = node.lineno - 1
            while lines[above - 1].strip().startswith("# "):
                above -= 1
            over = [line.strip()[2:] for line in lines[above : node.lineno - 1]]
            comments[node.target.id] = " ".join(filter(None, beside)) or " ".join(over)
    return comments


def _shorten(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) < 60 else text[:57] + "..."


def _markdown(title: str, about: str, rows: list[list[str]]) -> str:
    head = ["key", "unit", "bounds", "shipped value", "meaning", "source of the value"]
    lines = [head, ["---"] * len(head), *rows]
    table = [f"| {' | '.join(part.replace('|', chr(0x2223)) for part in line)} |" for line in lines]
    return "\n".join([f"### `{title}`", "", about, "", *table])
