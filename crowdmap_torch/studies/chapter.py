"""What a study has to show: tables as CSV, plots as PNG, and both on one page that opens without a network."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.report.html import drawing, note, page_html
from crowdmap_torch.report.plots import write_png
from crowdmap_torch.report.tables_html import simple_table

Cell = str | int | float
"""A cell of a table; NaN is unknown."""


@dataclass(frozen=True)
class Table:
    """Rows under headings; a heading says the unit in brackets."""

    name: str
    """Of its file."""
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""


@dataclass(frozen=True)
class Chapter:
    """A study as it stands: it may have been stopped before all its seeds were done."""

    text: tuple[str, ...] = ()
    """Paragraphs."""
    tables: tuple[Table, ...] = ()
    plots: Mapping[str, Figure] = field(default_factory=dict)
    """By the name of the file."""


def write_chapters(
    out: Path, name: str, title: str, chapters: Sequence[tuple[str, str, Chapter]]
) -> Path:
    """Writes `tables/*.csv`, `plots/*.png` and the page `NAME.html` with all of it; returns the page.

    Each chapter comes with its name and its title.
    """
    for _, _, chapter in chapters:
        for table in chapter.tables:
            _write_csv(out / "tables" / f"{table.name}.csv", table)
        for plot, figure in chapter.plots.items():
            write_png(figure, out / "plots" / f"{plot}.png")
    page = out / f"{name}.html"
    sections = [(anchor, heading, _content(chapter)) for anchor, heading, chapter in chapters]
    subtitle = "Ours beside Dabeer et al., An End-to-End System for Crowdsourced 3d Maps (2017)"
    with atomic_file(page) as beside:
        beside.write_text(page_html(title, subtitle, sections), encoding="utf-8")
    return page


def shown(cell: Cell) -> str:
    """A cell as a person reads it: three or four digits."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return f"{cell:,}"
    if not math.isfinite(cell):
        return "-"
    return f"{cell:.3f}" if abs(cell) < 100 else f"{cell:,.0f}"


def _content(chapter: Chapter) -> str:
    parts = [note(paragraph) for paragraph in chapter.text]
    parts += [drawing(figure) for figure in chapter.plots.values()]
    for table in chapter.tables:
        if table.caption:
            parts.append(f"<h3>{escape(table.caption)}</h3>")
        rows = [[shown(cell) for cell in row] for row in table.rows]
        parts.append(simple_table(table.columns, rows))
    return "".join(parts)


def _write_csv(path: Path, table: Table) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    for row in table.rows:
        unknown = (isinstance(cell, float) and not math.isfinite(cell) for cell in row)
        writer.writerow(["" if u else cell for u, cell in zip(unknown, row, strict=True)])
    with atomic_file(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")
