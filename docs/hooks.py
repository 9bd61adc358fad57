"""MkDocs hooks: pages that print themselves, and a site that reads without a network.

``<!-- help: fly -->`` in a page becomes what `visthrow fly --help` prints, ``<!-- fields:
sim.params -->`` tables of the keys of the module's dataclasses."""

import contextlib
import dataclasses
import importlib
import inspect
import io
import os
import re

from visthrow import cli

os.environ["COLUMNS"] = "88"
HELP, FIELDS = re.compile(r"<!-- help: ([\w ]+) -->"), re.compile(r"<!-- fields: ([\w.]+) -->")
FIELD = re.compile(r"^    (\w+): ([^#\n]+?)(?:  # (.*))?$", re.MULTILINE)
SHIM, OWN_SHIM = "https://unpkg.com/iframe-worker/shim", "assets/iframe-worker.js"
"""What lets the search of a site work that is read from a folder."""


def on_page_markdown(markdown: str, **_) -> str:
    """Fill in help texts and tables of fields."""
    markdown = HELP.sub(lambda place: f"```text\n{help_of(place[1].split())}```", markdown)
    return FIELDS.sub(lambda place: fields_of(place[1]), markdown)


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


def help_of(words: list[str]) -> str:
    """Return the help of a command or of a command's own command."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    return text.getvalue()


def fields_of(module: str) -> str:
    """Return a table of keys for each dataclass of a module: name, type and default, and the
    comment beside it.
    """
    found = importlib.import_module(module)
    classes = [
        c for c in vars(found).values() if dataclasses.is_dataclass(c) and c.__module__ == module
    ]
    return "\n\n".join(
        _table(c) for c in sorted(classes, key=lambda c: inspect.getsourcelines(c)[1])
    )


def _table(cls: type) -> str:
    names = {field.name for field in dataclasses.fields(cls)}
    rows = [
        f"| `{name}` | `{kind.replace('|', chr(0x2223))}` |"
        f" {(said or '').replace('|', chr(0x2223))} |"
        for name, kind, said in FIELD.findall(inspect.getsource(cls))
        if name in names
    ]
    said = inspect.getdoc(cls) or ""
    return "\n".join(
        [
            f"### {cls.__name__}",
            "",
            said,
            "",
            "| key | type, default | what |",
            "|---|---|---|",
            *rows,
        ]
    )
