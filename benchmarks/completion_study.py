"""Density completion by morphology (eq. 3.11) and by the network: dense depths, and where the score of eq. 3.12 peaks.

    python -m benchmarks.completion_study --kitti FOLDER [--csv FILE] [--pictures FOLDER] [--network FILE.onnx] [--frames N]

Dense depths are compared with points that are held out, a tenth or bands of rows, wherever morphology gives a depth. Peaks are
those along single axes from the reference, ends those of the optimisation from starts within 0.7 deg and 7 cm per axis.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.sources import frames_of
from benchmarks.study_registration import DRIVE, ODOMETRY, spread
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.io import make_folder
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.point_score import nearest_per_pixel, project
from calib_ros_thesis.cloud import by_range, depth
from calib_ros_thesis.completion import FrameCompletion
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.maps import DEPTH_UNITS, complete_depth, far_level
from calib_ros_thesis.objective import ThesisObjective

SYNTHETIC = ("synthetic:seed=3,frames=3,stride=8", "synthetic:seed=21,frames=3,stride=8,scene=park")
GREY = 110  # of the image for a network that is not to see it
OUTLIER = 1.0  # m
AXES = ("r_x (deg)", "r_y (deg)", "r_z (deg)", "t_x (cm)", "t_y (cm)", "t_z (cm)")
REACH_DEG, REACH_M, SAMPLES = 0.5, 0.15, 11  # of the curves around the reference, to either side
METHODS = ("morphology", "network", "network without image")
Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]


class Sparse(NamedTuple):
    """A frame's points in its image: flat pixels (n,), depths (n,) m, image (h, w)."""

    pixels: NDArray[np.intp]
    depth: Floats
    image: NDArray[np.uint8]


def sparse_of(frame: Frame, config: Config) -> Sparse:
    """The nearest points of a frame in its working image at the reference."""
    extract = Calibrator(frame.camera, config).extract
    image, camera, thesis = extract.working_image(frame.image), extract.camera, thesis_of(config)
    xyz = frame.cloud.finite().xyz
    xyz = xyz[by_range(xyz, thesis.min_depth, thesis.max_depth)]
    xyz = xyz[np.argsort(-depth(xyz), kind="stable")]
    assert frame.reference is not None
    u, v, inside = project(xyz, frame.reference, camera)
    pixels, kept = nearest_per_pixel(v * camera.width + u, inside, camera.height * camera.width)
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return Sparse(pixels, depth(xyz)[kept], grey)


def dense_of(sparse: Sparse, keep: NDArray[np.bool_], choice: str, config: Config) -> dict[str, Floats]:
    """Dense depths (h, w) m of some of the points, by each method; 0 where there is none."""
    shape, far = sparse.image.shape, far_level(thesis_of(config))
    levels = np.zeros(sparse.image.size, np.int16)
    levels[sparse.pixels[keep]] = np.clip(np.rint(sparse.depth[keep] * np.float32(DEPTH_UNITS)), 1, far)
    found = [complete_depth(levels.reshape(shape), far) / np.float32(DEPTH_UNITS)]
    for image in (sparse.image, np.full_like(sparse.image, GREY)):
        found.append(FrameCompletion(choice, config.semantics, image)(sparse.pixels[keep], sparse.depth[keep]))
    return dict(zip(METHODS, found, strict=True))


def held_out(sparse: Sparse) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Which points stay, by what is left out."""
    yield "a tenth", np.random.default_rng(0).random(len(sparse.pixels)) >= 0.1
    # Bands of rows, about as wide as rings are apart: what is left out has its neighbours above and below, not beside.
    yield "bands of 4 rows", sparse.pixels // sparse.image.shape[1] // 4 % 2 == 0


def errors(frames: Sequence[Frame], choice: str, config: Config) -> dict[str, dict[str, list[Floats]]]:
    """Errors (m) by what is held out and by method."""
    out: dict[str, dict[str, list[Floats]]] = {}
    for frame in frames:
        sparse = sparse_of(frame, config)
        for name, keep in held_out(sparse):
            dense = dense_of(sparse, keep, choice, config)
            at, true = sparse.pixels[~keep], sparse.depth[~keep]
            counted = dense[METHODS[0]].ravel()[at] > 0
            for method, values in dense.items():
                error = np.abs(values.ravel()[at] - true)[counted]
                out.setdefault(name, {}).setdefault(method, []).append(error)
    return out


def rows_of_errors(name: str, found: dict[str, dict[str, list[Floats]]]) -> Iterator[dict[str, object]]:
    for left, methods in found.items():
        for method, parts in methods.items():
            error = np.concatenate(parts)
            yield {
                "source": name, "held out": left, "method": method, "mean error (m)": f"{error.mean():.3f}",
                "median (m)": f"{np.median(error):.3f}", "90 % (m)": f"{np.percentile(error, 90):.3f}",
                "off by 1 m (%)": f"{100 * (error > OUTLIER).mean():.1f}",
            }  # fmt: skip


def features_of(frames: Sequence[Frame], config: Config, sees: bool) -> tuple[Calibrator, list[FrameFeatures]]:
    """Features for eq. 3.12; without sees, the network gets a grey image."""
    calibrator = Calibrator(frames[0].camera, config)
    own = [calibrator.extract(frame) for frame in frames]
    if sees:
        return calibrator, own
    blind = [replace(f.own.completion, image=np.full_like(f.own.completion.image, GREY)) for f in own]
    return calibrator, [replace(f, own=replace(f.own, completion=c)) for f, c in zip(own, blind, strict=True)]


def peaks(calibrator: Calibrator, own: Sequence[FrameFeatures], truth: Matrix) -> list[float]:
    """Where J of single frames peaks along each axis, median of the distances: deg, cm."""
    objective = calibrator.objectives(own, truth, truth)
    assert isinstance(objective, ThesisObjective)
    found = []
    for axis in range(6):
        reach = np.deg2rad(REACH_DEG) if axis < 3 else REACH_M
        offsets = np.linspace(-reach, reach, SAMPLES)
        J = np.array([objective.frame_scores(se3.exp(np.eye(6)[axis] * x) @ truth) for x in offsets])
        best = np.array([_vertex(offsets, column) for column in J.T])
        found.append(float(np.median(np.abs(best)) * (np.rad2deg(1) if axis < 3 else 100)))
    return found


def _vertex(x: Matrix, y: Matrix) -> float:
    """Where a parabola through the largest value and its neighbours is largest."""
    k = int(np.clip(np.argmax(y), 1, len(x) - 2))
    a, b, c = y[k - 1 : k + 2]
    bent = a - 2 * b + c
    step = 0.0 if bent >= 0 else float(np.clip((a - c) / (2 * bent), -1, 1))
    return float(x[k] + step * (x[1] - x[0]))


def ends(
    calibrator: Calibrator, own: Sequence[FrameFeatures], truth: Matrix, starts: int
) -> tuple[list[float], list[float], float]:
    """Errors (deg, cm) of the optimum from each start, and CPU s for one."""
    rng, deg, cm, began = np.random.default_rng(5), [], [], time.process_time()
    for _ in range(starts):
        start = se3.perturb(truth, rng.uniform(-0.7, 0.7, 3), rng.uniform(-0.07, 0.07, 3))
        objective = calibrator.objectives(own, start, start)
        T = objective.refine(objective.optimise(start))
        deg.append(se3.rotation_error_deg(truth, T))
        cm.append(100 * se3.translation_error_m(truth, T))
    return deg, cm, (time.process_time() - began) / max(starts, 1)


def rows_of_scores(name: str, frames: Sequence[Frame], choice: str, starts: int) -> Iterator[dict[str, object]]:
    truth = frames[0].reference
    assert truth is not None
    for method, completion, sees in (
        ("morphology", "morphological", True),
        ("network", choice, True),
        (METHODS[2], choice, False),
    ):
        values = {"refine": {"objective": "thesis"}, "thesis": {"completion": completion, "dense_edges": "once_per_level"}}
        config = Config.from_dict({**values, "semantics": {"segmentation": "none"}})
        calibrator, own = features_of(frames, config, sees)
        row: dict[str, object] = {"source": f"{name}, {len(frames)} scenes", "method": method}
        row |= dict(zip(AXES, (f"{value:.2f}" for value in peaks(calibrator, own, truth)), strict=True))
        deg, cm, cpu = ends(calibrator, own, truth, starts)
        row |= {"ends: deg": f"{np.median(deg):.3f}", "ends: cm": f"{np.median(cm):.1f}", "CPU s": f"{cpu:.1f}"}
        yield row


def write_pictures(folder: Path, name: str, frames: Sequence[Frame], choice: str, config: Config) -> None:
    """Image, points, and the dense depth of each method, one above the other."""
    for frame in frames:
        sparse = sparse_of(frame, config)
        dense = dense_of(sparse, np.ones(len(sparse.pixels), bool), choice, config)
        points = np.zeros(sparse.image.size, np.float32)
        points[sparse.pixels] = sparse.depth
        maps = [points.reshape(sparse.image.shape), *(np.where(dense[METHODS[0]] > 0, dense[m], 0) for m in METHODS)]
        maps.append(dense["network"])
        rows = [cv2.cvtColor(sparse.image, cv2.COLOR_GRAY2BGR), *map(coloured, maps)]
        cv2.imwrite(str(folder / f"{name}_{frame.name}.png"), np.vstack(rows))


def coloured(values: Floats) -> NDArray[np.uint8]:
    """Depth as colour, near ones yellow; black where there is none."""
    near = np.where(values > 0, np.clip(255 * 4 / np.maximum(values, 4), 0, 255), 0).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(near, cv2.COLORMAP_INFERNO) * (values > 0)[..., None].astype(np.uint8), np.uint8)


def write_csv(path: Path, rows: Sequence[dict[str, object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def show(rows: Sequence[dict[str, object]]) -> None:
    print(markdown(list(rows[0]), [list(row.values()) for row in rows]), flush=True)


def main() -> None:
    """Measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--csv", type=Path, help="of the errors; those of the scores beside it, as NAME_scores.csv")
    parser.add_argument("--pictures", type=Path, help="folder for the maps of the KITTI frames")
    parser.add_argument("--network", default="network", help="value of thesis.completion to compare")
    parser.add_argument("--frames", type=int, default=5, help="of each KITTI source")
    parser.add_argument("--starts", type=int, default=6)
    args = parser.parse_args()
    config = Config.from_dict({"thesis": {"completion": args.network}})
    kitti: dict[str, list[Frame]] = {}
    for source in (ODOMETRY, DRIVE) if args.kitti else ():
        frames = frames_of(str(args.kitti / source))
        kitti[Path(source).name if source == DRIVE else "odometry 00"] = [frames[k] for k in spread(args.frames, len(frames))]
    groups = {**kitti, "synthetic": [frame for name in SYNTHETIC for frame in frames_of(name)]}
    rows = [row for name, frames in groups.items() for row in rows_of_errors(name, errors(frames, args.network, config))]
    show(rows)
    if args.pictures:
        make_folder(args.pictures, "--pictures")
        for name, frames in kitti.items():
            write_pictures(args.pictures, name.replace(" ", "_"), frames, args.network, config)
    if args.csv:
        write_csv(args.csv, rows)
    scores = [row for name, frames in kitti.items() for row in rows_of_scores(name, frames, args.network, args.starts)]
    if scores:
        show(scores)
        if args.csv:
            write_csv(args.csv.with_name(f"{args.csv.stem}_scores.csv"), scores)


if __name__ == "__main__":
    main()
