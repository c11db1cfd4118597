"""What the classes of the package's own networks bring the registration on KITTI, against none at all.

    python -m benchmarks.network_study KITTI [ROW ...] [--starts 2] [--sets 50] [--trials 20] [--out FOLDER]

KITTI: folder of the recordings; raw drive 0005 and odometry 00 are used. ROW, default all:

single   every frame alone from --starts starts, uniform within 5 deg and 0.3 m per axis, with a search of that size
five     --sets random sets of 5 frames of one drive each, from such starts
guess    first guesses: --trials sets of 1, 5 and 10 frames each, the LiDAR turned by any yaw within 45 deg and moved by up to 1 m
         per axis, nothing of it known
weights  --sets random sets of 5 frames: w_j of eq. 3.16 against equal weights, from the reference
labels   points of the labelled scan (odometry 000000) in the picture: classes by the shape of clusters, and those of the pixels
         carried over through the reference, against the published labels

A trial is a success within 0.5 deg and 10 cm (guess: 0.3 deg and 8 cm) of the recording's calibration. Differences are paired;
their 95 % intervals are those of a bootstrap over frames or sets.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.first_guess_study import kitti_scenes
from benchmarks.registration_study import DRIVE, ODOMETRY
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features, FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import Result
from calib_ros_evaluation.experiments.frames import AROUND_PX
from calib_ros_semantics.models.geometric_classes import cluster_classes
from calib_ros_semantics.models.image_classes import ImageClasses
from calib_ros_semantics.models.onnx_model import Deadline

DEG, M = 5.0, 0.3
NEAR, RIGHT = (0.5, 0.10), (0.3, 0.08)  # deg, m: success from a start, and from nothing
YAW_DEG, SHIFT_M = 45.0, 1.0
BOOTSTRAP = 10_000
VARIANTS: dict[str, dict[str, Any]] = {
    "none": {"semantics": {"segmentation": "none"}},
    "points only": {"semantics": {"image_classes": "", "cloud_classes": "geometric"}},
    "default": {},
}
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """The end of one trial. unit: what trials of both variants share, and what is drawn by the bootstrap."""

    variant: str
    unit: str
    trial: int
    deg: float
    m: float
    status: str
    seconds: float

    def success(self, limits: tuple[float, float] = NEAR) -> bool:
        """Near enough."""
        return self.deg < limits[0] and self.m < limits[1]


class Drive:
    """A recording, and the features of its frames under each variant."""

    def __init__(self, path: Path) -> None:
        source = open_dataset(path)
        self.name, self.frames = path.name, [source[k] for k in range(len(source))]
        self._made: dict[str, tuple[Calibrator, list[Features]]] = {}

    def features(self, variant: str) -> tuple[Calibrator, list[Features]]:
        """Made once."""
        if variant not in self._made:
            calibrator = Calibrator(self.frames[0].camera, update(Config(), VARIANTS[variant]))
            models, made = calibrator.segmentation, []
            for frame in tqdm(self.frames, f"{self.name}, {variant}", leave=False):
                made.append(calibrator.extract(frame, models(frame) if models.active else None))
            self._made[variant] = calibrator, made
        return self._made[variant]

    @property
    def truth(self) -> Matrix:
        """The recording's own calibration."""
        reference = self.frames[0].reference
        assert reference is not None
        return reference


def outcome(variant: str, unit: str, trial: int, truth: Matrix, result: Result) -> Outcome:
    """Of one estimate."""
    T = result.T_camera_lidar
    error = se3.rotation_error_deg(truth, T), se3.translation_error_m(truth, T)
    return Outcome(variant, unit, trial, *error, result.status, result.elapsed_s)


def from_starts(
    drives: Sequence[Drive], sets: dict[str, list[NDArray[np.intp]]], starts: int, variants: Sequence[str]
) -> list[Outcome]:
    """Each set of frames under every variant, from the same starts."""
    box, out = SearchBox(DEG, M), []
    for variant in variants:
        for drive in drives:
            calibrator, made = drive.features(variant)
            for number, chosen in enumerate(tqdm(sets[drive.name], f"{drive.name}, {variant}", leave=False)):
                for trial in range(starts):
                    rng = np.random.default_rng((number, trial))
                    T = se3.perturb(drive.truth, rng.uniform(-DEG, DEG, 3), rng.uniform(-M, M, 3))
                    own = [made[k] for k in chosen]
                    unit = f"{drive.name} {'+'.join(map(str, chosen))}"
                    out.append(outcome(variant, unit, trial, drive.truth, estimated(calibrator, own, T, box)))
    return out


def estimated(calibrator: Calibrator, features: Sequence[FrameFeatures], T: Matrix, box: SearchBox) -> Result:
    """The estimate from features with classes as the product makes it: without them first, where its settings say so."""
    if not calibrator.classes_in_doubt_only:
        return calibrator.estimate(features, T, box)
    return calibrator.estimate_in_doubt([own.plain or own for own in features], lambda: (features, ()), T, box)


def random_sets(drives: Sequence[Drive], size: int, count: int) -> dict[str, list[NDArray[np.intp]]]:
    """Sets of different frames of each drive, shared out among the drives."""
    rng = np.random.default_rng(0)
    shares = np.full(len(drives), count // len(drives)) + (np.arange(len(drives)) < count % len(drives))
    return {
        drive.name: [np.sort(rng.choice(len(drive.frames), min(size, len(drive.frames)), replace=False)) for _ in range(n)]
        for drive, n in zip(drives, shares, strict=True)
    }


def compared(outcomes: Sequence[Outcome], against: str = "none", limits: tuple[float, float] = NEAR) -> None:
    """A line for each variant, then its paired difference to another."""
    print("\n| semantics | success | deg median / p90 | cm median / p90 | accepted wrong | refused | s | more successes | deg |")
    print("|---|---|---|---|---|---|---|---|---|")
    base = {(o.unit, o.trial): o for o in outcomes if o.variant == against}
    for variant in dict.fromkeys(o.variant for o in outcomes):
        own = [o for o in outcomes if o.variant == variant]
        good = np.array([o.success(limits) for o in own])
        accepted = np.array([o.status == "converged" for o in own])
        deg, cm = np.array([o.deg for o in own]), 100 * np.array([o.m for o in own])
        cells = [
            f"{good.sum()} of {len(own)}",
            f"{np.median(deg):.3f} / {np.percentile(deg, 90):.2f}",
            f"{np.median(cm):.1f} / {np.percentile(cm, 90):.1f}",
            f"{(accepted & ~good).sum()}",
            f"{(~accepted).sum()}",
            f"{np.median([o.seconds for o in own]):.1f}",
        ]
        if base and variant != against:
            other = [base[o.unit, o.trial] for o in own]
            units = [o.unit for o in own]
            more = 100 * (good.astype(float) - [o.success(limits) for o in other])
            less = deg - [o.deg for o in other]
            cells += [f"{interval(more, units, np.mean, '+.0f')} %", interval(less, units, np.median, "+.3f")]
        else:
            cells += ["", ""]
        print(f"| {variant} | " + " | ".join(cells) + " |", flush=True)


def interval(values: Matrix, units: Sequence[str], what: Callable[[Matrix], Any], form: str) -> str:
    """A statistic of paired differences with its 95 % interval, by a bootstrap over the units."""
    groups = [values[np.array(units) == unit] for unit in dict.fromkeys(units)]
    rng = np.random.default_rng(0)
    drawn = [
        what(np.concatenate([groups[k] for k in rng.integers(len(groups), size=len(groups))])) for _ in range(BOOTSTRAP // 5)
    ]
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{what(values):{form}} ({low:{form}} to {high:{form}})"


def moved(features: FrameFeatures, A: Matrix) -> FrameFeatures:
    """The features as a LiDAR whose frame is moved by A (4, 4) would have seen them."""

    def at(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(xyz @ A[:3, :3].T + A[:3, 3], np.float32)

    view = features.view and replace(features.view, xyz=at(features.view.xyz))
    return replace(features, points=replace(features.points, xyz=at(features.points.xyz)), view=view, plain=None)


def guesses(drives: Sequence[Drive], trials: int) -> list[Outcome]:
    """First guesses of growing sets of frames, spread over their drive."""
    out = []
    for count in (1, 5, 10):
        for trial in tqdm(range(trials), f"guess from {count}", leave=False):
            drive = drives[trial % len(drives)]
            calibrator, made = drive.features("default")
            rng = np.random.default_rng((count, trial))
            chosen = np.sort(rng.choice(len(made), min(count, len(made)), replace=False))
            yaw, shift = np.deg2rad(rng.uniform(-YAW_DEG, YAW_DEG)), rng.uniform(-SHIFT_M, SHIFT_M, 3)
            A = se3.exp(np.array([0, 0, yaw, 0, 0, 0]))
            A[:3, 3] = shift
            own = [moved(f, A) for k in chosen if isinstance(f := made[k], FrameFeatures)]
            name = f"{count} frame{'s' if count > 1 else ''}"
            unit = f"{drive.name} {'+'.join(map(str, chosen))}"
            out.append(outcome(name, unit, trial, drive.truth @ se3.inverse(A), calibrator.guess(own)))
    return out


def weights(drives: Sequence[Drive], count: int) -> None:
    """Sets of 5 frames with w_j and without, each refined from the reference."""
    both: list[tuple[float, float]] = []
    for drive in drives:
        calibrator, made = drive.features("default")
        models = calibrator.segmentation
        weighing = Calibrator(drive.frames[0].camera, update(Config(), {"semantics": {"frame_weights": True}}), models)
        weighted = [weighing.extract(frame, models(frame)) for frame in tqdm(drive.frames, drive.name, leave=False)]
        for chosen in random_sets(drives, 5, count)[drive.name]:
            ends = [
                c.estimate([f[k] for k in chosen], drive.truth).T_camera_lidar
                for c, f in ((weighing, weighted), (calibrator, made))
            ]
            deg = [se3.rotation_error_deg(drive.truth, T) for T in ends]
            cm = [100 * se3.translation_error_m(drive.truth, T) for T in ends]
            both.append((deg[0] - deg[1], cm[0] - cm[1]))
    units = [str(k) for k in range(len(both))]
    deg_cm = [interval(np.array(v), units, np.mean, "+.3f") for v in zip(*both, strict=True)]
    print(f"\n{len(both)} sets of 5: w_j less equal weights: {deg_cm[0]} deg, {deg_cm[1]} cm", flush=True)


def labels(root: Path) -> None:
    """Precision and recall of two ways to label points."""
    _, frame = next(kitti_scenes(root))
    assert frame.cloud.label is not None
    truth = frame.cloud.label
    config = Config()
    pixels = ImageClasses(config.semantics.image_classes, config.semantics)(frame, Deadline(60))
    by_shape = cluster_classes(replace(frame.cloud, label=None))
    carried, inside = carried_over(frame, pixels)
    print(
        "\n| precision / recall % | "
        + " | ".join(c.name.lower() for c in SemanticClass)
        + " |\n|---|"
        + "---|" * len(SemanticClass)
    )
    for name, found in (("by shape", by_shape), ("carried over from pixels", carried)):
        cells = []
        for c in SemanticClass:
            known = inside & (truth != UNLABELLED)
            hit, said, there = (int((known & m).sum()) for m in ((found == c) & (truth == c), found == c, truth == c))
            cells.append(f"{100 * hit / said if said else float('nan'):.0f} / {100 * hit / there if there else float('nan'):.0f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def carried_over(frame: Frame, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Classes (n,) of the points by the pixels (h, w) they project to under the reference; and which are seen there: in the
    picture, and hidden by no nearer point around."""
    T = frame.reference
    assert T is not None
    P = deskewed_frame(frame, Config().motion).cloud.xyz @ T[:3, :3].T + T[:3, 3]
    uv, inside = frame.camera.project(P)
    height, width = pixels.shape
    u, v = np.rint(np.nan_to_num(uv[:, 0])).astype(int), np.rint(np.nan_to_num(uv[:, 1])).astype(int)
    inside = inside & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    nearness = np.zeros((height, width), np.float32)
    np.maximum.at(nearness, (v[inside], u[inside]), (1 / P[inside, 2]).astype(np.float32))
    nearness = np.asarray(cv2.dilate(nearness, np.ones((AROUND_PX, AROUND_PX), np.uint8)), np.float32)
    seen = inside.copy()
    seen[inside] = 1 / P[inside, 2] > 0.95 * nearness[v[inside], u[inside]]
    out = np.full(len(P), UNLABELLED, np.uint8)
    out[seen] = pixels[v[seen], u[seen]]
    return out, seen


def main() -> None:
    """Prints the tables; --out keeps every trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", type=Path)
    parser.add_argument("rows", nargs="*", metavar="ROW", help="single, five, guess, weights, labels; default all")
    parser.add_argument("--starts", type=int, default=2, help="of every frame")
    parser.add_argument("--sets", type=int, default=50, help="of 5 frames")
    parser.add_argument("--trials", type=int, default=20, help="first guesses of each number of frames")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), help="of single and five")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="tables of all trials")
    args = parser.parse_args()
    rows = args.rows or ["single", "five", "guess", "weights", "labels"]
    drives = [Drive(args.kitti / DRIVE), Drive(args.kitti / ODOMETRY)] if set(rows) - {"labels"} else []
    for row in rows:
        found: list[Outcome] = []
        if row == "single":
            found = from_starts(
                drives, {d.name: [np.array([k]) for k in range(len(d.frames))] for d in drives}, args.starts, args.variants
            )
            compared(found)
        elif row == "five":
            found = from_starts(drives, random_sets(drives, 5, args.sets), 1, args.variants)
            compared(found)
        elif row == "guess":
            found = guesses(drives, args.trials)
            compared(found, limits=RIGHT)
        elif row == "weights":
            weights(drives, args.sets)
        elif row == "labels":
            labels(args.kitti)
        else:
            parser.error(f"unknown row '{row}'")
        if args.out and found:
            args.out.mkdir(parents=True, exist_ok=True)
            with open(args.out / f"{row}.csv", "w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(Outcome.__dataclass_fields__)
                writer.writerows([getattr(o, f) for f in Outcome.__dataclass_fields__] for o in found)


if __name__ == "__main__":
    main()
