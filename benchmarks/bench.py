"""What commands, their parts and the node cost in CPU time and memory, beside another version.

    make bench [BASE=COMMIT]
    python -m benchmarks.bench [SOURCE] [--base COMMIT] [--runs 5] [--only STAGE ...]

SOURCE: with a reference extrinsic; by default the synthetic drive. Its frames, and the same with what is wrong, are written as
bags once. Every run is a process of its own, of both versions in turn, and counts as the kernel counts it. Printed are the
least, the median and the most of the runs, and the ratio of the medians.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.compare import WORKING_TREE, environment, side
from benchmarks.compare_sets import ROOT
from benchmarks.records import markdown
from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.source import Source
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame

FRAMES, BAD_INPUT = 10, 2
OFF = ([6.0, -5.0, 4.0], [0.3, -0.25, 0.2])  # deg, m: the start is this far off the reference
LONGER = 1.03  # the focal length that is wrong
COMMAND, TRACEBACK = ["-m", "calib_ros"], "Traceback (most recent call last):"
NODE = ["-m", "benchmarks.node_cost", "--settle", "45", "--seconds", "40", "--bare"]
# Its last line is the figure of the stage, in s.
FEATURES = """
import sys, time
from calib_ros import Calibrator
from calib_ros.datasets import open_dataset
source = open_dataset(sys.argv[1])
frames = [source[k] for k in range(len(source))]
calibrator = Calibrator(frames[0].camera)
calibrator.extract(frames[0])
began = time.process_time()
for frame in frames:
    calibrator.extract(frame)
print((time.process_time() - began) / len(frames))
"""


class Altered:
    """A source with something done to its frames."""

    def __init__(self, source: Source, alter: Callable[[int, Frame], Frame]) -> None:
        self._source, self._alter = source, alter

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Frame:
        return self._alter(index, self._source[index])


def bags(source: Source, folder: Path) -> dict[str, str]:
    """FRAMES evenly spread frames: right ones, mirrored images, another focal length, and scans of other scenes."""
    chosen = np.linspace(0, len(source) - 1, min(FRAMES, len(source))).round().astype(int).tolist()
    K, half = source.camera.K.copy(), len(source) // 2
    K[[0, 1], [0, 1]] *= LONGER
    longer = replace(source.camera, K=K)
    kinds: dict[str, Callable[[int, Frame], Frame]] = {
        "right": lambda k, frame: frame,
        "mirrored": lambda k, frame: replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1])),
        "longer": lambda k, frame: replace(frame, camera=longer),
        "chance": lambda k, frame: replace(frame, cloud=source[(k + half) % len(source)].cloud),
    }
    return {name: str(write_bag(Altered(source, alter), folder / name, positions=chosen)) for name, alter in kinds.items()}


def stages(source: Source, folder: Path) -> dict[str, list[str]]:
    """What is run, as arguments of Python."""
    bag, start, right = bags(source, folder), folder / "start.json", folder / "right.json"
    assert source.reference is not None
    for path, T in ((start, se3.perturb(source.reference, *OFF)), (right, source.reference)):
        path.write_text(json.dumps({"T_camera_lidar": T.tolist()}))
    search = ["--initial", str(start), "--search-deg", "10", "--search-m", "0.5"]
    check = ["--extrinsic", str(right)]
    return {
        "imports": ["-c", "from calib_ros import Calibrator, Recalibrator, SearchBox"],
        "features of a frame": ["-c", FEATURES, bag["right"]],
        "calibrate": [*COMMAND, "calibrate", bag["right"], *search],
        "calibrate, mirrored": [*COMMAND, "calibrate", bag["mirrored"], *search],
        "calibrate, nothing matches": [*COMMAND, "calibrate", bag["chance"], *search],
        "calibrate, with intrinsics": [*COMMAND, "calibrate", bag["right"], *search, "--intrinsics", "refine"],
        "check, right": [*COMMAND, "check", bag["right"], *check],
        "check, other focal length": [*COMMAND, "check", bag["longer"], *check],
        "check, nothing matches": [*COMMAND, "check", bag["chance"], *check],
        "node at rest": NODE,
    }


def measured(arguments: Sequence[str], tree: Path) -> dict[str, float]:
    """Figures of a run by the packages of a tree, by their units. CalibrationError where it cannot be made."""
    own, of = ([*arguments, "--packages", str(tree)], ROOT) if arguments == NODE else (arguments, tree)
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen([sys.executable, *own], cwd=of, env=environment(of), stdout=told, stderr=told)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        told.seek(0)
        lines = told.read().decode(errors="replace").strip().splitlines()
    if process.returncode == BAD_INPUT or (process.returncode and (arguments[:2] != COMMAND or TRACEBACK in lines)):
        raise CalibrationError(f"{' '.join(arguments)} of {tree}: {lines[-1:]}")
    if arguments == NODE:
        cells = lines[-1].strip("| ").split(" | ")
        return {"cores": float(np.mean([float(share) for share in cells[1].split()])), "MB": float(cells[-2].split(",")[0])}
    return {"CPU s": float(lines[-1]) if FEATURES in arguments else usage.ru_utime + usage.ru_stime}


def rows_of(name: str, by_tree: Sequence[Sequence[dict[str, float]]]) -> list[list[str]]:
    """Of a stage, from the runs of each version: least, median and most, and the ratio of the medians of two."""
    rows = []
    for unit in by_tree[0][0]:
        values = np.array([[run[unit] for run in runs] for runs in by_tree])
        medians = np.median(values, axis=1)
        cells = [f"{own.min():.3g} {middle:.3g} {own.max():.3g}" for own, middle in zip(values, medians, strict=True)]
        rows.append([name, unit, *cells, *([f"{medians[1] / medians[0]:.2f}"] if len(values) > 1 else [])])
    return rows


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="synthetic:frames=20", help="as for calib-ros (default synthetic)")
    parser.add_argument("--base", metavar="COMMIT", help="the version beside which this one is measured")
    parser.add_argument("--runs", type=int, default=5, metavar="N", choices=range(1, 100), help="of every stage (default 5)")
    parser.add_argument("--only", nargs="+", metavar="STAGE", help="stages whose names begin so")
    args = parser.parse_args()
    try:
        source = open_dataset(args.source)
        if source.reference is None:
            parser.error(f"{source.name} states no reference extrinsic; give KITTI, a bag with /tf_static, or synthetic")
        with tempfile.TemporaryDirectory(prefix="calib_ros_bench_") as folder:
            asked = stages(source, Path(folder))
            chosen = [name for name in asked if not args.only or name.startswith(tuple(args.only))]
            if not chosen:
                parser.error(f"--only {' '.join(args.only)}: no stage begins so; there are {'; '.join(asked)}")
            trees = [side(commit) for commit in ([args.base] if args.base else []) + [WORKING_TREE]]
            rows = list[list[str]]()
            for name in tqdm(chosen, disable=not sys.stderr.isatty()):
                runs = [[measured(asked[name], tree) for tree in trees] for _ in range(args.runs)]
                rows += rows_of(name, list(zip(*runs, strict=True)))
    except CalibrationError as error:
        parser.error(str(error))
    print(f"{source.name}: least, median and most of {args.runs} runs")
    print(markdown(["stage", "unit", *([args.base, "this", "this / base"] if args.base else ["this"])], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
