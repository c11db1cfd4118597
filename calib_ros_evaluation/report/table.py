"""A table of the report, for the terminal, HTML and Markdown alike, and the cells that it is made of."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

NONE = "–"
INFINITE = "∞"


@dataclass(frozen=True)
class Table:
    """rows: as many cells each as the header. best: (row, column) of cells in bold. notes: sentences below."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """For a terminal, in columns."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.header))]
        left = ["text" in self.css_classes(-1, k) for k in range(len(widths))]
        return "\n".join(
            "  ".join(cell.ljust(w) if own else cell.rjust(w) for cell, w, own in zip(line, widths, left, strict=True)).rstrip()
            for line in lines
        )

    def css_classes(self, row: int, column: int) -> str:
        """Classes of a cell in HTML; row -1 is the header. A column that holds words stands to the left."""
        words = any(own[column][:1].isalpha() for own in self.rows)
        return " ".join(["text"] * words + ["best"] * ((row, column) in self.best))


@dataclass(frozen=True)
class Cell:
    """text: as shown. value: by which it is compared with others of its column; NaN = not at all."""

    text: str
    value: float = math.nan


Rows = list[list[Cell | str]]


def number(value: float, digits: int) -> Cell:
    """With a fixed number of digits behind the point."""
    return Cell(_text(value, f"{value:.{digits}f}"), value)


def degrees(value: float) -> Cell:
    """An angle in deg."""
    return number(value, 3)


def centimetres(value: float) -> Cell:
    """A length in cm."""
    return number(value, 1)


def percent(value: float) -> Cell:
    """A share 0..1."""
    return Cell(_text(value, f"{100 * value:.0f} %"), value)


def figures(value: float) -> Cell:
    """Three significant figures, for what spans orders of magnitude."""
    if not math.isfinite(value) or value == 0:
        return Cell(_text(value, "0"), value)
    digits = max(2 - math.floor(math.log10(abs(value)) + 1e-12), 0)
    return Cell(f"{value:.{digits}f}" if digits <= 6 else f"{value:.2e}", value)


def table(
    title: str,
    header: Sequence[str],
    rows: Rows,
    better: Mapping[int, str] | None = None,
    groups: Sequence[str] | None = None,
    notes: Sequence[str] = (),
) -> Table:
    """better: column -> "low" or "high", where the best cells get bold. groups: one name per row, rows compete within a group
    only and "" with none; without, all compete. Cells with the same digits as the best are bold, too."""
    cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
    groups = ["all"] * len(cells) if groups is None else groups
    best: set[tuple[int, int]] = set()
    for group in dict.fromkeys(g for g in groups if g):
        competing = [k for k, own in enumerate(groups) if own == group]
        for column, way in (better or {}).items():
            best |= {(competing[k], column) for k in winners([cells[k][column] for k in competing], way)}
    texts = tuple(tuple(cell.text for cell in row) for row in cells)
    return Table(title, tuple(header), texts, frozenset(best), tuple(notes))


def winners(cells: Sequence[Cell], better: str) -> list[int]:
    """Positions of the best among cells; none if fewer than two can be compared. better: "low" or "high"."""
    valued = [cell for cell in cells if math.isfinite(cell.value)]
    if len([cell for cell in cells if not math.isnan(cell.value)]) < 2 or not valued:
        return []
    text = (min if better == "low" else max)(valued, key=lambda cell: cell.value).text
    return [k for k, cell in enumerate(cells) if cell.text == text]


def _text(value: float, text: str) -> str:
    if math.isnan(value):
        return NONE
    return text if math.isfinite(value) else INFINITE


def as_markdown(one: Table) -> str:
    """A pipe table with its title above and its notes below."""
    lines = [_line([escaped(cell) for cell in one.header]), _line(["---"] * len(one.header))]
    for r, row in enumerate(one.rows):
        cells = [escaped(cell) for cell in row]
        lines.append(_line([f"**{cell}**" if (r, c) in one.best else cell for c, cell in enumerate(cells)]))
    return "\n\n".join([f"### {escaped(one.title)}", "\n".join(lines), *(escaped(note) for note in one.notes)])


def escaped(text: str) -> str:
    """Text as it is, in one line."""
    return re.sub(r"([\\`*_\[\]<>|])", r"\\\1", " ".join(text.split()))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
