"""What the commands do: sources, calibrator and recalibrator put together, with progress for a person."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from calib_ros import se3
from calib_ros.config import Config, load_stages
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.tracker import Extrinsic
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search import SearchBox
from calib_ros.result import Result
from calib_ros.sources import frame_positions, initial_extrinsic

NOMINAL_BOX = SearchBox(10.0, 0.5)  # a camera mounted by eye is within this of nominal


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """A bar on a terminal, nothing in a pipe; yields a function that takes what is done, and the total if it is not 1."""
    with tqdm(
        total=1.0,
        desc=label,
        disable=not sys.stderr.isatty(),
        bar_format="{desc} {bar} {percentage:3.0f}% {elapsed}",
        leave=False,
    ) as bar:

        def step(done: float, total: float = 1.0) -> None:
            bar.n = done / total
            bar.refresh()

        yield step


def configuration(path: str | None, seed: int | None = None, objective: str | None = None) -> Config:
    """The configuration of a YAML file, or the defaults; with another seed of the search, or objective, if given."""
    stages = load_stages(path) if path else {}
    for stage, name, value in (("search", "seed", seed), ("refine", "objective", objective)):
        if value is not None and isinstance(stages.get(stage) or {}, dict):
            stages[stage] = {**(stages.get(stage) or {}), name: value}
    return Config.from_dict(stages)


class Selection:
    """Some frames of a source, in the order asked for; a Source itself."""

    def __init__(self, source: Source, positions: list[int]) -> None:
        self._source, self._positions = source, positions
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self._positions)

    def __getitem__(self, index: int) -> Frame:
        return self._source[self._positions[index]]

    def describe(self) -> dict[str, str]:
        """As the source, with the number of frames chosen."""
        return {**self._source.describe(), "frames": str(len(self))}


def calibrate(
    source: Source,
    frames: str,
    initial: str,
    yaw_deg: float,
    config: Config,
    search_deg: float | None,
    search_m: float | None,
    overlay: str | None,
) -> Result:
    """`calib-ros calibrate`; without search limits the box fits where the initial extrinsic comes from."""
    positions = frame_positions(frames, len(source))
    T0 = initial_extrinsic(initial, source, yaw_deg)
    default = NOMINAL_BOX if initial == "nominal" else SearchBox(config.search.rotation_deg, config.search.translation_m)
    box = SearchBox(
        default.rotation_deg if search_deg is None else search_deg,
        default.translation_m if search_m is None else search_m,
    )
    if overlay is not None and not Path(overlay).resolve().parent.is_dir():
        raise BadInputError(f"--overlay {overlay}: the folder does not exist")
    with progress_bar("reading  ") as step:
        chosen = []
        for k, i in enumerate(positions):
            chosen.append(source[i])
            step(k + 1, len(positions))
    with progress_bar("estimating") as step:
        result = Calibrator(chosen[0].camera, config).calibrate(chosen, T0, box, lambda stage, share: step(share))
    reference = chosen[0].reference if chosen[0].reference is not None else source.reference
    error = None
    if reference is not None:
        T = result.T_camera_lidar
        error = (se3.rotation_error_deg(reference, T), se3.translation_error_m(reference, T))
    result = dataclasses.replace(result, camera_frame=source.camera_frame, lidar_frame=source.lidar_frame, reference_error=error)
    if overlay is not None:
        draw(overlay, chosen[len(chosen) // 2], Extrinsic(result), config)
    return result


def draw(path: str | Path, frame: Frame, extrinsic: Extrinsic, config: Config) -> None:
    """Write the before/after picture of a frame with its LiDAR edges; before is where the estimate started. BadInputError if
    `path` cannot be written."""
    from calib_ros.lidar.edge_points import edge_points
    from calib_ros.lidar.scan import range_image
    from calib_ros.overlay import caption, render, write_png

    result = extrinsic.result
    edges = edge_points(range_image(frame.cloud, config.lidar), config.lidar)
    lines = caption(extrinsic, result.frames_used, result.initial)
    picture = render(frame, result.T_camera_lidar, T_before=result.initial, edges=edges, lines=lines, status=result.status)
    write_png(path, picture)


def convert(source: Source, bag: str, frames: str, storage: str) -> str:
    """`calib-ros convert`; returns a line for the user."""
    selection = Selection(source, frame_positions(frames, len(source)))
    with progress_bar("writing") as step:
        path = write_bag(selection, bag, storage, progress=step)
    return f"{len(selection)} frames written to {path}; play them with: calib-ros play {path}"


def replay(source: Source, frames: str, initial: str, yaw_deg: float, config: Config) -> Iterator[dict[str, Any]]:
    """`calib-ros replay`: the result of every estimate, with its keyframes and drift; frames that cannot be used go to stderr."""
    positions = frame_positions(frames, len(source))
    T0 = initial_extrinsic(initial, source, yaw_deg)
    if initial == "nominal":
        wide = dataclasses.replace(config.search, rotation_deg=NOMINAL_BOX.rotation_deg, translation_m=NOMINAL_BOX.translation_m)
        config = dataclasses.replace(config, search=wide)
    recalibrator = Recalibrator(source.camera, T0, config, source.camera_frame, source.lidar_frame)
    with progress_bar("replaying") as step:
        for k, i in enumerate(positions):
            frame = None
            try:
                frame = source[i]
                recalibrator.ingest(frame)
            except CalibrationError as error:
                name = frame.name if frame is not None else f"at position {i}"
                print(f"frame {name}: {error}", file=sys.stderr)
                continue
            step(k + 1, len(positions))
            if recalibrator.ready():
                extrinsic = recalibrator.estimate()
                result = extrinsic.result
                if source.reference is not None:
                    T = result.T_camera_lidar
                    error_now = (se3.rotation_error_deg(source.reference, T), se3.translation_error_m(source.reference, T))
                    result = dataclasses.replace(result, reference_error=error_now)
                yield {
                    "frame": frame.name,
                    "frame_stamp": frame.stamp,
                    "keyframes": len(recalibrator.buffer),
                    "drift": extrinsic.drift,
                    **result.to_dict(),
                }


def steps(source: Source, position: int, initial: str | None, yaw_deg: float, config: Config, out: str, command: str) -> str:
    """`calib-ros steps`: a page with every step of the method for one frame; returns lines for the user.

    initial: None = the reference where there is one, else nominal. command: as it stands on the page.
    """
    import yaml

    from calib_ros import __version__, report
    from calib_ros.evaluation.steps.page import check_folder, write_page
    from calib_ros.evaluation.steps.sequence import EXPECTED, SECTIONS
    from calib_ros.evaluation.steps.sequence import steps as make_steps

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
