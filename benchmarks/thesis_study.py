"""The thesis's objective against the fast form on scenes with a known extrinsic.

    python -m benchmarks.thesis_study OUT SOURCE[@POSITIONS] ...
    e.g. study synthetic drive_0005_sync@0,9,19,28 sequences/00@0,3,6,9

SOURCE as for calib-ros, POSITIONS as for its --frames. Prints Markdown tables: where the curves over the six axes peak, what
density completion fills and how far it is off, what an evaluation costs, and where optimisers end from the same wrong starts.
Writes OUT/curves.png. Times are CPU of one core; compare them within one run.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.positions import frame_positions
from calib_ros.frame import Frame
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.objective import FastObjective, Objective
from calib_ros.registration.score.point_score import Score, nearest_per_pixel, project
from calib_ros_evaluation.curves import AXES, Curves, curves
from calib_ros_thesis.config import ThesisConfig, thesis_of
from calib_ros_thesis.features import ThesisFeatures
from calib_ros_thesis.maps import DEPTH_UNITS, complete_depth, far_level
from calib_ros_thesis.objective import ThesisObjective
from calib_ros_thesis.score import registration_maps

THESIS = Config.from_dict({"refine": {"objective": "thesis"}})
PLAIN = Config.from_dict({"refine": {"objective": "thesis"}, "thesis": {"normalize": False}})
STARTS, START_DEG, START_M = 10, 1.0, 0.1
START_SCENES = 3
METHODS: dict[str, dict[str, Any]] = {
    "eq. 3.12, Nelder-Mead": {"refine": {"objective": "thesis", "optimizer": "nelder_mead"}},
    "eq. 3.12, Barzilai-Borwein": {"refine": {"objective": "thesis", "optimizer": "barzilai_borwein"}},
    "eq. 3.12 not normalised, Nelder-Mead": {
        "refine": {"objective": "thesis", "optimizer": "nelder_mead"},
        "thesis": {"normalize": False},
    },
    "edges attached, Levenberg-Marquardt": {"refine": {"objective": "thesis"}, "thesis": {"dense_edges": "once_per_level"}},
    "fast form": {},
}


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A frame, its features for both forms, and what is true."""

    name: str
    frame: Frame
    features: ThesisFeatures
    T: np.ndarray


def scenes(argument: str) -> list[Scene]:
    """The scenes of SOURCE[@POSITIONS]."""
    text, _, positions = argument.partition("@")
    source = open_dataset(text)
    found = []
    for i in frame_positions(positions or "all", len(source)):
        frame = source[i]
        T = frame.reference if frame.reference is not None else source.reference
        if T is None:
            sys.exit(f"thesis_study: {source.name} states no reference extrinsic")
        features = FeatureExtractor(frame.camera, THESIS)(frame)
        assert isinstance(features, ThesisFeatures)
        found.append(Scene(f"{Path(source.name).name} {frame.name}", frame, features, T))
    return found


def table(head: list[str], rows: list[list[Any]]) -> None:
    """A Markdown table."""
    print("\n| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(str(cell) for cell in row) + " |")
    sys.stdout.flush()


def peaks(all_scenes: list[Scene], out: Path) -> None:
    """Where the curves peak, scene by scene."""
    found: dict[str, list[Curves]] = {}
    rows = []
    for scene in tqdm(all_scenes, "curves", disable=not sys.stderr.isatty()):
        normalised, plain = (ThesisObjective([scene.features], scene.T, config) for config in (THESIS, PLAIN))
        scores: dict[str, Score] = {
            "eq. 3.12 as a sum": plain.score.at(-1),
            "eq. 3.12 normalised": normalised.score.at(-1),
            "edges attached": normalised.score.attached(scene.T).at(-1),
            "fast form": normalised.fast.score.at(-1),
        }
        for name, score in scores.items():
            found.setdefault(name, []).append(curves(score, scene.T))
            rows.append([scene.name, name, *(f"{p:+.2f}" for p in found[name][-1].peaks)])
    units = [f"{axis} ({'deg' if axis[0] == 'r' else 'cm'})" for axis in AXES]
    table(["scene", "score", *units], rows)
    summary = []
    for name, own in found.items():
        off = np.abs([c.peaks for c in own])
        summary.append([name, *(f"{m:.2f}" for m in off.mean(axis=0))])
    table(["mean distance of the peak from the truth", *units], summary)
    plot(found, units, out / "curves.png")


def plot(found: dict[str, list[Curves]], units: list[str], path: Path) -> None:
    """All curves, a row per score."""
    figure = Figure(figsize=(16, 2.6 * len(found)), layout="constrained")
    axes = figure.subplots(len(found), 6, sharey=True, squeeze=False)
    for row, (name, own) in zip(axes, found.items(), strict=True):
        for k, axis in enumerate(row):
            for curve in own:
                axis.plot(curve.offsets[k], curve.scaled()[k], linewidth=0.9, alpha=0.7)
            axis.axvline(0, color="k", linewidth=0.6)
            axis.set_xlabel(units[k])
        row[0].set_ylabel(name)
    figure.suptitle("scores over the six axes around the truth, one line per scene, each from its lowest to its highest")
    figure.savefig(path, dpi=90)


def completion(all_scenes: list[Scene]) -> None:
    """Share of filled pixels below the horizon, and the error at every fifth projected point, held out."""
    rows = []
    for scene in all_scenes:
        points, camera = scene.features.points, scene.features.camera
        size, shape = camera.height * camera.width, (camera.height, camera.width)
        u, v, inside = project(points.xyz, scene.T, camera)
        pixels, kept = nearest_per_pixel(v * camera.width + u, inside, size)
        held = np.random.default_rng(0).permutation(np.arange(len(pixels)) % 5 == 0)
        depth = np.rint(points.depth[kept] * DEPTH_UNITS).astype(np.int16)
        sparse = np.zeros(size, np.int16)
        sparse[pixels[~held]] = depth[~held]
        dense = complete_depth(sparse.reshape(shape), far_level(thesis_of(THESIS)))
        off = np.abs(dense.ravel()[pixels[held]] - depth[held]) / DEPTH_UNITS
        horizon = int(np.clip(camera.K[1, 2], 0, camera.height - 1))
        filled = [f"{100 * np.mean(m.reshape(shape)[horizon:] > 0):.1f} %" for m in (sparse, dense)]
        rows.append([scene.name, *filled, f"{np.median(off):.3f}", f"{np.percentile(off, 90):.3f}", int(held.sum())])
    table(["scene", "filled before", "after", "error median (m)", "90 % (m)", "held out"], rows)


def cpu_ms(*runs: Callable[[], Any], repeat: int = 30) -> list[float]:
    """Least CPU time of each of several calls. They take turns, so that a slow phase of the machine falls on all of them."""
    best = [np.inf] * len(runs)
    for _ in range(repeat):
        for k, run in enumerate(runs):
            start = time.process_time()
            run()
            best[k] = min(best[k], time.process_time() - start)
    return [1e3 * t for t in best]


def written_out(features: ThesisFeatures, T: np.ndarray, config: ThesisConfig) -> float:
    """J of eq. 3.12 as it stands in the thesis."""
    return registration_maps(features, T, config).edge_registration_score()


def costs(all_scenes: list[Scene]) -> None:
    """Eq. 3.12 written out, fast, and attached; and whether the first two are equal."""
    rows = []
    rng = np.random.default_rng(0)
    for scene in all_scenes[:START_SCENES]:
        fast = ThesisObjective([scene.features], scene.T, PLAIN).score
        near = [se3.perturb(scene.T, rng.uniform(-3, 3, 3), rng.uniform(-0.3, 0.3, 3)) for _ in range(20)]
        difference = max(abs(fast.at(-1).value(T) / written_out(scene.features, T, thesis_of(PLAIN)) - 1) for T in near)
        features, T, plain = scene.features, scene.T, thesis_of(PLAIN)
        attached = fast.attached(T).at(-1)
        before, after, last = cpu_ms(
            partial(written_out, features, T, plain), partial(fast.at(-1).value, T), partial(attached.value, T)
        )
        rows.append([scene.name, f"{before:.1f}", f"{after:.1f}", f"{before / after:.1f}", f"{difference:.1e}", f"{last:.2f}"])
    table(["scene", "written out (ms)", "fast (ms)", "ratio", "largest relative difference", "attached (ms)"], rows)


def optimised(case: list[Scene], start: np.ndarray, config: Config) -> np.ndarray:
    """Where the optimiser ends, judged good or not: what a gate makes of it is another question."""
    objective: Objective
    if config.refine.objective == "thesis":
        objective = ThesisObjective([scene.features for scene in case], start, config)
    else:
        objective = FastObjective([scene.features for scene in case], start, config)
    return objective.optimise(start)


def starts(groups: list[list[Scene]]) -> None:
    """Errors after refinement from the same wrong starts, each scene alone and the scenes of a source together."""
    rows = []
    singles = [[scene] for group in groups for scene in group][:START_SCENES]
    cases = singles + [group[:START_SCENES] for group in groups if len(group) > 1]
    for case in tqdm(cases, "starts", disable=not sys.stderr.isatty()):
        T = case[0].T
        rng = np.random.default_rng(0)
        begin = [se3.perturb(T, rng.uniform(-START_DEG, START_DEG, 3), rng.uniform(-START_M, START_M, 3)) for _ in range(STARTS)]
        for name, values in METHODS.items():
            before = time.process_time()
            ends = [optimised(case, start, Config.from_dict(values)) for start in begin]
            seconds = (time.process_time() - before) / STARTS
            deg = [se3.rotation_error_deg(T, end) for end in ends]
            cm = [100 * se3.translation_error_m(T, end) for end in ends]
            good = sum(d < 0.5 and c < 10 for d, c in zip(deg, cm, strict=True))
            label = case[0].name if len(case) == 1 else f"{case[0].name.split()[0]}, {len(case)} scenes together"
            spread = [f"{np.median(deg):.2f} / {max(deg):.2f}", f"{np.median(cm):.1f} / {max(cm):.1f}"]
            rows.append([label, name, *spread, f"{good}/{STARTS}", f"{seconds:.2f}"])
    head = ["scenes", "method", "deg median / worst", "cm median / worst", "within 0.5 deg and 10 cm", "CPU s per start"]
    table(head, rows)


def main() -> int:
    """Run all on the sources of the command line."""
    if len(sys.argv) < 3:
        print(__doc__, file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    groups = [scenes(argument) for argument in sys.argv[2:]]
    all_scenes = [scene for group in groups for scene in group]
    peaks(all_scenes, out)
    completion(all_scenes)
    costs(all_scenes)
    starts(groups)
    return 0


if __name__ == "__main__":
    sys.exit(main())
