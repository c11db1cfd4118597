"""`calib-ros steps`."""

from __future__ import annotations

from pathlib import Path

import yaml

from calib_ros import __version__, report
from calib_ros.commands.terminal import progress_bar
from calib_ros.config import Config
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.evaluation.steps.page import check_folder, write_page
from calib_ros.evaluation.steps.sequence import EXPECTED, SECTIONS
from calib_ros.evaluation.steps.sequence import steps as make_steps
from calib_ros.sources import initial_extrinsic


def steps(source: Source, position: int, initial: str | None, yaw_deg: float, config: Config, out: str, command: str) -> str:
    """A page with every step of the method for one frame; returns lines for the user.

    initial: None = the reference where there is one, else nominal. command: as it stands on the page.
    """
    if not 0 <= position < len(source):
        raise BadInputError(f"--frame {position}: position is outside 0..{len(source) - 1} of this source")
    folder = Path(out)
    check_folder(folder)
    frame = source[position]
    reference = source.reference if frame.reference is None else frame.reference
    initial = initial or ("nominal" if reference is None else "reference")
    T = reference if initial == "reference" and reference is not None else initial_extrinsic(initial, source, yaw_deg)
    known = source.describe()
    facts = {
        "Source": known.get("source", f"{source.name}, {known.get('kind', '')}"),
        "Frame": f"{position} of 0..{len(source) - 1}, {frame.name}, {len(frame.cloud)} points",
        "Extrinsic": f"{initial}: {report.pose(T)}",
        "Command": command,
        "Version": f"calib-ros {__version__}",
    }
    settings = yaml.safe_dump(config.to_dict(), sort_keys=False)
    title = f"The method step by step: {source.name}, frame {position}"
    with progress_bar("drawing") as step:
        made = make_steps(frame, T, config)
        page = write_page(folder, title, facts, settings, SECTIONS, made, lambda done: step(min(done, EXPECTED), EXPECTED))
    return f"{page}\nopen it in a browser: {page.resolve().as_uri()}"
