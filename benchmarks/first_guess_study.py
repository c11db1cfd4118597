"""How often the first guess from classes is right, and what the registration makes of it.

    python -m benchmarks.first_guess_study [--drives 40] [--frames 1 3 10] [--labels exact objects regions geometric]
                               [--cache FOLDER] [--kitti FOLDER] [--turns 8]

Synthetic: every trial is a drive of its own (seeds from 700 on, 640x240, 64 rings, frames 15 m apart) whose camera is mounted
up to 1 m from the LiDAR along each axis and up to 4 deg off level about each. The cloud is then turned by a random yaw over the
whole circle, so that nothing reveals where the camera points. Labels: exact = those of the drive; objects = of the vehicles,
persons, cyclists, poles and signs of both sensors (connected regions, clusters) 20 % get the class of another and 30 % none;
regions = the same of everything, whole streets and rows of houses, too; geometric = points labelled by the shape of clusters
alone, pixels exact.

KITTI: odometry frame 000000 with the labels of its points; the class of a mask of Segment Anything is that of most labelled
points that fall into it under the reference, so the pixels have the outlines of real masks, but the right class. The
object scenes know their boxes only: pixels and points in them have the class of the box, other points are ground by a plane, and
the rows of pixels below all boxes count as ground. One scene with one object can hardly be solved; it is reported as it is.

Columns: trials; best guess within 5 deg and 0.5 m of the truth; any of the guesses tried; after the registration within 0.3 deg
and 5 cm, and converged but wrong; registrations run per trial; seconds of the guess and of all registrations (median).
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Rectifier
from calib_ros.datasets.kitti import KittiSource
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame, SemanticClass
from calib_ros.lidar.segmentation import cluster, fit_ground
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.motion_guess.hypotheses import best_registration, worth_trying
from calib_ros_semantics.first_guess.guess import first_guess
from calib_ros_semantics.first_guess.view import MATCHED, class_view
from calib_ros_semantics.models.geometric_classes import cluster_classes
from calib_ros_semantics.models.labels import SEMANTIC_KITTI_RAW, class_of, lookup
from calib_ros_synthetic.drive import SyntheticDrive

LONGEST = 10
NEAR, RIGHT = (5.0, 0.5), (0.3, 0.05)  # deg, m: what the registration needs, and what it must give
MISLABELLED, MISSING = 0.2, 0.3
HEAD = (
    "| frames | labels | trials | best guess near | any near | right after | wrong, converged | registrations | guess, s | "
    "registration, s |\n|---|---|---|---|---|---|---|---|---|---|"
)
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Trial:
    """What came of one trial; False and 0 where there was no guess at all."""

    near: bool = False
    any_near: bool = False
    right: bool = False
    converged: bool = False
    registrations: int = 0
    guess_s: float = 0.0
    registration_s: float = 0.0


def mounted(seed: int, cache: Path | None) -> list[Frame]:
    """The frames of a drive with a camera mounted at random; frame.reference is the truth."""
    file = cache / f"{seed}.pkl" if cache else None
    if file and file.is_file():
        frames: list[Frame] = pickle.loads(file.read_bytes())
        return frames
    rng = np.random.default_rng([seed, 77])
    T = se3.perturb(nominal(), rng.uniform(-4, 4, 3), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ rng.uniform(-1, 1, 3)
    drive = SyntheticDrive(seed, LONGEST, 64, width=640, height=240, speed=0, stride=30, T_camera_lidar=T)
    frames = [drive[k] for k in range(LONGEST)]
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(frames))
    return frames


def turned(frame: Frame, yaw: float) -> Frame:
    """The frame as if the LiDAR were mounted turned right by yaw (rad): its points turn left."""
    R = se3.rotation_from_euler(yaw, 0, 0)
    assert frame.reference is not None
    cloud = replace(frame.cloud, xyz=np.asarray(frame.cloud.xyz @ R.T, np.float32))
    return replace(frame, cloud=cloud, reference=frame.reference @ se3.from_parts(R.T, np.zeros(3)), twist=None)


def damaged(frame: Frame, rng: np.random.Generator, among: Sequence[int]) -> Frame:
    """The frame with a part of its instances of the given classes wrong, as one of these, or missing, on both sides."""
    assert frame.classes is not None
    assert frame.cloud.label is not None
    classes, label = frame.classes.copy(), frame.cloud.label.copy()
    for c in np.intersect1d(frame.classes, among):
        count, region = cv2.connectedComponents((frame.classes == c).astype(np.uint8), connectivity=8)
        new = _new_classes(int(c), count, rng, among)
        classes[region > 0] = new[region[region > 0]]
    for c in np.intersect1d(frame.cloud.label, among):
        own = np.flatnonzero(frame.cloud.label == c)
        member = cluster(frame.cloud.xyz[own], 0.8, 1, voxel=0.4)
        label[own] = _new_classes(int(c), int(member.max()) + 1, rng, among)[member]
    return replace(frame, classes=classes, cloud=replace(frame.cloud, label=label))


def _new_classes(c: int, count: int, rng: np.random.Generator, among: Sequence[int]) -> Labels:
    """Classes (count,) of instances of class c."""
    luck = rng.random(count)
    others = np.array([m for m in among if m != c], np.uint8)
    new = np.where(luck < MISLABELLED, rng.choice(others, count), c)
    return np.where(luck >= 1 - MISSING, UNLABELLED, new).astype(np.uint8)


def geometric(frame: Frame, rng: np.random.Generator) -> Frame:
    """The frame with the classes of points by the shape of clusters."""
    return replace(frame, cloud=replace(frame.cloud, label=cluster_classes(frame.cloud)))


LABELS: dict[str, Callable[[Frame, np.random.Generator], Frame]] = {
    "exact": lambda frame, rng: frame,
    "objects": lambda frame, rng: damaged(frame, rng, MAIN_CLASSES),
    "regions": lambda frame, rng: damaged(frame, rng, MATCHED),
    "geometric": geometric,
}


def trial(frames: Sequence[Frame], seed: int) -> Trial:
    """Guess and registration of frames of one camera with labels; only their references are the truth."""
    truth, rectify = frames[0].reference, Rectifier(frames[0].camera)
    assert truth is not None

    def within(T: NDArray[np.float64], limit: tuple[float, float]) -> bool:
        return se3.rotation_error_deg(truth, T) <= limit[0] and se3.translation_error_m(truth, T) <= limit[1]

    views = [
        class_view(f.cloud, np.asarray(rectify.map(f.classes, nearest=True)), rectify.camera)
        for f in frames
        if f.classes is not None
    ]
    started = time.perf_counter()
    try:
        guesses = worth_trying(first_guess(views, seed=seed))
    except TooFewFeaturesError:
        return Trial(guess_s=time.perf_counter() - started)
    guess_s = time.perf_counter() - started
    calibrator = Calibrator(frames[0].camera)
    features = [calibrator.extract(f) for f in frames]
    started = time.perf_counter()
    result, run = best_registration(guesses, lambda T, box: calibrator.estimate(features, T, box))
    registration_s = time.perf_counter() - started
    near = [within(g.T, NEAR) for g in guesses]
    right = result.converged and within(result.T_camera_lidar, RIGHT)
    return Trial(near[0], any(near), right, result.converged, run, guess_s, registration_s)


def synthetic(first_seed: int, drives: int, counts: Sequence[int], labels: Sequence[str], cache: Path | None) -> None:
    """A row for every number of frames and kind of labels, printed when it is done."""
    for kind in labels:
        for n in counts:
            trials = []
            for seed in range(first_seed, first_seed + drives):
                rng = np.random.default_rng([seed, n])
                yaw, first = float(rng.uniform(-np.pi, np.pi)), int(rng.integers(LONGEST - n + 1))
                part = [turned(f, yaw) for f in mounted(seed, cache)[first : first + n]]
                trials.append(trial([LABELS[kind](f, rng) for f in part], seed))
            print(row(str(n), kind, trials), flush=True)


def kitti_scenes(root: Path) -> Iterator[tuple[str, Frame]]:
    """Name and labelled frame of every KITTI scene whose labels are there."""
    yield _odometry_frame(root)
    scenes = KittiSource(root / "object/training")
    for k, number in enumerate(scenes.numbers):
        yield f"object {number:06d}", _with_boxes(scenes[k], root / f"object/training/label_2/{number:06d}.txt")


def _odometry_frame(root: Path) -> tuple[str, Frame]:
    """Odometry frame 000000: labels of points as published, those of pixels by masks that take the class of their points."""
    folder = root / "odometry/sequences/00"
    frame = KittiSource(folder)[0]
    raw = np.fromfile(folder / "labels/000000.label", np.uint32) & 0xFFFF
    label = lookup(SEMANTIC_KITTI_RAW)[raw]
    assert frame.reference is not None
    uv, inside = frame.camera.project(se3.transform(frame.reference, frame.cloud.xyz))
    used = np.flatnonzero(inside & (label != UNLABELLED))
    u, v = np.round(uv[used]).astype(int).T
    classes = np.full(frame.image.shape[:2], UNLABELLED, np.uint8)
    files = sorted((root / "sam_masks/000000").glob("*.png"))
    masks = [np.asarray(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) > 127 for p in files]
    for mask in sorted(masks, key=lambda m: -int(m.sum())):  # smaller masks lie upon larger ones
        votes = np.bincount(label[used][mask[v, u]], minlength=256)
        if votes.sum() >= 5:
            classes[mask] = votes.argmax()
    return "odometry 000000", replace(frame, classes=classes, cloud=replace(frame.cloud, label=label))


def _with_boxes(frame: Frame, file: Path) -> Frame:
    """An object scene with the classes of its boxes, and the ground."""
    assert frame.reference is not None
    xyz = frame.cloud.xyz
    plane = fit_ground(xyz, 0.2, 128, 15.0, 0.05, 0)
    label = np.full(len(xyz), UNLABELLED, np.uint8)
    if plane is not None:
        label[plane.distance(xyz) < 0.2] = SemanticClass.GROUND
    classes = np.full(frame.image.shape[:2], UNLABELLED, np.uint8)
    # Boxes are given in the rectified camera 0; camera 2 stands 6 cm aside, which the 0.1 m around a box makes up for.
    p = se3.transform(frame.reference, xyz)
    bottom = 0
    for line in file.read_text().splitlines():
        kind, *rest = line.split()
        if kind == "DontCare":
            continue
        values = np.array(rest, float)
        left, top, right, low = np.round(values[3:7]).astype(int)
        (h, w, length), place, turn = values[7:10], values[10:13], values[13]
        q = (p - place) @ np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        within = (np.abs(q[:, 0]) < length / 2 + 0.1) & (np.abs(q[:, 2]) < w / 2 + 0.1) & (q[:, 1] < -0.15) & (q[:, 1] > -h - 0.1)
        label[within] = class_of(kind)
        classes[max(top, 0) : low + 1, max(left, 0) : right + 1] = class_of(kind)
        bottom = max(bottom, low)
    classes[bottom + 1 :] = SemanticClass.GROUND
    return replace(frame, classes=classes, cloud=replace(frame.cloud, label=label))


def kitti(root: Path, turns: int) -> None:
    """A row for every scene, its cloud turned by random yaws."""
    for name, frame in kitti_scenes(root):
        for kind, labelled in (("exact", frame), ("geometric", geometric(frame, np.random.default_rng(0)))):
            yaws = np.random.default_rng(0).uniform(-np.pi, np.pi, turns)
            print(row(name, kind, [trial([turned(labelled, yaw)], k) for k, yaw in enumerate(yaws)]), flush=True)


def row(frames: str, labels: str, trials: Sequence[Trial]) -> str:
    """One line of the table."""

    def share(name: str) -> str:
        return f"{sum(getattr(t, name) for t in trials)}/{len(trials)}"

    wrong = sum(t.converged and not t.right for t in trials)
    seconds = " | ".join(f"{np.median([getattr(t, name) for t in trials]):.2f}" for name in ("guess_s", "registration_s"))
    runs = np.mean([t.registrations for t in trials])
    return (
        f"| {frames} | {labels} | {len(trials)} | {share('near')} | {share('any_near')} | {share('right')} | {wrong} "
        f"| {runs:.2f} | {seconds} |"
    )


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40, help="trials of every row; 0 = none of the synthetic ones")
    parser.add_argument("--seed", type=int, default=700, help="of the first drive")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 3, 10], metavar="N", help=f"frames, at most {LONGEST}")
    parser.add_argument("--labels", nargs="+", default=["exact", "objects", "regions"], choices=list(LABELS))
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="keep rendered drives there (20 MB each)")
    parser.add_argument("--kitti", type=Path, metavar="FOLDER", help="folder of the KITTI recordings")
    parser.add_argument("--turns", type=int, default=8, help="trials of every KITTI scene")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(HEAD, flush=True)
    if args.drives:
        synthetic(args.seed, args.drives, args.frames, args.labels, args.cache)
    if args.kitti:
        kitti(args.kitti, args.turns)


if __name__ == "__main__":
    main()
