"""Records of a study in a CSV file, written as they are made: one that was interrupted goes on where it stopped."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

Record = TypeVar("Record")
PARSE: dict[str, Callable[[str], object]] = {"str": str, "int": int, "float": float, "bool": lambda text: text == "True"}


def read_records(path: Path | None, kind: type[Record]) -> list[Record]:
    """The records of a file, of a dataclass whose fields are text, numbers and bool; none without a file. KeyError for a file
    that lacks a field, ValueError for what is no number. A last line that was cut off is none."""
    if path is None or not path.is_file():
        return []
    parse = {field.name: PARSE[str(field.type)] for field in fields(kind)}  # type: ignore[arg-type]
    lines = csv.DictReader(io.StringIO(path.read_bytes()[: _whole(path)].decode(), newline=""))
    return [kind(**{name: own(line[name]) for name, own in parse.items()}) for line in lines]


def append_records(path: Path | None, records: Sequence[Any]) -> None:
    """Add records of one dataclass to a file, which gets a head if it is new. Without a file they are not kept."""
    if path is None or not records:
        return
    whole = _whole(path)
    with path.open("a", newline="") as file:
        file.truncate(whole)
        writer = csv.DictWriter(file, [field.name for field in fields(records[0])])
        if not whole:
            writer.writeheader()
        writer.writerows(asdict(record) for record in records)


def markdown(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(map(str, cells)) + " |" for cells in (header, ["---"] * len(header), *rows))


def _whole(path: Path) -> int:
    """Bytes of a file up to the end of its last line that was written to the end; 0 without a file."""
    return path.read_bytes().rfind(b"\n") + 1 if path.is_file() else 0
