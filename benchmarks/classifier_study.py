"""How well do shapes of clusters classify points? Precision and recall per class.

    python -m benchmarks.classifier_study [--kitti ROOT] [--seeds 1 2 3 4] [--rings 16 32 64 128 0]

On synthetic drives the truth is exact. With KITTI: odometry scans that have labels in SemanticKITTI's format (labels/ beside
velodyne/), and the boxes of the object set: how much of each object is found, and, in the camera's view, how much of what is
called vehicle, person or cyclist lies in the box of one. What stands in DontCare regions does not count.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.kitti import KittiSource
from calib_ros.datasets.kitti_files import CalibrationFile
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros_semantics.models.geometric_classes import cluster_classes
from calib_ros_semantics.models.label_files import LabelScans
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_synthetic.drive import SyntheticDrive

Classes = NDArray[np.uint8]
Floats = NDArray[np.float64]
SHOWN = [c for c in SemanticClass if c not in (SemanticClass.OTHER, SemanticClass.SKY)]
OF_BOX = {"Car": 1, "Van": 1, "Truck": 1, "Tram": 1, "Pedestrian": 2, "Person_sitting": 2, "Cyclist": 3}
FOUND = 0.5  # share of an object's points that makes it found
FEWEST = 10  # points of an object that could be found at all
MARGIN = 0.1  # m by which boxes are widened: labels are that exact


def header(first: str) -> str:
    return f"{first:34s}" + "".join(f"{c.name.lower()[:10]:>13s}" for c in SHOWN) + f"{'s/scan':>8s}"


def row(name: str, pairs: Iterable[tuple[Classes, Classes]], seconds: float) -> str:
    """Precision / recall in percent for each class; - where the truth has none."""
    found, truth = (np.concatenate(column) for column in zip(*pairs, strict=True))
    found, truth = found[truth != UNLABELLED], truth[truth != UNLABELLED]
    cells = []
    for c in SHOWN:
        right = float(np.count_nonzero((found == c) & (truth == c)))
        called, there = (float(np.count_nonzero(classes == c)) for classes in (found, truth))
        cells.append(f"{percent(right, called)} / {percent(right, there)}" if called or there else "-")
    return f"{name:34s}" + "".join(f"{cell:>13s}" for cell in cells) + f"{seconds:8.2f}"


def percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:3.0f}" if whole else "  -"


def timed(frame: Frame) -> tuple[Classes, float]:
    began = time.perf_counter()
    return cluster_classes(frame.cloud), time.perf_counter() - began


def synthetic(rings: int, seeds: list[int]) -> str:
    pairs, seconds = [], []
    for seed in seeds:
        drive = SyntheticDrive(seed=seed, frames=2, rings=rings, width=96, height=64, stride=40)
        for k in range(len(drive)):
            frame = drive[k]
            assert frame.cloud.label is not None
            found, took = timed(frame)
            pairs.append((found, frame.cloud.label))
            seconds.append(took)
    return row(f"synthetic, {rings or 'no'} rings, {len(pairs)} scans", pairs, float(np.mean(seconds)))


def labelled(sequence: Path) -> str:
    """A row of all scans that have labels."""
    labels, source = LabelScans(sequence / "labels"), KittiSource(sequence)
    pairs, seconds = [], []
    for k, number in enumerate(source.numbers):
        if (sequence / "labels" / f"{number:06d}.label").is_file():
            frame = source[k]
            found, took = timed(frame)
            pairs.append((found, labels(frame, Deadline(np.inf))))
            seconds.append(took)
    return row(f"sequence {sequence.name}, {len(pairs)} scans", pairs, float(np.mean(seconds)))


def boxes(root: Path) -> None:
    """The table of the object set."""
    source = KittiSource(root)
    inside, called = np.zeros(4, int), np.zeros(4, int)
    print(f"\n{'object':34s}{'distance m':>12s}{'points':>8s}{'found %':>9s}")
    for k, number in enumerate(source.numbers):
        frame, name = source[k], f"{number:06d}"
        found, _ = timed(frame)
        calibration = CalibrationFile(root / "calib" / f"{name}.txt")
        R0, Tr = calibration.matrix("R0_rect", 3, 3), calibration.matrix("Tr_velo_to_cam", 3, 4)
        rectified = (frame.cloud.xyz @ Tr[:, :3].T + Tr[:, 3]) @ R0.T
        kind = np.zeros(len(found), int)
        seen, ignored = in_view(frame)
        for line in (root / "label_2" / f"{name}.txt").read_text().splitlines():
            what, *rest = line.split()
            numbers = np.array(rest, float)
            if what == "DontCare":
                ignored |= in_rectangle(frame, numbers[3:7])
                continue
            own = in_box(rectified, numbers[7:14])
            if what not in OF_BOX:
                ignored |= own
                continue
            kind[own] = OF_BOX[what]
            points = float(np.count_nonzero(own))
            hit = float(np.count_nonzero(own & (found == OF_BOX[what])))
            recall = "too few" if points < FEWEST else f"{percent(hit, points)}{'' if hit >= FOUND * points else ' -'}"
            print(f"{name} {what:27s}{numbers[12]:12.0f}{points:8.0f}{recall:>9s}")
        for c in (1, 2, 3):
            mine = seen & ~ignored & (found == c)
            called[c] += np.count_nonzero(mine)
            inside[c] += np.count_nonzero(mine & (kind == c))
    for c in (1, 2, 3):
        share = percent(inside[c], called[c])
        print(f"called {SemanticClass(c).name.lower():8s} in view: {called[c]:5d} points, {share} % in a box")


def pixels(frame: Frame) -> tuple[Floats, NDArray[np.bool_]]:
    assert frame.reference is not None
    return frame.camera.project(frame.cloud.xyz @ frame.reference[:3, :3].T + frame.reference[:3, 3])


def in_view(frame: Frame) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points the camera sees, and an empty mask."""
    _, visible = pixels(frame)
    return visible, np.zeros_like(visible)


def in_rectangle(frame: Frame, sides: Floats) -> NDArray[np.bool_]:
    """Points that project between left, top, right and bottom (px)."""
    uv, visible = pixels(frame)
    return visible & (uv >= sides[:2]).all(axis=1) & (uv <= sides[2:]).all(axis=1)


def in_box(rectified: Floats, box: Floats) -> NDArray[np.bool_]:
    """Points (n, 3) of the rectified camera 0 in a box: height, width, length, x, y, z of its bottom's middle, turn about y."""
    height, width, length, *middle, turn = box
    off = rectified - np.array(middle)
    c, s = np.cos(turn), np.sin(turn)
    along, across = c * off[:, 0] - s * off[:, 2], s * off[:, 0] + c * off[:, 2]
    upright = (off[:, 1] <= MARGIN) & (off[:, 1] >= -height - MARGIN)
    return np.asarray(upright & (np.abs(along) <= length / 2 + MARGIN) & (np.abs(across) <= width / 2 + MARGIN))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kitti", type=Path, help="folder with odometry/ and object/")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3, 4])
    parser.add_argument("--rings", type=int, nargs="*", default=[16, 32, 64, 128, 0])
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(header("precision / recall, %"))
    for rings in args.rings if args.seeds else ():
        print(synthetic(rings, args.seeds), flush=True)
    if args.kitti:
        for folder in sorted((args.kitti / "odometry" / "sequences").glob("*/labels")):
            print(labelled(folder.parent), flush=True)
        if (args.kitti / "object" / "training" / "label_2").is_dir():
            boxes(args.kitti / "object" / "training")
    return 0


if __name__ == "__main__":
    sys.exit(main())
