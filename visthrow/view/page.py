"""Write sections as one self-contained HTML page, and as Markdown with separate pictures."""

import base64
import html
import re
from collections.abc import Sequence
from pathlib import Path

from visthrow import __version__
from visthrow.common.storage import atomic_write
from visthrow.view.parts import Grid, Picture, Section, Text
from visthrow.view.templates import render

PAGE = "report.html"
"""File in the folder of a report."""

_BOLD = re.compile(r"\*\*(.+?)\*\*")
LEADS = {"missing": "*Missing.* ", "finding": "- "}
"""Kind of a paragraph -> its prefix in Markdown."""

_CODE = re.compile(r"`(.+?)`")


def _mark_up(text: str) -> str:
    """Return a paragraph as HTML, with bold words and code."""
    return _CODE.sub(r"<code>\1</code>", _BOLD.sub(r"<b>\1</b>", html.escape(text, quote=False)))


def html_of(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return the whole page as HTML that loads no other files."""
    import markupsafe

    return render(
        Path(__file__).with_name("data") / "page.html.j2",
        {"marked": lambda text: markupsafe.Markup(_mark_up(text)), "inline": _inline},
        escape=True,
        title=title,
        lead=lead,
        sections=sections,
        version=__version__,
    )


def _inline(png: bytes) -> str:
    """Return a picture as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def markdown_of(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return the page as Markdown, which refers to the picture files of :func:`write`."""
    lines = [f"# {title}", lead]
    for section in sections:
        lines.append(f"## {section.title}")
        for part in section.parts:
            if isinstance(part, Text):
                lines.append(LEADS.get(part.kind, "") + part.text)
            elif isinstance(part, Grid):
                lines.append(part.markdown())
            else:
                lines.append(f"![{part.caption}]({part.name}.png)\n\n*{part.caption}*")
    return "\n\n".join(lines) + "\n"


def write(folder: Path, title: str, lead: str, sections: Sequence[Section]) -> list[Path]:
    """Write ``report.html``, ``report.md`` and the pictures; return the paths, the page first."""
    paths = [folder / PAGE, folder / "report.md"]
    for section in sections:
        for part in section.parts:
            if isinstance(part, Picture):
                paths.append(folder / f"{part.name}.png")
                atomic_write(paths[-1], part.png)
    atomic_write(paths[1], markdown_of(title, lead, sections))
    atomic_write(paths[0], html_of(title, lead, sections))
    return paths
