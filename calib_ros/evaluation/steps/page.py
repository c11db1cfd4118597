"""The steps as one page: a folder with index.html and the pictures beside it, which needs no network."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.evaluation.steps.page_template import TEMPLATE
from calib_ros.evaluation.steps.step import Step
from calib_ros.files import write_atomically

PAGE = "index.html"
MARK = '<meta name="generator" content="calib-ros steps">'
PICTURE = re.compile(r'<img src="(\d+_[a-z0-9_]+\.png)"')


@dataclass(frozen=True)
class Figure:
    """A step on the page. file: of the picture beside it; empty if there is none. size: its width and height, px."""

    number: int
    step: Step
    file: str
    size: tuple[int, int]


def check_folder(folder: Path) -> None:
    """BadInputError if pictures and page cannot be written there, or an index.html there is somebody else's."""
    standing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    if not standing.is_dir():
        raise BadInputError(f"--out {folder}: {standing} is a file; choose a folder")
    if not os.access(standing, os.W_OK | os.X_OK):
        raise BadInputError(f"--out {folder}: {standing} cannot be written; check its permissions or choose another folder")
    page = folder / PAGE
    if page.exists() and not _is_ours(page):
        raise BadInputError(f"--out {folder} holds an {PAGE} that `calib-ros steps` did not write; choose another folder")


def write_page(
    folder: Path,
    title: str,
    facts: Mapping[str, str],
    configuration: str,
    sections: Mapping[str, tuple[str, str]],
    steps: Iterable[Step],
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write pictures and page once all steps are made; returns the page.

    facts: the page's head. configuration: as YAML. sections: number -> heading and introduction, in the order of the page.
    progress: called with the number of steps made. Pictures of an earlier page in the folder go. Raises what making the steps
    raises, then nothing is written; BadInputError if the folder cannot be used; MissingDependencyError without Jinja2.
    """
    template = _template()
    check_folder(folder)
    figures, pictures = [], {}
    for number, step in enumerate(steps, start=1):
        file, size = "", (0, 0)
        if step.picture is not None:
            file = f"{number:02d}_{re.sub('[^a-z0-9]+', '_', step.name.lower()).strip('_')}.png"
            size = (step.picture.shape[1], step.picture.shape[0])
            pictures[file] = cv2.imencode(".png", step.picture)[1].tobytes()
        figures.append(Figure(number, step, file, size))
        progress(number)
    chapters = [(number, *heading, [f for f in figures if f.step.section == number]) for number, heading in sections.items()]
    page = template.render(title=title, facts=facts, configuration=configuration, chapters=chapters, mark=MARK)
    target = folder / PAGE
    before = PICTURE.findall(target.read_text(encoding="utf-8", errors="replace")) if target.exists() else []
    for file, data in pictures.items():
        write_atomically(folder / file, data)
    write_atomically(target, page.encode())
    for file in before:
        if file not in pictures:
            (folder / file).unlink(missing_ok=True)
    return target


def _is_ours(page: Path) -> bool:
    try:
        return MARK in page.read_text(encoding="utf-8", errors="replace")[:2000]
    except OSError:
        return False


def _template() -> Any:
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError:
        raise MissingDependencyError("the page needs Jinja2: pip install jinja2, or apt install python3-jinja2") from None
    return Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True).from_string(TEMPLATE)
