"""A table of the report, for the terminal, HTML and Markdown alike, and the numbers in it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

NONE = "–"
INFINITE = "∞"


@dataclass(frozen=True)
class Table:
    """rows: as many cells each as the header. notes: sentences below."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """For a terminal, in columns."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.header))]
        left = [self.words(k) for k in range(len(widths))]
        return "\n".join(
            "  ".join(cell.ljust(w) if own else cell.rjust(w) for cell, w, own in zip(line, widths, left, strict=True)).rstrip()
            for line in lines
        )

    def words(self, column: int) -> bool:
        """Whether a column holds words, and so stands to the left."""
        return any(own[column][:1].isalpha() for own in self.rows)


Rows = list[list[str]]


def number(value: float, digits: int) -> str:
    """With a fixed number of digits behind the point."""
    return _text(value, f"{value:.{digits}f}")


def degrees(value: float) -> str:
    """An angle in deg."""
    return number(value, 3)


def centimetres(value: float) -> str:
    """A length in cm."""
    return number(value, 1)


def percent(value: float, digits: int = 0) -> str:
    """A share 0..1."""
    return _text(value, f"{100 * value:.{digits}f} %")


def figures(value: float) -> str:
    """Three significant figures, for what spans orders of magnitude."""
    if not math.isfinite(value) or value == 0:
        return _text(value, "0")
    digits = max(2 - math.floor(math.log10(abs(value)) + 1e-12), 0)
    return f"{value:.{digits}f}" if digits <= 6 else f"{value:.2e}"


def table(title: str, header: Sequence[str], rows: Rows, notes: Sequence[str] = ()) -> Table:
    """A table of such rows."""
    return Table(title, tuple(header), tuple(map(tuple, rows)), tuple(notes))


def _text(value: float, text: str) -> str:
    if math.isnan(value):
        return NONE
    return text if math.isfinite(value) else INFINITE


def as_markdown(one: Table) -> str:
    """A pipe table with its title above and its notes below."""
    lines = [_line([escaped(cell) for cell in one.header]), _line(["---"] * len(one.header))]
    lines += [_line([escaped(cell) for cell in row]) for row in one.rows]
    return "\n\n".join([f"### {escaped(one.title)}", "\n".join(lines), *(escaped(note) for note in one.notes)])


def escaped(text: str) -> str:
    """Text as it is, in one line."""
    return re.sub(r"([\\`*_\[\]<>|])", r"\\\1", " ".join(text.split()))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
