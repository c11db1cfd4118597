"""Speed: features, classes, scores, calibration, commands, the thesis's objective. CPU times, medians.

    python -m benchmarks.bench [SOURCE] [--plot FILE] [--only PART] [--json FILE] [--compare FILE] [--beside COMMAND]

SOURCE: by default the synthetic drive; a KITTI folder or a bag gives real frames. --plot draws cost against the number of frames
(docs/cost.png). --json saves the figures, and --compare sets them beside those that another run has saved. Machines differ and
are shared: a yardstick, work of OpenCV and NumPy that never changes, is measured as well, and ratios to a saved run are corrected
by it. --beside: CPU time of another program in the same run, to compare with the command `calib-ros calibrate`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import shlex
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle, islice
from pathlib import Path
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
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.registration.frames import points_in_reach
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.maps import DensityCompletion, complete_depth, far_level
from calib_ros_thesis.score import ThesisScore, registration_maps

FRAMES = 20
SEARCH_FRAMES = 16
STARTS = 5
COMMAND_FRAMES = 10
REPEATS = 5
PARTS = ["registration", "classes", "commands", "cost", "thesis"]
COUNTS = (1, 5, 20, 50, 100)
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


@dataclasses.dataclass
class Figures:
    """What this run has measured, ms by name, and what another one had; None = nothing to compare with."""

    ms: dict[str, float] = dataclasses.field(default_factory=dict)
    before: dict[str, float] | None = None

    def add(self, label: str, ms: float, note: str = "") -> None:
        """Note and print a figure."""
        self.ms[label] = ms
        then, compared = (self.before or {}).get(label), ""
        if then is not None and self.before is not None:
            slower = self.ms[YARDSTICK] / self.before[YARDSTICK] if YARDSTICK in self.before else 1.0
            compared = f"  before {then:9.3f}, ratio {ms / then / slower:5.2f}"
        row(label, f"{ms:9.3f} ms{compared}{'  ' + note if note else ''}")


YARDSTICK = "yardstick"
FIGURES = Figures()


def row(label: str, value: str) -> None:
    print(f"{label:<64} {value}", flush=True)


def yardstick() -> None:
    """Work that is the same in every version of the package."""
    values = np.random.default_rng(0).random((512, 512), np.float32)
    FIGURES.add(YARDSTICK, cpu_ms(lambda: np.sort(cv2.GaussianBlur(values, (0, 0), 5.0), axis=None), 25))


def errors(reference: np.ndarray, T: np.ndarray) -> str:
    return f"{se3.rotation_error_deg(reference, T):.3f} deg {100 * se3.translation_error_m(reference, T):.2f} cm"


def registration(frames: list[Frame], reference: np.ndarray) -> None:
    """Features, score and calibration on one core."""
    calibrator = Calibrator(frames[0].camera)
    FIGURES.add("features of one frame", cpu_ms(lambda: calibrator.extract(frames[0]), 9))
    features = [calibrator.extract(frame) for frame in frames]
    for n in (1, len(features)):
        score = FastScore(list(features[:n]), reference, Config().score)
        points = score.points.shape[1]
        level = score.at(-1)
        FIGURES.add(f"one score of {n} frames", cpu_ms(partial(level.value, reference), 200), f"{points} edge points")
        FIGURES.add(f"one score with slope of {n} frames", cpu_ms(partial(level.linearise, reference), 50))
    for n in (1, len(features)):
        _calibrations(f"refinement from 1 deg / 0.1 m, {n} frames", calibrator, features[:n], reference, None)
    chosen = features[:: max(len(features) // SEARCH_FRAMES, 1)][:SEARCH_FRAMES]
    for box in (SearchBox(3.0, 0.3), SearchBox(10.0, 0.5)):
        label = f"search from +-{box.reach[0]:g} deg / {box.reach[1]:g} m, {len(chosen)} frames"
        _calibrations(label, calibrator, chosen, reference, box)


def classes(frames: list[Frame], reference: np.ndarray) -> None:
    """Of one frame: all of its points, and those that may come into view."""
    calibrator = Calibrator(frames[0].camera)
    frame, segmentation = frames[0], calibrator.segmentation
    box = SearchBox(10.0, 0.5)
    FIGURES.add("classes of one frame, the network", cpu_ms(lambda: segmentation(frame, kinds=[IMAGE]), REPEATS))
    FIGURES.add("classes of one frame, all points", cpu_ms(lambda: segmentation(frame, kinds=[CLOUD]), REPEATS))
    points = points_in_reach(frame, calibrator.extract, reference, box)
    FIGURES.add(
        "classes of one frame, points that may come into view",
        cpu_ms(lambda: segmentation(frame, kinds=[CLOUD], points=points), REPEATS),
        f"within {box.reach[0]:g} deg / {box.reach[1]:g} m",
    )


def commands(source: str, frames: int, beside: str | None) -> None:
    """CPU times of whole processes, from start to end."""
    python, spread = [sys.executable], np.linspace(0, frames - 1, min(COMMAND_FRAMES, frames)).round().astype(int)
    chosen = ",".join(map(str, spread))
    calibrate = ["-m", "calib_ros", "calibrate", source, "--frames", chosen, "--search-deg", "10", "--search-m", "0.5"]
    for label, command in (
        ("import calib_ros", [*python, "-c", "import calib_ros"]),
        ("calib-ros --help", [*python, "-m", "calib_ros", "--help"]),
        (f"calib-ros calibrate, {len(spread)} frames from 10 deg / 0.5 m", [*python, *calibrate]),
        ("beside it", shlex.split(beside) if beside else []),
    ):
        if command:
            FIGURES.add(label, float(np.median([process_ms(command) for _ in range(REPEATS)])))


def process_ms(command: Sequence[str]) -> float:
    """CPU time of a process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode not in (0, 1):  # 1: not converged, which takes as long
        raise SystemExit(f"bench: '{shlex.join(command)}' failed: {done.stderr.strip()[-300:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def _calibrations(
    label: str, calibrator: Calibrator, features: Sequence[FrameFeatures], reference: np.ndarray, box: SearchBox | None
) -> None:
    """Median over random starts: 1 deg / 0.1 m away, or anywhere in the box."""
    rng = np.random.default_rng(0)
    times, ends = [], []
    for _ in range(STARTS):
        away = (_on_sphere(rng, 1.0), _on_sphere(rng, 0.1)) if box is None else _in_box(rng, box)
        start = se3.perturb(reference, *away)
        began = time.process_time()
        ends.append(calibrator.estimate(features, start, box).T_camera_lidar)
        times.append(time.process_time() - began)
    found = sorted(ends, key=lambda T: se3.rotation_error_deg(reference, T))
    FIGURES.add(label, 1e3 * float(np.median(times)), f"median {errors(reference, found[STARTS // 2])}")


def _in_box(rng: np.random.Generator, box: SearchBox) -> tuple[np.ndarray, np.ndarray]:
    deg, m = box.reach
    return rng.uniform(-deg, deg, 3), rng.uniform(-m, m, 3)


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


def plot_costs(costs: Costs, path: str, source: str) -> None:
    """Both axes logarithmic, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), dpi=140, layout="constrained")
    axes = figure.subplots()
    for step, ms in costs.items():
        if step == MEMORY:
            continue
        (drawn,) = axes.loglog(COUNTS, ms, "o-", ms=4, lw=1.5)
        axes.annotate(
            f"{step}, slope {slope(ms):.2f}", (COUNTS[-1], ms[-1]), (6, 0), textcoords="offset points", va="center",
            color=drawn.get_color(), fontsize=8,
        )  # fmt: skip
    axes.set_xlim(0.9, 900)
    axes.set_xticks(COUNTS, [str(n) for n in COUNTS])
    axes.minorticks_off()
    axes.set_xlabel("frames")
    axes.set_ylabel("CPU time of one core, ms")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(source, fontsize=9, loc="left")
    figure.savefig(path)


def thesis(frame: Frame, reference: np.ndarray) -> None:
    """Eq. 3.12: features, density completion, one evaluation written out, fast and with its edges attached."""
    config = Config.from_dict({"refine": {"objective": "thesis"}})
    extract = FeatureExtractor(frame.camera, config)
    FIGURES.add("thesis: features of one frame", cpu_ms(lambda: extract(frame), 5))
    features = extract(frame)
    maps = registration_maps(features.own, reference, thesis_of(config))
    sparse, far = maps.lidar.sparse_reflectivity, far_level(thesis_of(config))
    height, width = sparse.shape
    size = f"{width}x{height}; IP-Basic takes about 7 ms for a KITTI map"
    FIGURES.add("thesis: depth map completed, written out", cpu_ms(lambda: complete_depth(sparse, far), 25), size)
    completion = DensityCompletion(sparse.size)
    FIGURES.add("thesis: depth map completed, fast", cpu_ms(lambda: completion.depth(sparse, far), 25), size)
    score = ThesisScore([features.own], reference, config)
    written_out = cpu_ms(lambda: registration_maps(features.own, reference, thesis_of(config)).edge_registration_score(), 25)
    fast = cpu_ms(lambda: score.at(-1).value(reference), 25)
    attached = score.attached(reference).at(-1)
    FIGURES.add("thesis: eq. 3.12 of one frame, written out", written_out)
    FIGURES.add("thesis: eq. 3.12 of one frame, fast", fast, f"{written_out / fast:.1f} times faster")
    FIGURES.add("thesis: the same with edges attached to the points", cpu_ms(lambda: attached.value(reference), 200))


def _on_sphere(rng: np.random.Generator, radius: float) -> np.ndarray:
    v = rng.normal(size=3)
    return np.asarray(radius * v / np.linalg.norm(v))


def main() -> int:
    """Run the benchmarks on the source named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=f"synthetic:frames={FRAMES}", help="as for calib-ros (default synthetic)")
    parser.add_argument("--plot", metavar="FILE", help="draw cost against the number of frames")
    parser.add_argument("--only", choices=PARTS, action="append", help="run this part only; may be given again")
    parser.add_argument("--json", metavar="FILE", type=Path, help="save the figures")
    parser.add_argument("--compare", metavar="FILE", type=Path, help="figures of another run, to set beside")
    parser.add_argument("--beside", metavar="COMMAND", help="another program whose CPU time is to be measured")
    args = parser.parse_args()
    if args.compare:
        try:
            FIGURES.before = {str(k): float(v) for k, v in json.loads(args.compare.read_text()).items()}
        except (OSError, ValueError, AttributeError, TypeError) as error:
            print(f"bench: {args.compare} holds no figures ({error}); save some with --json", file=sys.stderr)
            return 2
    parts = args.only or PARTS
    source = open_dataset(args.source)
    if source.reference is None:
        parser.error(f"{source.name} states no reference extrinsic; give KITTI, a bag with /tf_static, or synthetic")
    print(f"{source.name}, {min(FRAMES, len(source))} frames")
    chosen = np.linspace(0, len(source) - 1, min(FRAMES, len(source))).round().astype(int)
    frames = [source[int(i)] for i in chosen]
    cv2.setNumThreads(1)
    yardstick()
    if "registration" in parts:
        registration(frames, source.reference)
    if "classes" in parts:
        classes(frames, source.reference)
    if "commands" in parts:
        commands(args.source, len(source), args.beside)
    if "cost" in parts or args.plot:
        costs = cost_of_frames(frames, source.reference)
        print(cost_table(costs))
        for step, values in costs.items():
            FIGURES.ms |= {f"{step}, {n} frames": ms for n, ms in zip(COUNTS, values, strict=True)}
        if args.plot:
            plot_costs(costs, args.plot, source.name)
    if "thesis" in parts:
        thesis(frames[0], source.reference)
    if args.json:
        args.json.write_text(json.dumps(FIGURES.ms, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
