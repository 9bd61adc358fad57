"""Parts of a section, which the page and Markdown share."""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

DPI = 150.0  # resolution of pictures


def align(header: Sequence[str], rows: Sequence[Sequence[str]], heads: int | None = None) -> str:
    """Return a table as Markdown with aligned columns: the first ``heads`` columns (default all) to
    the left, the others to the right.
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
    # "plain"; "finding": follows from the figures; "missing": names absent data; "why": an
    # explanation
    kind: str = "plain"


@dataclass(frozen=True)
class Grid:
    """A table of text cells; the first ``heads`` columns are aligned left, the others right."""

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

        ``header``: headings, separated by `` | ``. ``rows``: cells in order, or by heading; a
        missing cell becomes "-"."""
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
        """Return the table as Markdown with aligned columns."""
        return f"**{self.title}**\n\n{align(self.header, self.rows, self.heads)}" + (
            f"\n\n{self.note}" if self.note else ""
        )


@dataclass(frozen=True)
class Picture:
    """A figure as PNG; ``name`` is the stem of its file."""

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
    """Return a section of the parts that are not None, with a final sentence on missing data."""
    listed = list(filter(None, parts))
    reasons = "; ".join(dict.fromkeys(missing))
    if reasons:
        listed.append(Text(f"{head}: {reasons}.", "missing"))
    return Section(name, title, tuple(listed))


def png_of(figure) -> bytes:
    """Return a matplotlib figure as PNG and close it."""
    import matplotlib.pyplot as plt

    buffer = io.BytesIO()
    # done here, as savefig would draw everything twice for it
    if layout := figure.get_layout_engine():
        figure.set_dpi(DPI)
        layout.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(buffer, format="png", dpi=DPI)
    plt.close(figure)
    return buffer.getvalue()
