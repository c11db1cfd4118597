"""Which jobs make up an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros_evaluation.experiments.setup import SourceSummary, shared_out, spread
from calib_ros_evaluation.results import SET, EvaluationJob, job

Options = dict[str, float | int | str]
Wanted = tuple[str, Sequence[int], Sequence[str], Options]
AVERAGED = ("thesis", "ours")  # whose curves are averaged
TRUSTED = "levinson"  # whose test of a calibration is tried
EXPERIMENTS = ("curves", "single", "starts", "frames", "averaging", "similarity", "cost", "trust")  # in the order of the report
TOGETHER = 8  # jobs given to a worker at once; so many are lost at most when it is killed


@dataclass(frozen=True)
class Plan:
    """Sizes of the experiments. start: of single frames and sets, deg and m per axis. sizes: of the start errors compared."""

    curve_frames: int = 12
    curve_samples: int = 41
    curve_reach: tuple[float, float] = (2.0, 0.3)
    single_frames: int = 44
    start: tuple[float, float] = (2.0, 0.2)
    repeats: int = 1
    size_frames: int = 10
    sizes: tuple[tuple[float, float], ...] = ((0.5, 0.05), (1.0, 0.1), (2.0, 0.2), (5.0, 0.3), (10.0, 0.5))
    counts: tuple[int, ...] = (1, 2, 5, 10)
    sets: int = 5
    averaged_frames: int = 10
    cost_frames: int = 3
    trust_frames: int = 24
    seed: int = 0


FULL = Plan()
QUICK = Plan(
    curve_frames=3,
    curve_samples=21,
    single_frames=5,
    size_frames=2,
    sizes=((0.5, 0.05), (2.0, 0.2)),
    counts=(1, 4),
    sets=1,
    averaged_frames=4,
    cost_frames=2,
    trust_frames=4,
)


def jobs(
    plan: Plan, summaries: Sequence[SourceSummary], methods: Sequence[str], experiments: Sequence[str]
) -> list[EvaluationJob]:
    """All jobs, in the order of the report."""
    around: Options = {"deg": plan.curve_reach[0], "m": plan.curve_reach[1], "samples": plan.curve_samples}
    largest = max(summaries, key=lambda s: len(s.groups[0]))
    several = [(one.label, group) for one in summaries for group in one.groups if len(group) >= SET]
    # Experiment -> source, frames, methods and options; every method does the same.
    wanted: dict[str, list[Wanted]] = {
        "curves": [(label, [k], methods, around) for label, k in shared_out(summaries, plan.curve_frames)],
        "single": [
            (label, [k], methods, _start(plan.start, plan.seed + n))
            for n in range(plan.repeats)
            for label, k in shared_out(summaries, plan.single_frames)
        ],
        "starts": [
            (label, [k], methods, _start(size, plan.seed))
            for size in plan.sizes
            for label, k in shared_out(summaries, plan.size_frames)
        ],
        "frames": [(*one, methods, _start(plan.start, plan.seed)) for one in _sets(plan, summaries)],
        "averaging": [
            (label, spread(group, plan.averaged_frames), [name for name in AVERAGED if name in methods], around)
            for label, group in several
        ],
        "similarity": [(one.label, one.frames, [""], {}) for one in summaries if len(one.frames) > 1],
        "cost": [(largest.label, spread(largest.groups[0], plan.cost_frames), methods, {})],
        "trust": [
            (label, [k], [TRUSTED] if TRUSTED in methods else [], {"seed": plan.seed})
            for label, k in shared_out(summaries, plan.trust_frames)
        ],
    }
    return [
        job(name, method, label, frames, options)
        for name in EXPERIMENTS
        if name in experiments
        for label, frames, doers, options in wanted[name]
        for method in doers
    ]


def _sets(plan: Plan, summaries: Sequence[SourceSummary]) -> list[tuple[str, tuple[int, ...]]]:
    """Sets of frames of one calibration, drawn by the seed; of every source that has enough, in turn."""
    out = []
    for count in plan.counts:
        large = [(one.label, group) for one in summaries for group in one.groups if len(group) >= count]
        large = [(label, group) for label, group in large if len(group) >= max(plan.counts)] or large
        for k in range(plan.sets if large else 0):
            label, group = large[k % len(large)]
            rng = np.random.default_rng([plan.seed, count, k])
            out.append((label, tuple(sorted(int(i) for i in rng.choice(group, count, replace=False)))))
    return list(dict.fromkeys(out))  # a set that is drawn twice, as that of all frames, is one


def _start(size: tuple[float, float], seed: int) -> Options:
    return {"start_deg": size[0], "start_m": size[1], "seed": seed}


def groups(todo: Sequence[EvaluationJob]) -> list[list[EvaluationJob]]:
    """Jobs that share features together, in an order in which a worker finds frames again that it has read."""
    out: dict[tuple[object, ...], list[EvaluationJob]] = {}
    for one in sorted(todo, key=lambda j: (j.scene, j.frames, j.method)):
        alone = one.key if one.experiment == "cost" else ""  # measured with features made anew
        out.setdefault((one.scene, one.frames, one.method, alone), []).append(one)
    return [whole[k : k + TOGETHER] for whole in out.values() for k in range(0, len(whole), TOGETHER)]
