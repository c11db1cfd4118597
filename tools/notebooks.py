"""The notebooks of the tutorials, made from their pages: `python tools/notebooks.py` writes docs/NAME.ipynb of each.

Prose becomes markdown cells, Python blocks become code cells, and bash blocks code cells that begin with %%bash. The output that
a page shows, and blocks that it marks as not run, stay prose. test/integration/test_examples.py runs the cells.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
TUTORIALS = ("tutorial", "tutorial_python")
BLOCK = re.compile(r"^((?:<!--[^>]*-->\n)*) *```(\w*)\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
MARKER = re.compile(r"<!-- ([\w ]+): ([^>]*) -->")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page. line: the number of its first line of text. markers: what comments `<!-- KEY: VALUE -->` directly
    above it say."""

    language: str
    text: str
    line: int
    markers: dict[str, str]


def parts(page: str) -> list[str | Block]:
    """Prose and blocks of a page, in order."""
    out: list[str | Block] = []
    end = 0
    for found in BLOCK.finditer(page):
        line = page.count("\n", 0, found.start(3)) + 1
        out += [page[end : found.start()], Block(found[2], found[3], line, dict(MARKER.findall(found[1])))]
        end = found.end()
    return [*out, page[end:]]


def notebook(page: str) -> str:
    """A page as a notebook's file; of format 4.4, whose cells have no random ids."""
    cells: list[dict[str, Any]] = []
    prose = ""

    def add(kind: str, text: str, **more: Any) -> None:
        if text.strip():
            cells.append({"cell_type": kind, "metadata": {}, "source": text.strip().splitlines(keepends=True), **more})

    for part in parts(page):
        if isinstance(part, str):
            prose += part
        elif part.language not in ("bash", "python") or "not run" in part.markers:
            prose += f"```{part.language}\n{part.text}```"
        else:
            add("markdown", prose)
            prose = ""
            magic = "%%bash --no-raise-error\n" if "exit" in part.markers else "%%bash\n"
            add("code", (magic if part.language == "bash" else "") + part.text, execution_count=None, outputs=[])
    add("markdown", prose)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    whole = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 4}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name in TUTORIALS:
        (DOCS / f"{name}.ipynb").write_text(notebook((DOCS / f"{name}.md").read_text(encoding="utf-8")), encoding="utf-8")
