"""`calib-ros models`: which models are configured, whether they load and work, how long they take."""

from __future__ import annotations

import resource
import textwrap
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.cli.output import progress_bar
from calib_ros.config import Config, SemanticsConfig
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.io import make_folder
from calib_ros.overlay import write_png
from calib_ros.registration.classes import IMAGE, MASKS
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.segmentation import ModelSlot, SegmentationModels, error_line, judge, load_model

RUNS = 3  # the first is slower: libraries and memory are made ready
WIDTH = 110  # letters of a line; some exports have a dozen tensors


def models(source: Source, frame: int, config: Config, out: str | None) -> tuple[list[str], list[str], list[str]]:
    """Every configured model, tried on one frame: lines for a person, one for each model that cannot be used, and one for each
    whose output cannot be right, or is of little use.

    out: folder for pictures of what they see. BadInputError for a frame that is not there or a folder that cannot be made.
    """
    if not -len(source) <= frame < len(source):
        raise BadInputError(f"--frame {frame} is outside 0..{len(source) - 1} of this source")
    configured = SegmentationModels(config.semantics).models
    if not configured:
        off = config.semantics.segmentation == "none"
        why = "no models: semantics.segmentation is none" if off else "no models are named: see the stage semantics of --config"
        return [why], [], []
    if out is not None:
        make_folder(out, "--out")
    shown = source[frame]
    lines = [f"tried on frame {shown.name or frame}: {shown.image.shape[1]}x{shown.image.shape[0]}, {len(shown.cloud)} points"]
    failed: list[str] = []
    doubtful: list[str] = []
    with progress_bar("models") as step:
        for k, model in enumerate(configured):
            try:
                found, doubt = _tried(model, shown, config.semantics, out)
                lines += ["", *found]
                doubtful += [f"semantics.{model.kind}, {model.path}: {doubt}"] * bool(doubt)
            except Exception as error:  # whatever somebody's model makes of the frame, the others are tried
                failed.append(f"semantics.{model.kind}: {error_line(error, model.kind)}")
            step(k + 1, len(configured))
    return lines, failed, doubtful


def _tried(slot: ModelSlot, frame: Frame, config: SemanticsConfig, out: str | None) -> tuple[list[str], str]:
    """Lines about a model, and why its output cannot be right, or is of little use."""
    kind, before, began = slot.kind, _fresh_peak_mb(), time.perf_counter()
    model = load_model(kind, slot.path, config)
    loaded = time.perf_counter() - began
    seconds: list[float] = []
    while len(seconds) < RUNS and sum(seconds) < config.budget_s:
        began = time.perf_counter()
        answer = model(frame, Deadline(config.budget_s))
        seconds.append(time.perf_counter() - began)
    doubt, little = judge(model, answer)
    answer, borders = answer if kind == IMAGE else (answer, None)
    lines = [
        f"{kind}: {slot.path}",
        *([f"  weights: {slot.weights.text}"] if slot.weights else []),
        *_wrapped(model.describe()),
        f"  loaded in {loaded:.2f} s; first run {seconds[0]:.2f} s, best of {len(seconds)} {min(seconds):.2f} s of the budget of "
        f"{config.budget_s:g} s",
        f"  {config.threads} thread{'s' * (config.threads > 1)}, at most {_peak_mb() - before:.0f} MB of memory",
        *_wrapped(_found(kind, answer, model.needed)),
    ]
    if borders is not None:
        lines.append(f"  borders of classes on {100 * _share(borders):.1f} % of the pixels")
    lines += [f"  NOTE: {text}" for text in (model.fallback, model.note) if text]
    if out is not None:
        lines.append(f"  picture: {_picture(kind, answer, frame, Path(out))}")
        if borders is not None:
            lines.append(f"  picture: {_picture(MASKS, borders, frame, Path(out), 'class_borders')}")
    return lines, doubt or little


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)


def _found(kind: str, answer: Any, needed: str) -> str:
    """The output of a model in a line. needed: by a mask, to count."""
    if kind == MASKS:
        few = "" if _share(answer) else f": there was no mask, or none with what it needs, {needed}"
        return f"boundaries on {100 * _share(answer):.1f} % of the pixels{few}"
    count = np.bincount(answer.ravel(), minlength=256)
    names = {int(c): c.name.lower() for c in SemanticClass} | {UNLABELLED: "unknown"}
    shares = sorted(((n, names.get(c, str(c))) for c, n in enumerate(count) if n), reverse=True)
    listed = ", ".join(f"{name} {100 * n / count.sum():.1f} %" for n, name in shares)
    return f"{'pixels' if kind == IMAGE else 'points'}: {listed}"


def _share(edges: NDArray[np.float32]) -> float:
    """Share of the pixels that lie on an edge."""
    return float((edges.sum(axis=0) > 0.5).mean())


def _picture(kind: str, answer: Any, frame: Frame, out: Path, name: str = "") -> Path:
    from calib_ros_semantics.class_pictures import classes_on_image, cloud_from_above, edges_on_image

    draw = edges_on_image if kind == MASKS else classes_on_image if kind == IMAGE else cloud_from_above
    path = out / f"{name or kind}.png"
    write_png(path, draw(frame, answer))
    return path


def _fresh_peak_mb() -> float:
    """Reset the peak of memory use, where the kernel can; returns the current use, MB."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak_mb()


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
