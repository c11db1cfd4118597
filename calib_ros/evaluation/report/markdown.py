"""The report's tables as Markdown, to be taken over into papers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from calib_ros.evaluation.report.section import Section
from calib_ros.evaluation.report.table import Table


def document(title: str, facts: Mapping[str, str], sections: Sequence[Section], folder: str) -> str:
    """All of the report but its pictures. folder: where its plots lie, beside the text."""
    parts = [f"# {escaped(title)}", "\n".join(f"- {escaped(name)}: {escaped(value)}" for name, value in facts.items())]
    for number, section in enumerate(sections, start=1):
        parts += [f"## {number} {escaped(section.heading)}", escaped(section.introduction)]
        listed = [f"- {escaped(sentence)}" for sentence in section.sentences]
        listed += [f"- **{escaped(name)}**: {escaped(what)}" for name, what, _ in section.methods]
        parts += ["\n".join(listed)] if listed else []
        parts += [table(one) for one in section.tables]
        parts += [f"![{escaped(plot.title)}]({folder}/{plot.name}.png)\n\n{escaped(plot.caption)}" for plot in section.plots]
        parts += [f"{escaped(picture.title)}: {escaped(picture.caption)}" for picture in section.pictures]
    return "\n\n".join(part for part in parts if part) + "\n"


def table(one: Table) -> str:
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
