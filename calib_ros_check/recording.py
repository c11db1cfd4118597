"""The check of one recording: frames of a source, chosen and read, and the extrinsic that it is about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from calib_ros import result
from calib_ros.arrays import Transform
from calib_ros.cli.inputs import bag_options
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.capture import RESULT, capture_config, is_capture
from calib_ros.datasets.open import is_bag
from calib_ros.datasets.source import Source, WithMotion, frame_positions, spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.clocks import with_clocks
from calib_ros.registration.judgement.refusal import joined
from calib_ros.registration.progress import Callback
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import CheckResult, CheckVerdict, Tolerance

REFERENCE, TF = "reference", "tf"
FRAMES = 10  # of a recording, unless said otherwise
OWN = "by {} of {} frames that it was made from, which cannot refute it: name others by --frames"


@dataclass(frozen=True)
class CheckOptions:
    """How recordings are checked.

    extrinsic: ``reference``, what the source says; ``tf``, the static transforms of a bag; or a result file. frames: positions as
    `frame_positions` has them; "" = FRAMES, evenly spread. camera, topics, clock and rectified: as `open_dataset`. config: the
    default is the node's own for what the node has captured. rig: a description of several sensors, "" = one pair; extrinsic
    may be a result of `calib-ros rig` then.
    """

    extrinsic: str = REFERENCE
    tolerance: Tolerance = field(default_factory=Tolerance)
    frames: str = ""
    camera: str | None = None
    image_topic: str | None = None
    points_topic: str | None = None
    camera_info_topic: str | None = None
    clock: str | None = None
    incomplete: bool = False
    config: Config = field(default_factory=Config)
    rig: str = ""
    rectified: bool | None = None


@dataclass(frozen=True, eq=False)
class Checked:
    """A check with what it was made of. source: name of the recording, of `in_all` frames. made: how many the extrinsic is of."""

    result: CheckResult
    frames: Sequence[Frame]
    source: str
    config: Config
    in_all: int
    made: int = 0


def check_source(
    path: str,
    options: CheckOptions | None = None,
    reading: Callable[[float], object] = lambda share: None,
    progress: Callback | None = None,
    warn: Callable[[str], None] | None = None,
) -> Checked:
    """Check the extrinsic of a recording: whatever `open_dataset` opens.

    reading: called with the share of frames that are read. progress: as of `Checker.check`. warn: called with notes for people.
    Raises BadInputError if the source cannot be read, or has no such extrinsic or frames. A frame that cannot be read is left out
    and noted, unless it is the only one.
    """
    options = options or CheckOptions()
    if is_capture(folder := Path(path).expanduser()) and options.config == Config():
        options = replace(options, config=with_clocks(capture_config(folder), result.load(folder / RESULT)))
    source = opened(path, options)
    frames, notes = read_frames(source, positions_of(source, options), options.config, reading, warn)
    T = extrinsic_of(source, path, options.extrinsic, frames[0])
    checker = Checker(frames[0].camera, options.config)
    found = checker.check(frames, T, options.tolerance, progress, getattr(source, "vehicle_frames", None))
    made = {*(() if options.extrinsic in (REFERENCE, TF) else result.load(options.extrinsic).frame_names)}
    own = sum(frame.name in made for frame in frames) if found.verdict is CheckVerdict.PASS else 0
    found = replace(
        found,
        reason=joined([OWN.format(own, len(frames)) if own else "", found.reason]),
        notes=(*getattr(source, "remarks", ()), *notes, *found.notes),
        camera_frame=source.camera_frame,
        lidar_frame=source.lidar_frame,
    )
    return Checked(found, frames, source.name, options.config, len(source), len(made))


def positions_of(source: Source, options: CheckOptions) -> list[int]:
    """Which frames are checked."""
    if options.frames:
        return frame_positions(options.frames, len(source))
    those = getattr(source, "middles", None) or range(len(source))
    return [those[k] for k in spread_positions(FRAMES, len(those))]


def extrinsic_of(source: Source, path: str, extrinsic: str, frame: Frame | None = None) -> Transform:
    """T_camera_lidar (4, 4) that is to be checked; of a frame, where each has its own. BadInputError if there is none."""
    if extrinsic == TF and not is_bag(Path(path).expanduser()):
        raise BadInputError(f"--extrinsic tf: {path} is no bag and has no /tf_static; give reference, or a result file")
    if extrinsic not in (REFERENCE, TF):
        return result.load(extrinsic).T_camera_lidar
    if source.reference is not None:
        return source.reference if frame is None or frame.reference is None else frame.reference
    if is_bag(Path(path).expanduser()):
        raise BadInputError(
            f"{path}: no /tf_static connects {source.camera_frame or 'the camera'} and {source.lidar_frame or 'the LiDAR'}; give "
            "the extrinsic by --extrinsic FILE"
        )
    raise BadInputError(f"{path} has no extrinsic to check; give one by --extrinsic FILE")


def opened(path: str, options: CheckOptions) -> Source:
    """The source, images and clouds of a bag paired as the node does it; of a bag no more than the frames need is read."""
    given = bag_options(options)
    captured = is_capture(Path(path).expanduser())
    if captured or is_bag(Path(path).expanduser()):
        given |= {"motion": options.config.motion, "tolerance_s": options.config.online.pair_tolerance_s}
        given |= {} if options.frames or captured else {"windows": FRAMES}
        if options.extrinsic not in (REFERENCE, TF):
            given["T_camera_lidar"] = result.load(options.extrinsic).T_camera_lidar
    return open_dataset(path, camera=options.camera, **given)


def read_frames(
    source: Source,
    positions: Sequence[int],
    config: Config,
    reading: Callable[[float], object],
    warn: Callable[[str], None] | None,
) -> tuple[list[Frame], list[str]]:
    """Frames of one camera at positions, with the vehicle's motion, and notes on those that were left out. BadInputError if all
    were."""
    moving = WithMotion(source, config.motion, warn, config.lidar.accumulate_s)
    frames: list[Frame] = []
    notes: list[str] = []
    for k, position in enumerate(positions):
        try:
            frame = moving[position]
            if frames and frame.camera != frames[0].camera:
                raise BadInputError("it carries another camera calibration than the first frame")
            frames.append(frame)
        except CalibrationError as error:
            notes.append(f"frame at position {position} left out: {error}")
        reading((k + 1) / len(positions))
    if not frames:
        raise BadInputError(notes[0] if notes else "the source has no frames")
    return frames, notes
