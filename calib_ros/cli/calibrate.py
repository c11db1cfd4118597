"""`calib-ros calibrate` and `calib-ros replay`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.cli.inputs import initial_extrinsic, require_classes, search_box
from calib_ros.cli.output import again, more_frames, motion, note, progress_bar
from calib_ros.config import Config, update
from calib_ros.datasets.source import Source, WithMotion, frame_positions, neighbours
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.io import check_output
from calib_ros.online.coach import need, words
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import AUTO, BY_CLASSES, GUESSES, MOTION, nominal_start
from calib_ros.registration.search.constraints import NOMINAL_BOX, Axes, SearchBox
from calib_ros.result import FRAMES, INITIAL, WIDER, Cause, Extrinsic, RefusalCode, Result


def calibrate(
    source: Source,
    frames: str,
    initial: str,
    yaw_deg: float,
    config: Config,
    search_deg: Axes | None,
    search_m: Axes | None,
    overlay: str | None,
) -> Result:
    """Estimate the extrinsic from frames of a source. See `search_box` for the defaults of search_deg and search_m; a guess from
    motion brings its own."""
    positions = frame_positions(frames, len(source))
    T0 = initial_extrinsic(initial, source, yaw_deg)
    moving = initial in (MOTION, AUTO)
    box = None if moving and search_deg is None and search_m is None else search_box(initial, config, search_deg, search_m)
    require_classes(config, initial)
    if overlay is not None:
        check_output(overlay, "--overlay")
    if initial == "nominal" and not any(config.constraints.limit_m):
        note("the translation is fixed at nominal, which is 0: give a known one by --initial FILE")
    moving_source, chosen = WithMotion(source, config.motion, note, config.lidar.accumulate_s), []
    with progress_bar("reading  ") as step:
        for k, i in enumerate(positions):
            chosen.append(moving_source[i])
            step(k + 1, len(positions))
    calibrator = Calibrator(chosen[0].camera, config)
    # The models of the package wait until there is doubt; a wrong file of the user is to be told at once.
    if initial in BY_CLASSES or not calibrator.classes_in_doubt_only or not config.semantics.of_package:
        for line in calibrator.segmentation.load():
            note(line)
    with progress_bar("estimating") as step:
        start = initial if initial in GUESSES else T0
        consecutive = neighbours(source, positions) if moving else ()
        result = calibrator.calibrate(chosen, start, box, lambda stage, share: step(share), consecutive)
    reference = chosen[0].reference if chosen[0].reference is not None else source.reference
    result = replace(
        result,
        camera_frame=source.camera_frame,
        lidar_frame=source.lidar_frame,
        reference_error=None if reference is None else se3.error(reference, result.T_camera_lidar),
        motion=motion(chosen, config.motion, moving_source.unknown),
    )
    if overlay is not None:
        shown = chosen[len(chosen) // 2]
        if result.refined_camera is not None:
            shown = replace(shown, camera=result.refined_camera.camera)
        draw(overlay, shown, Extrinsic(result), config)
    return result


def next_command(result: Result, source: Source, config: Config, args: argparse.Namespace) -> tuple[str, str]:
    """By which what is wrong with an estimate may be mended, or be looked at, see `again`; empty where none does."""
    wrong, initial = result.cause or result.refusal, args.initial
    if result.converged or wrong is None:
        return "", ""
    if wrong is RefusalCode.WORSE_THAN_START and initial not in ("nominal", *GUESSES):
        return again(args.given, f"--extrinsic {shlex.quote(initial)}", "check")
    if initial == "nominal" and result.cause is None and (source.reference is not None or wrong.options == WIDER):
        return again(args.given, "--initial auto" if source.reference is None else "--initial reference")
    if wrong is Cause.NOT_RECTIFIED and source.camera.said_rectified:
        return again(args.given, "--no-rectified")
    if wrong.options == FRAMES:
        return again(args.given, more_frames(len(result.frame_names), len(source)))
    box, seconds = search_box(initial, config, args.search_deg, args.search_m), result.refusal_figures.get("seconds", 0.0)
    figures = {"deg": min(2 * max(box.reach[0], 1.0), SearchBox.MAX_DEG), "m": min(2 * max(box.reach[1], 0.1), SearchBox.MAX_M)}
    options = wrong.options.format(**figures, seconds=config.motion.time_offset_s + seconds)
    return again(args.given, options, "" if options else "view")


def advice(result: Result, source: Source, config: Config) -> str:
    """What to do about an estimate, in a line: add frames where those given leave a direction open; "" where none do."""
    if result.refusal is not RefusalCode.TOO_UNCERTAIN or (lacking := need(result, config)) is None:
        return ""
    return words(lacking, FeatureExtractor(source.camera, config).camera, result.T_camera_lidar, "add frames that show")


def draw(path: str | Path, frame: Frame, extrinsic: Extrinsic, config: Config) -> None:
    """Write the before/after picture of a frame with its LiDAR edges: before is where the estimate started, and after a refusal
    the optimum that was refused; without one, only the start. BadInputError if `path` cannot be written."""
    from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame
    from calib_ros.lidar.edges import edge_points
    from calib_ros.lidar.range_image import range_image
    from calib_ros.overlay import caption, render, write_png

    result = extrinsic.result
    names, before = ("before", "after"), result.initial
    if result.optimum is not None:
        names, result = ("start", "refused optimum"), replace(result, T_camera_lidar=result.optimum)
    elif not result.converged and before is not None and np.array_equal(before, result.T_camera_lidar):
        before = None
    edges = deskewed_edges(edge_points(range_image(frame.cloud, config.lidar), config.lidar), frame, config.motion)
    lines = caption(replace(extrinsic, result=result), result.frames_used)
    shown = deskewed_frame(frame, config.motion)
    picture = render(shown, result.T_camera_lidar, T_before=before, names=names, edges=edges, lines=lines, status=result.status)
    write_png(path, picture)


def replay(
    source: Source, frames: str, initial: str, yaw_deg: float, config: Config, write_film: Any = None
) -> Iterator[dict[str, Any]]:
    """Run the online recalibrator over a source; yields a JSON object per estimate and per change of status between estimates.
    Unusable frames are noted on stderr. write_film: writes what was known after each frame, source and configuration."""
    positions = frame_positions(frames, len(source))
    T0 = initial_extrinsic(initial, source, yaw_deg)
    if initial == "nominal":
        wide = replace(config.search, rotation_deg=NOMINAL_BOX.reach[0], translation_m=NOMINAL_BOX.reach[1])
        config = replace(config, search=wide)
    start: Result | Transform = T0
    if initial in (MOTION, AUTO):
        raise BadInputError(
            f"--initial {initial} is of calibrate, not of replay: run calib-ros calibrate --initial {initial} --json FILE, and "
            "start from --initial FILE"
        )
    if initial in BY_CLASSES:
        require_classes(config, initial)
        config = update(config, {"initial": {"method": initial}})
        start = nominal_start(yaw_deg)
    # The recalibrator estimates motion from the clouds before, and puts them together; where frames are skipped, they are read.
    if any(b != a + 1 for a, b in pairwise(positions)):
        source = WithMotion(source, config.motion, note, config.lidar.accumulate_s)
        config = update(config, {"lidar": {"accumulate_s": 0.0}})
    recalibrator = Recalibrator(source.camera, start, config, source.camera_frame, source.lidar_frame)
    status = recalibrator.current.result.status
    moments = []
    with progress_bar("replaying") as step:
        for k, i in enumerate(positions):
            frame = None
            try:
                frame = source[i]
                if recalibrator.ingest(frame) and recalibrator.segments_keyframes:
                    for problem in recalibrator.segment_keyframe():
                        note(problem)
            except CalibrationError as error:
                note(f"frame {frame.name if frame is not None else f'at position {i}'}: {error}")
                continue
            step(k + 1, len(positions))
            estimated = recalibrator.ready()
            extrinsic = recalibrator.estimate() if estimated else recalibrator.current
            moments.append((i, extrinsic))
            if not estimated and extrinsic.result.status == status:
                continue
            result, status = extrinsic.result, extrinsic.result.status
            if source.reference is not None:
                result = replace(result, reference_error=se3.error(source.reference, result.T_camera_lidar))
            yield {
                "frame": frame.name,
                "frame_stamp": frame.stamp,
                "estimated": estimated,
                "keyframes": len(recalibrator.keyframes),
                "advice": asdict(recalibrator.advice(extrinsic)),
                "drift": extrinsic.normalised_innovation,
                **result.to_dict(),
            }
    if status == INITIAL:
        note(f"no estimate: {len(recalibrator.keyframes)} of {len(positions)} frames became keyframes; try calib-ros calibrate")
    if recalibrator.motion.missing:
        note(recalibrator.motion.missing)
    if write_film is not None:
        note(write_film(moments, source, config))
