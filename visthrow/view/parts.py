"""What a section is made of, the same for the page and for Markdown."""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

DPI = 150.0  # of pictures


def align(header: Sequence[str], rows: Sequence[Sequence[str]], heads: int | None = None) -> str:
    """Return a table as Markdown, columns aligned: the first ``heads`` columns stand left, all of
    them without it, the others right.
    """
    cells = [header, *rows]
    width = [max(len(row[i]) for row in cells) for i in range(len(header))]
    text_columns = len(header) if heads is None else heads

    def line(row: Sequence[str]) -> str:
        cells = [
            cell.ljust(w) if i < text_columns else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, width))
        ]
        return f"| {' | '.join(cells)} |"

    rules = ["-" * (w + 1) + ("-" if i < text_columns else ":") for i, w in enumerate(width)]
    return "\n".join([line(header), f"|{'|'.join(rules)}|", *map(line, rows)])


@dataclass(frozen=True)
class Text:
    """A paragraph; ``**bold**`` and ``code`` in backticks are marked in both outputs."""

    text: str
    # "plain", "finding": said by the figures; "missing": what is not there; "why": written beside
    # the data
    kind: str = "plain"


@dataclass(frozen=True)
class Grid:
    """A table: every cell is text; the first ``heads`` columns stand left, the others right."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    heads: int = 1

    @classmethod
    def from_rows(
        cls,
        title: str,
        header: str,
        rows: Iterable[Mapping[str, str] | tuple[str, ...]],
        note: str = "",
        heads: int = 1,
    ) -> "Grid | None":
        """Return a table, or None without rows.

        ``header``: headings, with `` | `` between two. ``rows``: cells in their order, or by
        heading, where "-" stands for what a row lacks."""
        names = header.split(" | ")
        cells = []
        for row in rows:
            if isinstance(row, Mapping):
                row = tuple(row.get(name, "-") for name in names)
            cells.append(row)
        if cells:
            return cls(title, tuple(names), tuple(cells), note, heads)
        return None

    def markdown(self) -> str:
        """Text of the table, columns aligned."""
        return f"**{self.title}**\n\n{align(self.header, self.rows, self.heads)}" + (
            f"\n\n{self.note}" if self.note else ""
        )


@dataclass(frozen=True)
class Picture:
    """A figure as PNG; ``name`` is its file beside the Markdown."""

    name: str
    png: bytes
    caption: str


@dataclass(frozen=True)
class Section:
    """A part of the report; ``name`` is its anchor and the stem of its findings."""

    name: str
    title: str
    parts: tuple[Text | Grid | Picture, ...]


Part = Text | Grid | Picture


def section(
    name: str,
    title: str,
    *parts: Part | None,
    missing: Sequence[str] = (),
    head: str = "Not thrown yet",
) -> Section:
    """Return a section of the parts that there are; at its end what is missing."""
    listed = list(filter(None, parts))
    reasons = "; ".join(dict.fromkeys(missing))
    if reasons:
        listed.append(Text(f"{head}: {reasons}.", "missing"))
    return Section(name, title, tuple(listed))


def png_of(figure) -> bytes:
    """Bytes of a matplotlib figure, which is closed."""
    import matplotlib.pyplot as plt

    buffer = io.BytesIO()
    if layout := figure.get_layout_engine():  # done here: for its sake all would be drawn twice
        figure.set_dpi(DPI)
        layout.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(buffer, format="png", dpi=DPI)
    plt.close(figure)
    return buffer.getvalue()
