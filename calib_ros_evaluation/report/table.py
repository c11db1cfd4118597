"""A table of the report, for the terminal, HTML and Markdown alike, and the numbers in it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

NONE = "–"
INFINITE = "∞"
Rows = list[list[str]]


@dataclass(frozen=True)
class Table:
    """rows: as many cells each as the header. notes: sentences below."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def text(self) -> str:
        """For a terminal, in columns."""
        columns = []
        for k, cells in enumerate(zip(self.header, *self.rows, strict=True)):
            width = max(map(len, cells))
            columns.append([cell.ljust(width) if self.words(k) else cell.rjust(width) for cell in cells])
        return "\n".join("  ".join(line).rstrip() for line in zip(*columns, strict=True))

    def words(self, column: int) -> bool:
        """Whether a column holds words, and so stands to the left."""
        return any(own[column][:1].isalpha() for own in self.rows)

    def markdown(self) -> str:
        """A pipe table with its title above and its notes below."""
        lines = [[escaped(cell) for cell in row] for row in (self.header, *self.rows)]
        lines.insert(1, ["---"] * len(self.header))
        piped = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return "\n\n".join([f"### {escaped(self.title)}", piped, *map(escaped, self.notes)])


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


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % interval of a share, 0..1; unlike the textbook's it stays within 0..1 and is right for few trials."""
    found = binomtest(int(successes), int(n)).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def interval(successes: int, n: int) -> str:
    """95 % interval of a share."""
    low, high = wilson(successes, n)
    return f"{100 * low:.0f} to {100 * high:.0f}"


def figures(value: float) -> str:
    """Three significant figures, for what spans orders of magnitude."""
    if not math.isfinite(value) or value == 0:
        return _text(value, "0")
    digits = max(2 - math.floor(math.log10(abs(value)) + 1e-12), 0)
    return f"{value:.{digits}f}" if digits <= 6 else f"{value:.2e}"


def plural(n: int, what: str = "frame") -> str:
    """So many of them."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def _text(value: float, text: str) -> str:
    if math.isnan(value):
        return NONE
    return text if math.isfinite(value) else INFINITE


def escaped(text: str) -> str:
    """Text as it is, in one line."""
    return re.sub(r"([\\`*_\[\]<>|])", r"\\\1", " ".join(text.split()))
