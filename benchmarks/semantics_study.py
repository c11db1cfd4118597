"""What masks and classes bring the registration: the figures behind the defaults of the stage semantics.

    python -m benchmarks.semantics_study [ROW ...] [--kitti FOLDER] [--starts 20] [--plot PNG] [--cache FILE]

ROW: masks, weights; default both. A start is the reference, disturbed uniformly by up to 3 deg and 20 cm per axis, with a search
of that size; a trial is a success within 0.5 deg and 10 cm.

Sources: "odometry 000000" is the one KITTI frame with masks of Segment Anything and labels of its points; the class of its pixels
is that of most labelled points in their mask under the reference: the borders of classes are those of masks, but not independent
of the reference. "synthetic": 20 streets, the exact classes of points and pixels; masks are the connected regions of each class
from 100 pixels on, so they are as good as masks can be.
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.first_guess_study import kitti_scenes
from benchmarks.registration_study import SUCCESS_DEG, SUCCESS_M
from calib_ros import se3
from calib_ros.config import Config, SemanticsConfig, update
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor, Features, FrameFeatures
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.curves import AXES, Curves, curves
from calib_ros_semantics.models.masks import Mask, Masks, mask_edges
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.segment_anything import MaskEdges
from calib_ros_semantics.models.segmentation import FrameSemantics
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.features import ThesisFeatures
from calib_ros_thesis.score import ThesisScore

FIRST_SEED, STREETS, OF_EACH = 60, 20, 3
MIN_AREA = 100  # px; Segment Anything gives hardly a smaller mask
SETS, SET_SIZE, SET_DEG, SET_M = 60, 5, 1.0, 0.1
BOOTSTRAP = 10_000
NOWHERE = (-200.0, 200.0)  # m; stations of a street between which nothing stands
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
HEAD = "| scenes | variant | success | deg median / p90 | cm median / p90 | from the reference, deg / cm | together, deg / cm |"
Errors = NDArray[np.float64]  # (n, 2) deg and cm


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame whose reference is the truth, and what is seen in it."""

    frame: Frame
    semantics: FrameSemantics

    @property
    def T(self) -> NDArray[np.float64]:
        """The truth."""
        assert self.frame.reference is not None
        return self.frame.reference


def table(*head: str) -> None:
    """The head of a Markdown table."""
    print("\n| " + " | ".join(head) + " |\n|" + "---|" * len(head), flush=True)


def error(truth: NDArray[np.float64], T: NDArray[np.float64]) -> tuple[float, float]:
    """deg and cm."""
    return se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T)


def compared(name: str, scenes: Sequence[Scene], variants: dict[str, dict[str, Any]], starts: int, box: SearchBox) -> None:
    """A line for every variant of the configuration: each scene alone from `starts` starts, from its reference, all together."""
    for variant, change in variants.items():
        calibrator = Calibrator(scenes[0].frame.camera, update(Config(), change))
        features = [calibrator.extract(s.frame, s.semantics) for s in scenes]
        found: list[tuple[float, float]] = []
        still: list[tuple[float, float]] = []
        for scene, own in zip(scenes, features, strict=True):
            for _ in range(starts):
                result = calibrator.estimate([own], start(scene.T, len(found), *box.reach), box)
                found.append(error(scene.T, result.T_camera_lidar))
            still.append(error(scene.T, calibrator.estimate([own], scene.T).T_camera_lidar))
        together = error(scenes[0].T, calibrator.estimate(features, scenes[0].T).T_camera_lidar)
        both = [f"{deg:.3f} / {cm:.1f}" for deg, cm in (np.median(still, axis=0), together)]
        print(f"| {name} | {variant} | {spread_of(np.array(found))} | {' | '.join(both)} |", flush=True)


def start(truth: NDArray[np.float64], seed: int, deg: float, m: float) -> NDArray[np.float64]:
    """Where a trial begins."""
    rng = np.random.default_rng(seed)
    return se3.perturb(truth, rng.uniform(-deg, deg, 3), rng.uniform(-m, m, 3))


def spread_of(errors: Errors) -> str:
    """Cells of a table."""
    good = (errors[:, 0] < SUCCESS_DEG) & (errors[:, 1] < 100 * SUCCESS_M)
    deg, cm = (f"{np.median(e):.{d}f} / {np.percentile(e, 90):.{d}f}" for e, d in zip(errors.T, (3, 1), strict=True))
    return f"{good.sum()}/{len(errors)} | {deg} | {cm}"


def street_scenes(cache: Path | None) -> list[Scene]:
    """Frames of all streets, taken by one camera that is mounted alike everywhere; street after street."""
    if cache and cache.is_file():
        scenes: list[Scene] = pickle.loads(cache.read_bytes())
        return scenes
    T = SyntheticDrive(FIRST_SEED, 1).reference
    drives = [SyntheticDrive(FIRST_SEED + k, OF_EACH, speed=0, stride=40, T_camera_lidar=T) for k in range(STREETS)]
    scenes = [exact(drive[k]) for drive in drives for k in range(OF_EACH)]
    if cache:
        cache.write_bytes(pickle.dumps(scenes))
    return scenes


def exact(frame: Frame) -> Scene:
    """With all that the street knows."""
    assert frame.classes is not None
    masks = []
    for c in np.unique(frame.classes):
        own = np.asarray(frame.classes == c)
        regions = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)[1]
        areas = np.bincount(regions.ravel())
        masks += [Mask.of(regions == k) for k in range(1, len(areas)) if areas[k] >= MIN_AREA]
    return Scene(frame, FrameSemantics(mask_edges(Masks.of(frame.classes.shape, masks)), frame.classes, frame.cloud.label))


def kitti_scene(root: Path) -> Scene:
    """The KITTI frame with masks and labels."""
    _, frame = next(kitti_scenes(root))
    edges = MaskEdges(SemanticsConfig(segment_anything=str(root / "sam_masks")))(frame, Deadline(60))
    return Scene(frame, FrameSemantics(edges, frame.classes, frame.cloud.label))


def only_edges(scene: Scene) -> Scene:
    """Without classes."""
    return Scene(scene.frame, FrameSemantics(scene.semantics.edges))


def only_classes(scene: Scene) -> Scene:
    """Without masks."""
    return Scene(scene.frame, FrameSemantics(None, scene.semantics.classes, scene.semantics.labels))


def masks(streets: Sequence[Scene], kitti: Scene | None, starts: int, plot: Path | None) -> None:
    """Semantic edges of Segment Anything: curves, and the shares in the edge maps of both objectives."""
    if kitti and plot:
        mask_curves(only_edges(kitti), plot)
    table(*HEAD.strip("| ").split(" | "))
    compare = partial(compared, box=SearchBox(3, 0.2, 2))
    for share in SHARES:
        with patch("calib_ros.registration.features.EDGE_SHARE", share):
            if kitti:
                compare("odometry 000000", [only_edges(kitti)], {f"share {share:g}": {}}, starts)
            compare("synthetic", [only_edges(s) for s in streets[::OF_EACH]], {f"share {share:g}": {}}, 1)
    thesis = {
        f"eq. 3.12, thesis.semantic_share {s:g}": {"refine": {"objective": "thesis"}, "thesis": {"semantic_share": s}}
        for s in (0.0, 0.5)
    }
    if kitti:
        compare("odometry 000000", [only_edges(kitti)], thesis, max(starts // 4, 1))  # an estimate takes 10 s


def mask_curves(scene: Scene, path: Path) -> None:
    """Scores over the six axes with and without masks, and where they peak."""
    config = Config.from_dict({"refine": {"objective": "thesis"}})
    found: dict[str, dict[str, Curves]] = {"fast score": {}, "eq. 3.12": {}}
    for name, semantics in (("without masks", None), ("with masks", scene.semantics)):
        features = FeatureExtractor(scene.frame.camera, config)(scene.frame, semantics)
        assert isinstance(features, ThesisFeatures)
        found["fast score"][name] = curves(FastScore([features.fast], scene.T, config.score).at(-1), scene.T, 3.0, 0.3)
        found["eq. 3.12"][name] = curves(ThesisScore([features], scene.T, config).at(-1), scene.T, 3.0, 0.3)
    units = [f"{axis} ({'deg' if axis[0] == 'r' else 'cm'})" for axis in AXES]
    table("odometry 000000, peak at", *units)
    figure = Figure(figsize=(16, 5.4), layout="constrained")
    axes = figure.subplots(2, 6, sharey=True)
    for row, (score, pair) in zip(axes, found.items(), strict=True):
        for (name, curve), color in zip(pair.items(), ("#d55e00", "#0072b2"), strict=True):
            print(f"| {score}, {name} | " + " | ".join(f"{p:+.2f}" for p in curve.peaks) + " |", flush=True)
            for k, axis in enumerate(row):
                axis.plot(curve.offsets[k], curve.scaled()[k], color=color, linewidth=1.3, label=name)
                axis.axvline(0, color="0.7", linewidth=0.6)
                axis.set_xlabel(units[k])
        row[0].set_ylabel(score)
        row[0].legend(frameon=False, fontsize=8)
    figure.suptitle("KITTI odometry 00, frame 000000: scores around the reference, each from its lowest to its highest value")
    figure.savefig(path, dpi=90)


def weights(streets: Sequence[Scene]) -> None:
    """Frames weighted by w_j of eq. 3.16 against all alike, on random sets of frames from the same starts (figure 4.16)."""
    first = streets[0]
    T = first.T
    config = Config.from_dict({"refine": {"objective": "thesis"}, "thesis": {"dense_edges": "once_per_level"}})
    weighted = update(config, {"semantics": {"frame_weights": True}})
    fast, thesis = Calibrator(first.frame.camera), Calibrator(first.frame.camera, weighted)
    bare = [exact(SyntheticDrive(FIRST_SEED + k, 1, speed=0, T_camera_lidar=T, empty=NOWHERE)[0]) for k in range(STREETS)]
    for name, scenes in (("streets", streets), ("half of them empty roads", [*streets[::OF_EACH], *bare])):
        features = [f for s in scenes if isinstance(f := thesis.extract(s.frame, only_classes(s).semantics), ThesisFeatures)]
        w = np.array([f.fast.importance or 0.0 for f in features])
        alone = [fast.estimate([f.fast], start(T, k, SET_DEG, SET_M)) for k, f in enumerate(features)]
        rho = [spearmanr(w, e).statistic for e in np.transpose([error(T, r.T_camera_lidar) for r in alone])]
        print(f"\n{name}: w_j of {len(w)} frames {w.min():.2f} to {w.max():.2f}, median {np.median(w):.2f}; rank correlation")
        print(f"with the error of the frame alone {rho[0]:+.2f} (deg), {rho[1]:+.2f} (cm)")
        table(f"{name}, {SETS} sets of {SET_SIZE}", "weighted, deg / cm", "alike, deg / cm", "difference, deg", "difference, cm")
        rng = np.random.default_rng(0)
        sets = [np.sort(rng.choice(len(features), SET_SIZE, replace=False)) for _ in range(SETS)]
        plain = [dataclasses.replace(f, fast=without_weight(f.fast)) for f in features]
        jointly(T, "joint estimate, fast score", fast, [f.fast for f in features], [f.fast for f in plain], sets)
        off = np.array([se3.log(r.T_camera_lidar @ se3.inverse(T)) for r in alone])
        means = [[error(np.eye(4), se3.exp(np.average(off[s], 0, v[s]))) for s in sets] for v in (w + 1e-9, np.ones(len(w)))]
        difference("mean of single-frame estimates", *means)
        if scenes is streets:
            jointly(T, "joint estimate, eq. 3.12 (edges once per level)", thesis, features, plain, sets[: SETS // 2])


def jointly(
    T: NDArray[np.float64],
    name: str,
    calibrator: Calibrator,
    weighted: Sequence[Features],
    alike: Sequence[Features],
    sets: Sequence[NDArray[np.intp]],
) -> None:
    """A line: every set estimated at once, with and without weights."""
    errors = [
        [error(T, calibrator.estimate([f[k] for k in s], start(T, n, SET_DEG, SET_M)).T_camera_lidar) for n, s in enumerate(sets)]
        for f in (weighted, alike)
    ]
    difference(name, *errors)


def without_weight(features: FrameFeatures) -> FrameFeatures:
    """The same frame, which then weighs as much as others."""
    return dataclasses.replace(features, importance=None)


def difference(name: str, weighted: Sequence[tuple[float, float]], alike: Sequence[tuple[float, float]]) -> None:
    """Means of both, and of the paired difference with its 95 % bootstrap interval."""
    a, b = np.array(weighted), np.array(alike)
    drawn = np.random.default_rng(1).integers(0, len(a), (BOOTSTRAP, len(a)))
    low, high = np.percentile((a - b)[drawn].mean(axis=1), [2.5, 97.5], axis=0)
    cells = [f"{e[0]:.3f} / {e[1]:.2f}" for e in (a.mean(axis=0), b.mean(axis=0))]
    cells += [f"{d:+.3f} ({lo:+.3f} to {hi:+.3f})" for d, lo, hi in zip((a - b).mean(axis=0), low, high, strict=True)]
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help="masks, weights; default all")
    parser.add_argument("--kitti", type=Path, help="folder of the KITTI recordings")
    parser.add_argument("--starts", type=int, default=20, help="of the frame with masks and labels")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="score curves with and without masks")
    parser.add_argument("--cache", type=Path, metavar="FILE", help="keep the rendered streets there (500 MB)")
    args = parser.parse_args()
    rows = args.rows or ["masks", "weights"]
    if unknown := set(rows) - {"masks", "weights"}:
        parser.error(f"no row {', '.join(sorted(unknown))}; there are masks, weights")
    cv2.setNumThreads(1)
    streets = street_scenes(args.cache)
    kitti = kitti_scene(args.kitti) if args.kitti else None
    if "masks" in rows:
        masks(streets, kitti, args.starts, args.plot)
    if "weights" in rows:
        weights(streets)


if __name__ == "__main__":
    main()
