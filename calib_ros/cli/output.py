"""What the commands print: results, sources, progress, notes."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from calib_ros import extensions, se3
from calib_ros.config import MotionConfig
from calib_ros.datasets.source import Source, spread_positions
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, RADIAL, RefinedCamera
from calib_ros.io import AsJson, check_output
from calib_ros.lidar.deskew import used_twist
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.judgement.refusal import lines_of, stamped
from calib_ros.result import Result

LINE, MANY_FRAMES, ALIKE = 100, 20, 0.5  # characters; frames of a source that are enough; share of frames that differ
CHECKED_BY = 10  # frames, as many as a check takes unless said otherwise
DISAGREEING = 1.774  # of halves of the edges: more than one of ten right extrinsics, by chi^2 of six unknowns
FLAGS = ("--rectified", "--no-rectified", "--incomplete", "--rotation-only")  # options without a value
WRITES = ("--json", "--overlay", "--report", "--camera-info")
TOPICS = ("--image-topic", "--points-topic", "--camera-info-topic")
OF_SOURCE = ("--camera", *TOPICS, "--clock", "--rectified", "--no-rectified", "--incomplete", "--frames", "--config")


def describe(source: Source) -> str:
    """What `calib-ros info` prints."""
    facts = {"source": source.name, **source.describe()}
    width = max(len(key) for key in facts)
    lines = [f"{key:<{width}}  {value}" for key, value in facts.items()]
    if source.reference is not None:
        lines.append(f"{'reference':<{width}}  {pose(source.reference)}")
    return "\n".join(lines)


def pose(T: NDArray[np.float64]) -> str:
    """Translation, and rotation against nominal, in a line: Euler angles of an optical frame sit at gimbal lock."""
    x, y, z = T[:3, 3]
    rx, ry, rz = np.rad2deg(se3.log(T @ se3.inverse(nominal()))[:3])
    return f"x {x:.3f} y {y:.3f} z {z:.3f} m, looking along the LiDAR's +x but for rx {rx:.2f} ry {ry:.2f} rz {rz:.2f} deg"


def motion(frames: Sequence[Frame], config: MotionConfig, unknown: str = "") -> str:
    """How the motion of the vehicle was compensated, in one line. unknown: why it is, where it is not known."""
    if config.deskew == "off":
        return "points stay where they were measured (motion.deskew: off)"
    speeds = [float(np.linalg.norm(twist[3:])) for f in frames if (twist := used_twist(f, config)) is not None]
    if speeds:
        offset = f", time offset {1000 * config.time_offset_s:g} ms" if config.time_offset_s else ""
        where = "all" if len(speeds) == len(frames) else f"{len(speeds)} of {len(frames)}"
        offset += f"; not in others: {unknown}" if where != "all" and unknown else ""
        return f"points moved to the moment of the image in {where} frames, {min(speeds):.1f} to {max(speeds):.1f} m/s{offset}"
    unused = "; the time offset has no effect" if config.time_offset_s else ""
    if all(f.compensated for f in frames):
        return f"the source's clouds are compensated already{unused}"
    return f"points stay where they were measured (1 cm per ms at 10 m/s): {unknown or 'no velocity is known'}{unused}"


def again(given: Sequence[str], options: str, command: str = "") -> tuple[str, str]:
    """The command line that was given, without what it writes, with these options instead of its own, or another command about
    the same source: in short, and whole. Empty where there is nothing to change."""
    words, kept, rest = shlex.split(options), [command or given[0]], list(given[1:])
    if not words and not command:
        return "", ""
    while rest:
        word = rest.pop(0)
        name, is_option = word.partition("=")[0], word.startswith("--")
        own = [word] if "=" in word or not is_option or name in FLAGS or not rest else [word, rest.pop(0)]
        dropped = name in (*words, *WRITES) or (command and is_option and name not in OF_SOURCE)
        kept += [] if dropped else own
    return f"calib-ros {kept[0]} ... {options}" if words else "", shlex.join(["calib-ros", *kept, *words])


def more_frames(used: int, of_all: int) -> str:
    """The option for some more frames of a source; "" if it has none."""
    if used >= min(of_all, MANY_FRAMES):
        return ""
    return "--frames all" if of_all <= MANY_FRAMES else f"--frames 0:{of_all}:{-(-of_all // MANY_FRAMES)}"


def checked_by(given: Sequence[str], path: str | None, positions: Sequence[int], count: int) -> str:
    """How the others of `count` frames can judge what was made of those at `positions`. given: as of `again`; path: of --json."""
    rest, unsaved = sorted({*range(count)} - {*positions}), "" if path else "not saved: --json FILE writes it; "
    if not rest:
        return f"{unsaved}judge it by another drive, or by frames that are left out, as by --frames ::2: calib-ros check"
    others, file = ",".join(str(rest[k]) for k in spread_positions(CHECKED_BY, len(rest))), shlex.quote(path or "FILE")
    return f"{unsaved}judged by other frames: {again(given, f'--extrinsic {file} --frames {others}', 'check')[1]}"


def first_lines(status: str, reason: str, command: tuple[str, str] = ("", "")) -> list[str]:
    """A status with its reason: in a line what is wrong and what to do, by a command if there is room for it; then the command
    whole, and the rest of the reason, a part a line. command: of `again`."""
    (first, *rest), (short, whole) = lines_of(reason) or [""], command
    wrong = f"{status}: {first.partition(': ')[0]}: "
    told = next((own for own in (whole, short) if short and len(wrong + own) <= LINE), "")
    line = wrong + told if told else ": ".join(filter(None, [status, first]))
    return [line, *([f"next: {whole}"] if whole not in ("", told) else []), *rest]


def summary(result: Result, advice: str = "", command: tuple[str, str] = ("", ""), initial: str = "nominal") -> str:
    """What `calib-ros calibrate` prints. advice: what to add. command: of `again`. initial: as of --initial."""
    score = f"score {result.score:.3f}, " if np.isfinite(result.score) else ""
    scenes, halves = (result.evidence.scenes, result.evidence.disagreement) if result.evidence else (0.0, 1.0)
    alike = f" of about {scenes:.1f} different scenes" if 0 < scenes < ALIKE * result.frames_used else ""
    figures = f"{result.frames_used} frames{alike}, {score}{result.elapsed_s:.1f} s"
    if result.converged:
        doubt = "; halves of the edges disagree: add frames of other scenes" if halves > DISAGREEING else ""
        lines = [f"{result.status}: {figures}{doubt}", *lines_of(result.reason)]
    else:
        lines = [*first_lines(result.status, result.reason, command), figures]
    lines += [f"advice: {advice}"] if advice else []
    named = f"T_{result.camera_frame}_{result.lidar_frame}" + ", the start" * (not result.converged)
    lines += [f"{named}  {pose(result.T_camera_lidar)}"]
    for lens, C in (("exact", result.covariance), ("as usual (camera.focal_sigma)", result.covariance_with_intrinsics)):
        if C is not None:
            rx, ry, rz, x, y, z = np.sqrt(np.diag(C)) * ([np.rad2deg(1.0)] * 3 + [100.0] * 3)
            lines.append(
                f"1 sigma if the intrinsics are {lens}: rx {rx:.2f} ry {ry:.2f} rz {rz:.2f} deg, x {x:.1f} y {y:.1f} z {z:.1f} cm"
            )
    if result.refined_camera is not None:
        lines.append(refined_words(result.refined_camera))
    if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
        lines.append(_clocks(result))
    if result.initial is not None and result.converged:
        deg, m = se3.error(result.initial, result.T_camera_lidar)
        lines.append(f"moved {deg:.2f} deg, {100 * m:.1f} cm from the start, --initial {initial}")
    if result.reference_error is not None:
        deg, m = result.reference_error
        lines.append(f"against the source's reference: {deg:.3f} deg, {100 * m:.1f} cm")
    lines += _details(result)
    if not result.converged:
        return "\n".join(lines)  # nobody is to publish the start
    from calib_ros.export import tf_command  # with what XML brings along

    lines += [tf_command({(result.camera_frame, result.lidar_frame): result.T_camera_lidar}, "{:.6f}".format).rstrip()]
    return "\n".join(lines)


def refined_words(refined: RefinedCamera) -> str:
    """The corrected intrinsics, and by how much each differs from the given one."""
    K, changes, parts = refined.camera.K, refined.changes, []
    for name, change in changes.items():
        if name == FOCAL:
            parts.append(f"fx {K[0, 0]:.1f} fy {K[1, 1]:.1f} px ({change.value:+.2%}, 1 sigma {change.sigma:.2%})")
        elif name == ASPECT:
            parts.append(f"fy against fx {change.value:+.2%}, 1 sigma {change.sigma:.2%}")
        elif name == RADIAL:
            parts.append(f"k1 {next(iter(refined.camera.D), 0.0):.4f} ({change.value:+.4f}, 1 sigma {change.sigma:.4f})")
        else:
            axis = CENTRE.index(name)
            parts.append(f"c{'xy'[axis]} {K[axis, 2]:.1f} px ({change.value:+.1f}, 1 sigma {change.sigma:.1f})")
    if not any(change.value for change in changes.values()):
        return f"intrinsics: nothing to correct, kept as given: {', '.join(parts)}"
    return f"refined intrinsics: {', '.join(parts)}; the extrinsic belongs to them"


def _clocks(result: Result) -> str:
    """What the time offset is, and what to do about it if there clearly is one."""
    seconds, sigma_s = result.time_offset_s or 0.0, result.time_offset_sigma_s or 0.0
    text = f"time offset {1000 * seconds:+.1f} ms, 1 sigma {1000 * sigma_s:.1f} ms"
    if result.stamping is not None:
        from calib_ros.registration.joint import convention

        found, left = convention(result.stamping, seconds, MotionConfig.scan_period_s)
        return f"{text}; scans are stamped otherwise than configured: set {found}, motion.time_offset_s: {left:.4f}"
    if abs(seconds) <= 2 * sigma_s:
        return text
    return f"{text}: {stamped(seconds)}; set motion.time_offset_s: {seconds:.4f} for this extrinsic, or mend the driver"


def _details(result: Result) -> list[str]:
    """Agreement of the search, outlier frames, motion."""
    lines = ["search: {} of {} independent starts ended here".format(*result.starts)] if result.starts else []
    if result.evidence is not None:
        lines.append(f"halves of the edges disagree by {result.evidence.disagreement:.1f}, 1 is as expected")
    scores = dict(zip(result.frame_names, result.frame_scores, strict=False))
    kept = [s for name, s in scores.items() if name not in result.frames_left_out and np.isfinite(s)]
    usual = float(np.median(kept)) if kept else np.nan
    lines += [f"left out: {', '.join(result.frames_left_out)}"] if result.frames_left_out else []
    for name, score in scores.items():
        if name not in result.frames_left_out and not score >= 0.5 * usual:  # NaN too
            text = f"score {score:.3f}" if np.isfinite(score) else "no edge points in sight"
            lines.append(f"frame {name}: {text}, median {usual:.3f}")
    return lines + ([f"motion: {result.motion}"] if result.motion else [])


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """A progress bar on a terminal, nothing in a pipe; yields a function of the work done and the total (default 1)."""
    form = "{desc} {bar} {percentage:3.0f}% {elapsed}"
    with tqdm(total=1.0, desc=label, disable=not sys.stderr.isatty(), bar_format=form, leave=False) as bar:

        def step(done: float, total: float = 1.0) -> None:
            bar.n = done / total
            bar.refresh()

        yield step


PAGE_OPTIONS = {"rig": ("--report", "calib_ros_check"), "gif": ("--gif", "calib_ros_view")}


def page(name: str, path: str | None) -> Any:
    """What another package makes a page or picture at a path with; None without. BadInputError where the package is left out."""
    if path is None:
        return None
    if name not in extensions.names(extensions.PAGES):
        raise BadInputError("{} needs {}, which this installation leaves out".format(*PAGE_OPTIONS[name]))
    return extensions.load(extensions.PAGES, name)(path)


def check_json(path: str | None) -> None:
    """BadInputError, before the work, for what --json names and cannot be written. "-": standard output."""
    if path is not None and path != "-":
        check_output(path, "--json")


def print_or_save(result: AsJson, text: str, path: str | None) -> None:
    """What a command has found: as JSON in a file, if one is named, and in words on standard output; "-": JSON on standard
    output, and the words on the standard error. Neither a full disk nor a closed pipe takes the other one."""
    try:
        if path is not None and path != "-":
            result.save(path)
    finally:
        try:
            print(result.dumps().removesuffix("\n") if path == "-" else text, flush=True)
        except BrokenPipeError:  # its reader is gone
            discard_output()
        if path == "-":
            note(text)


def discard_output() -> None:
    """Send to nowhere what a reader that is gone would not take, now and when the process ends."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


def note(line: str) -> None:
    """Print a note on standard error."""
    print(line, file=sys.stderr)
