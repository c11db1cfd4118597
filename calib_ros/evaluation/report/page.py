"""The report of `calib-ros evaluate`: one page that needs no network, its tables as Markdown, its plots as files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.evaluation.report import markdown
from calib_ros.evaluation.report.pictures import Picture, jpeg
from calib_ros.evaluation.report.sections import sections
from calib_ros.evaluation.report.template import TEMPLATE
from calib_ros.evaluation.results import Results
from calib_ros.evaluation.steps.plots import empty_figure
from calib_ros.files import write_atomically

PAGE, TEXT, PLOTS = "report.html", "report.md", "plots"
TITLE = "Camera-LiDAR calibration: methods compared"
PLOT_LINK = re.compile(rf"\]\({PLOTS}/([a-z0-9_]+\.png)\)")


def check_report(folder: Path) -> None:
    """What write_report would find out too late: MissingDependencyError, or BadInputError for a folder where a file is to be."""
    _template()
    empty_figure(1, 1)
    for path in (folder / PAGE, folder / TEXT):
        if path.is_dir():
            raise BadInputError(f"{path} is a folder, where the report is to be; choose another --out")
    if (folder / PLOTS).exists() and not (folder / PLOTS).is_dir():
        raise BadInputError(f"{folder / PLOTS} is a file, where plots are to be; choose another --out")


def write_report(
    folder: Path, results: Results, facts: Mapping[str, str], configuration: str, pictures: Sequence[Picture] = ()
) -> list[Path]:
    """Write report.html, report.md and plots/*.png; returns them, the page first. The same results give the same bytes.

    facts: the page's head. configuration: as YAML. Plots of an earlier report in the folder go. Nothing is written if anything
    cannot be drawn: MissingDependencyError without Jinja2 or matplotlib, BadInputError for a picture that is none, or if the
    folder cannot be written.
    """
    template = _template()
    made = sections(results, pictures)
    page = template.render(title=TITLE, facts=facts, configuration=configuration, sections=made)
    text = markdown.document(TITLE, facts, made, PLOTS)
    before = _plots_of(folder / TEXT)
    files = {folder / PLOTS / f"{plot.name}.png": plot.png for section in made for plot in section.plots}
    # The text last: it names the plots, and so tells a later report which of them to take away.
    files = {folder / PAGE: page.encode(), **files, folder / TEXT: text.encode()}
    for path, data in files.items():
        write_atomically(path, data)
    for path in before:
        if path not in files:
            path.unlink(missing_ok=True)
    return list(files)


def _plots_of(text: Path) -> list[Path]:
    """Those that an earlier report's text names."""
    if not text.is_file():
        return []
    return [text.parent / PLOTS / name for name in PLOT_LINK.findall(text.read_text(encoding="utf-8", errors="replace"))]


def _template() -> Any:
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError:
        raise MissingDependencyError("the page needs Jinja2: pip install jinja2, or apt install python3-jinja2") from None
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"base64": _base64, "jpeg": jpeg}
    return environment.from_string(TEMPLATE)


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
