"""What more frames cost: CPU time of each step of the registration against the number of frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.constraints import SearchBox
from calib_ros.registration.features import Features, FrameFeatures
from calib_ros.registration.score import FastScore

COUNTS = (1, 5, 20, 50, 100)
PER_FRAME = "features, per frame"
SEARCH = "search in 10 deg / 0.5 m"
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


def cost_of_frames(frames: Sequence[Frame], reference: NDArray[np.float64]) -> Costs:
    """CPU times of every step for COUNTS frames; where there are fewer, they come again."""
    calibrator = Calibrator(frames[0].camera)
    costs: Costs = {}
    calibrator.extract(frames[0])
    unique: list[Features] = []
    for n in COUNTS:
        began = time.process_time()
        unique = [calibrator.extract(frame) for frame in islice(cycle(frames), n)][: len(frames)]
        costs.setdefault(PER_FRAME, []).append(1e3 * (time.process_time() - began) / n)
    for n in COUNTS:
        # The same objects again: only the atlas of the score holds maps for every frame, about 9 MB each.
        features = [f for f in islice(cycle(unique), n) if isinstance(f, FrameFeatures)]
        for step, ms in _of(calibrator, features, reference).items():
            costs.setdefault(step, []).append(ms)
    return costs


def _of(calibrator: Calibrator, features: list[FrameFeatures], reference: NDArray[np.float64]) -> dict[str, float]:
    level = FastScore(features, reference, Config().score).at(-1)
    repeat = max(200 // len(features), 9)
    start = se3.perturb(reference, np.full(3, 0.5), np.full(3, 0.05))
    far = se3.perturb(reference, np.full(3, 5.0), np.full(3, 0.25))
    return {
        "one score": cpu_ms(partial(level.value, reference), repeat),
        "one score with slope": cpu_ms(partial(level.linearise, reference), repeat),
        "refinement": cpu_ms(partial(calibrator.estimate, features, start), 3),
        SEARCH: cpu_ms(partial(calibrator.estimate, features, far, SearchBox(10.0, 0.5)), 1),
    }


def slope(ms: Sequence[float]) -> float:
    """Of log cost over log frames: 1 = in proportion to the frames, 0 = the same for any number."""
    return float(np.polyfit(np.log(COUNTS), np.log(ms), 1)[0])


def table(costs: Costs) -> str:
    """As Markdown."""
    lines = [f"| CPU ms, frames: | {' | '.join(map(str, COUNTS))} | slope |", "|---" * (len(COUNTS) + 2) + "|"]
    for step, ms in costs.items():
        lines.append(
            f"| {step} | {' | '.join(f'{value:.3g}' if value < 100 else f'{value:.0f}' for value in ms)} | {slope(ms):.2f} |"
        )
    return "\n".join(lines)


def plot(costs: Costs, path: str, source: str) -> None:
    """Both axes logarithmic, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), dpi=140, layout="constrained")
    axes = figure.subplots()
    for step, ms in costs.items():
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
