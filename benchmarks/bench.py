"""Speed: features, classes, scores, calibration, the thesis's objective. CPU times, medians.

    python -m benchmarks.bench [SOURCE] [--only PART]

SOURCE: by default the synthetic drive; a KITTI folder or a bag gives real frames.
"""

from __future__ import annotations

import argparse
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle, islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import CLOUD, IMAGE
from calib_ros.registration.features import FeatureExtractor, FrameFeatures, points_in_reach
from calib_ros.registration.objective import FastScore
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.maps import complete_depth, complete_fast, far_level
from calib_ros_thesis.score import ThesisScore, registration_maps

FRAMES = 20
REPEATS = 5
PARTS = ["classes", "cost", "thesis"]
COUNTS = (1, 5, 10, 20, 50, 100)
PER_FRAME = "features, per frame"
SEARCH = "search in 10 deg / 0.5 m"
MEMORY = "MB that a refinement takes, beside the keyframes"
Costs = dict[str, list[float]]  # step -> CPU ms for each of COUNTS


def cpu_ms(run: Callable[[], Any], repeat: int) -> float:
    """Median CPU time of a call in ms, after one call to warm up."""
    run()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def told(label: str, ms: float, note: str = "") -> None:
    """Print a figure."""
    print(f"{label:<64} {ms:9.3f} ms  {note}".rstrip(), flush=True)


def classes(frames: list[Frame], reference: np.ndarray) -> None:
    """Of one frame: all of its points, and those that may come into view."""
    calibrator = Calibrator(frames[0].camera)
    frame, segmentation = frames[0], calibrator.segmentation
    box = SearchBox(10.0, 0.5)
    told("classes of one frame, the network", cpu_ms(lambda: segmentation(frame, kinds=[IMAGE]), REPEATS))
    told("classes of one frame, all points", cpu_ms(lambda: segmentation(frame, kinds=[CLOUD]), REPEATS))
    points = points_in_reach(frame, calibrator.extract, reference, box)
    told(
        "classes of one frame, points that may come into view",
        cpu_ms(lambda: segmentation(frame, kinds=[CLOUD], points=points), REPEATS),
        f"within {box.reach[0]:g} deg / {box.reach[1]:g} m",
    )


def cost_of_frames(frames: Sequence[Frame], reference: NDArray[np.float64]) -> Costs:
    """CPU times of every step for COUNTS frames; where there are fewer, they come again."""
    calibrator = Calibrator(frames[0].camera)
    costs: Costs = {}
    calibrator.extract(frames[0])
    unique: list[FrameFeatures] = []
    for n in COUNTS:
        began = time.process_time()
        unique = [calibrator.extract(frame) for frame in islice(cycle(frames), n)][: len(frames)]
        costs.setdefault(PER_FRAME, []).append(1e3 * (time.process_time() - began) / n)
    for n in COUNTS:
        # The same objects again: only the atlas of the score holds maps for every frame, about 9 MB each.
        features = list(islice(cycle(unique), n))
        for step, ms in _steps(calibrator, features, reference).items():
            costs.setdefault(step, []).append(ms)
    return costs


def _steps(calibrator: Calibrator, features: list[FrameFeatures], reference: NDArray[np.float64]) -> dict[str, float]:
    level = FastScore(features, reference, Config().score).at(-1)
    repeat = max(200 // len(features), 9)
    start = se3.perturb(reference, np.full(3, 0.5), np.full(3, 0.05))
    tracemalloc.start()
    calibrator.estimate(features, start)
    peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    far = se3.perturb(reference, np.full(3, 5.0), np.full(3, 0.25))
    return {
        "one score": cpu_ms(partial(level.value, reference), repeat),
        "one score with slope": cpu_ms(partial(level.linearise, reference), repeat),
        "refinement": cpu_ms(partial(calibrator.estimate, features, start), 3),
        MEMORY: peak_mb,
        SEARCH: cpu_ms(partial(calibrator.estimate, features, far, SearchBox(10.0, 0.5)), 1),
    }


def slope(ms: Sequence[float]) -> float:
    """Of log cost over log frames: 1 = in proportion to the frames, 0 = the same for any number."""
    return float(np.polyfit(np.log(COUNTS), np.log(ms), 1)[0])


def cost_table(costs: Costs) -> str:
    """As Markdown."""
    lines = [f"| CPU ms of one core; frames: | {' | '.join(map(str, COUNTS))} | slope |", "|---" * (len(COUNTS) + 2) + "|"]
    for step, ms in costs.items():
        lines.append(
            f"| {step} | {' | '.join(f'{value:.3g}' if value < 100 else f'{value:.0f}' for value in ms)} | {slope(ms):.2f} |"
        )
    return "\n".join(lines)


def thesis(frame: Frame, reference: np.ndarray) -> None:
    """Eq. 3.12: features, density completion, one evaluation written out, fast and with its edges attached."""
    config = Config.from_dict({"refine": {"objective": "thesis"}})
    extract = FeatureExtractor(frame.camera, config)
    told("thesis: features of one frame", cpu_ms(lambda: extract(frame), 5))
    features = extract(frame)
    maps = registration_maps(features.own, reference, thesis_of(config))
    sparse, far = maps.lidar.sparse_reflectivity, far_level(thesis_of(config))
    height, width = sparse.shape
    size = f"{width}x{height}; IP-Basic takes about 7 ms for a KITTI map"
    told("thesis: depth map completed, written out", cpu_ms(lambda: complete_depth(sparse, far), 25), size)
    told("thesis: depth map completed, fast", cpu_ms(lambda: complete_fast(sparse, far + 1), 25), size)
    score = ThesisScore([features.own], reference, config)
    written_out = cpu_ms(lambda: registration_maps(features.own, reference, thesis_of(config)).edge_registration_score(), 25)
    fast = cpu_ms(lambda: score.at(-1).value(reference), 25)
    attached = score.attached(reference).at(-1)
    told("thesis: eq. 3.12 of one frame, written out", written_out)
    told("thesis: eq. 3.12 of one frame, fast", fast, f"{written_out / fast:.1f} times faster")
    told("thesis: the same with edges attached to the points", cpu_ms(lambda: attached.value(reference), 200))


def main() -> int:
    """Run the benchmarks on the source named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=f"synthetic:frames={FRAMES}", help="as for calib-ros (default synthetic)")
    parser.add_argument("--only", choices=PARTS, action="append", help="run this part only; may be given again")
    args = parser.parse_args()
    parts = args.only or PARTS
    source = open_dataset(args.source)
    if source.reference is None:
        parser.error(f"{source.name} states no reference extrinsic; give KITTI, a bag with /tf_static, or synthetic")
    print(f"{source.name}, {min(FRAMES, len(source))} frames")
    chosen = np.linspace(0, len(source) - 1, min(FRAMES, len(source))).round().astype(int)
    frames = [source[int(i)] for i in chosen]
    cv2.setNumThreads(1)
    if "classes" in parts:
        classes(frames, source.reference)
    if "cost" in parts:
        print(cost_table(cost_of_frames(frames, source.reference)))
    if "thesis" in parts:
        thesis(frames[0], source.reference)
    return 0


if __name__ == "__main__":
    sys.exit(main())
