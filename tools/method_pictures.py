#!/usr/bin/env python3
"""The pictures of docs/method.md, from a synthetic drive with a known extrinsic.

    tools/method_pictures.py [NAME ...] [--out docs/method] [--check]

Writes the pictures named, or all of them (two minutes on one core). --check writes nothing: it makes them anew and compares
them with those in the folder; exit code 1 if one differs. Same code, same pictures, but for the last digits of other
versions of OpenCV and matplotlib, which the comparison forgives.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source
from calib_ros.frame import Frame
from calib_ros.image.enhance import equalize
from calib_ros.lidar.deskew import deskewed_edges
from calib_ros.lidar.edges import EdgeKind, EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.online.keyframes import histogram, similarity
from calib_ros.overlay import BAR, put
from calib_ros.registration.acceptance.significance import HALF_WIDTH, NEIGHBOURS, OUTLIER_SHARE, null_distribution
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import FrameSemantics
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.registration.objective import FastObjective
from calib_ros.registration.score.point_score import FastScore, Score
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.curves import curves
from calib_ros_evaluation.steps.page import make_steps
from calib_ros_evaluation.steps.pictures import RegisteredFrame, loss_curves, tiles
from calib_ros_evaluation.steps.semantics import guess_steps, semantic_steps
from calib_ros_semantics.class_pictures import LEVEL, VERTICAL, above_names, sizes
from calib_ros_semantics.models.masks import Mask, mask_edges
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import ThesisFeatures, importance
from calib_ros_thesis.image import OPERATORS, gradient_edges
from calib_ros_thesis.score import ThesisScore

SOURCE = "synthetic:seed=3"
FAST_DRIVE = "synthetic:seed=3,frames=4,speed=15,stride=4"  # m/s; where the scan's distortion can be seen
DENSE_DRIVE = "synthetic:seed=3,frames=60,stride=2,rings=16"  # five frames a second
FRAME = 4  # the frame of most pictures: cars on both sides, a crossing, a lorry
SOME = (0, 4, 8, 12, 16)  # frames of joint scores
ALL = 20
WIDTH, QUALITY, DPI = 900, 85, 100  # px of a picture; of JPEG; of plots
THESIS = Config.from_dict({"refine": {"objective": "thesis"}})
SUM = update(THESIS, {"thesis": {"normalize": False}})
CAR = (slice(190, 362), slice(700, 1112))  # rows and columns of the near car of FRAME
POST = (slice(190, 250), slice(262, 336))  # right end of the roof of the car on the left
SHADE = (slice(0, 230), slice(690, 1242))  # houses in the shade
STREET = (slice(170, 340), slice(130, 480))  # of a frame of FAST_DRIVE
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#d55e00", "#009e73", "#cc3311", "0.65"  # Okabe and Ito; red: Tol
KINDS = {  # kind of edge -> what the legend calls it, BGR
    EdgeKind.SIDE: ("range jumps sideways", (255, 160, 40)),
    EdgeKind.TOP: ("range jumps upward", (40, 140, 255)),
    EdgeKind.REFLECTIVITY: ("reflectivity", (90, 230, 90)),
    EdgeKind.SKY_SIDE: ("sky sideways", (255, 90, 255)),
    EdgeKind.SKY_TOP: ("sky above", (90, 255, 255)),
}
LIME, PINK = (90, 255, 120), (230, 90, 255)  # BGR of edge points
STEP, SAME = 48, 0.005  # grey levels that a pixel may differ by, and the share of pixels that may differ by more
Image = NDArray[np.uint8]
Matrix = NDArray[np.float64]
Window = tuple[slice, slice]


class Street:
    """The drive, and what several pictures are made of; nothing is made before it is asked for."""

    def __init__(self) -> None:
        self.source: Source = open_dataset(SOURCE)
        assert self.source.reference is not None
        self.T: Matrix = self.source.reference
        self.config = Config()

    @cached_property
    def frame(self) -> Frame:
        return self.source[FRAME]

    @cached_property
    def step_pictures(self) -> dict[str, Image]:
        """Those of `calib-ros steps`, by name."""
        made = make_steps(self.frame, self.T, self.config, samples=3)
        return {s.name: s.picture for s in made if s.picture is not None}

    @cached_property
    def scene(self) -> RegisteredFrame:
        """The frame with all that the street knows: classes, and regions of one class as masks."""
        classes = self.frame.classes
        assert classes is not None
        masks = []
        for c in np.unique(classes):
            regions = cv2.connectedComponents((classes == c).astype(np.uint8), connectivity=8)[1]
            areas = np.bincount(regions.ravel())
            masks += [Mask.of(regions == k) for k in range(1, len(areas)) if areas[k] >= 100]
        edges = mask_edges([m for m in masks if m is not None], classes.shape)
        return RegisteredFrame.of(self.frame, self.T, self.config, FrameSemantics(edges, classes, self.frame.cloud.label))

    @cached_property
    def semantic_pictures(self) -> dict[str, Image]:
        """Of what masks and classes add."""
        made = [*semantic_steps(self.scene), *guess_steps(self.scene)]
        return {s.name: s.picture for s in made if s.picture is not None}

    @cached_property
    def extract(self) -> FeatureExtractor:
        return FeatureExtractor(self.source.camera, self.config)

    @cache  # noqa: B019 - there is one street, and it lives as long as the program
    def features(self, k: int) -> FrameFeatures:
        """Of one frame, for the fast score."""
        return self.extract(self.source[k])

    @cached_property
    def thesis_features(self) -> list[ThesisFeatures]:
        """Of some frames, for eq. 3.12."""
        extract = FeatureExtractor(self.source.camera, THESIS)
        return [extract(self.source[k]).own for k in SOME]


# ------------------------------------------------------------------------------------------------ layout


def fitted(picture: Image, width: int = WIDTH) -> Image:
    """A picture (h, w[, 3]) of at most this width, px."""
    if picture.shape[1] <= width:
        return picture
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def stacked(pictures: Mapping[str, Image]) -> Image:
    """Pictures of one width below each other, each under its title."""
    font, line, margin = sizes(WIDTH)
    rows = []
    for title, picture in pictures.items():
        bar = np.full((line + margin, WIDTH, 3), BAR, np.uint8)
        put(bar, title, (margin, line - margin // 2), font)
        rows += [bar, as_color(fitted(picture))]
    return np.vstack(rows)


def as_color(picture: Image) -> Image:
    return picture if picture.ndim == 3 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8)


def zoomed(image: Image, window: Window, points: Mapping[tuple[int, int, int], Matrix], factor: int, radius: int) -> Image:
    """A part of an image magnified, with dots: colour -> pixels (n, 2) of the image."""
    part = cv2.resize(as_color(image)[window], None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    part = np.asarray(0.75 * part, np.uint8)
    for color, uv in points.items():
        for u, v in (uv - (window[1].start, window[0].start) + 0.5) * factor:
            if 0 <= u < part.shape[1] and 0 <= v < part.shape[0]:
                cv2.circle(part, (round(u), round(v)), radius, color, -1, cv2.LINE_AA)
    return part


def pixels(street: Street, points: EdgePoints, T: Matrix) -> Matrix:
    """Edge points on the image, (n, 2)."""
    uv, inside = street.source.camera.project(se3.transform(T, points.xyz))
    return np.asarray(uv[inside])


def plot(width: float, height: float) -> Figure:
    """An empty figure, in units of 100 px. Never pyplot, which keeps state of its own."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def drawn(figure: Figure) -> Image:
    canvas: Any = figure.canvas
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba(), np.uint8)[:, :, 2::-1])


# ------------------------------------------------------------------------------------------------ first half: the thesis


def errors(street: Street) -> Image:
    """What an error of so many degrees or centimetres looks like."""
    points = street.features(FRAME).points
    turned = {f"yaw {deg:g} deg off": se3.perturb(street.T, [0, deg, 0], [0, 0, 0]) for deg in (0.25, 1.0)}
    off = {"right": street.T, **turned, "10 cm to the side": se3.perturb(street.T, [0, 0, 0], [0.1, 0, 0])}
    parts = [zoomed(street.frame.image, CAR, {LIME: pixels(street, points, T)}, 2, 2) for T in off.values()]
    return tiles(parts, list(off), 2, WIDTH)


def equalisation(street: Street) -> Image:
    """The methods of section 3.2 on a part of the image that lies in the shade."""
    methods = {
        "none": "as recorded",
        "global": "global (eq. 3.4)",
        "adaptive": "adaptive, per tile",
        "clahe": "CLAHE: per tile, clipped",
    }
    config, gray = street.config.image, street.scene.gray
    made = [equalize(gray, dataclasses.replace(config, equalization=method))[SHADE] for method in methods]
    return tiles(made, list(methods.values()), 2, WIDTH)


def operators(street: Street) -> Image:
    """Algorithms 3 to 5 on a part of the image."""
    config = street.config
    prepared = street.scene.prepared
    made = [prepared[CAR]]
    for operator in OPERATORS:
        edges = gradient_edges(prepared, dataclasses.replace(thesis_of(config), operator=operator))
        made.append(np.asarray(255 * edges[CAR], np.uint8))
    return tiles(made, ["prepared image", "Sobel (algorithm 3)", "Canny (algorithm 4)", "mix (algorithm 5)"], 2, WIDTH)


def lidar_edges(street: Street) -> Image:
    """The three edge maps of figure 3.14 and what is kept of them."""
    lidar = street.scene.maps.lidar
    made = {
        "delta_d, of dense depth": lidar.depth_edges,
        "delta_r, of dense reflectivity": lidar.reflectivity_edges,
        "delta_o, of objects": lidar.object_edges,
        "E^L: their mean where a point fell": lidar.lidar_edges,
    }
    window = (slice(130, 375), slice(540, 1127))
    parts = [np.asarray(255 * np.minimum(e[window] * (2 if k == 3 else 1), 1), np.uint8) for k, e in enumerate(made.values())]
    parts[3] = np.asarray(cv2.dilate(parts[3], np.ones((2, 2), np.uint8)), np.uint8)
    return tiles(parts, list(made), 2, WIDTH)


def loss(street: Street) -> Image:
    """Eq. 3.12 as a sum and normalised, and the fast form, over the six axes; five frames together."""
    fast = FastScore([street.features(k) for k in SOME], street.T, street.config.score).at(-1)
    scores: dict[str, Score] = {
        "eq. 3.12, as a sum": ThesisScore(street.thesis_features, street.T, SUM).at(-1),
        "eq. 3.12 / LiDAR edges": ThesisScore(street.thesis_features, street.T, THESIS).at(-1),
        "fast form": fast,
    }
    return loss_curves({name: curves(score, street.T, 2.0, 0.3, 25) for name, score in scores.items()})


def scenes(street: Street) -> Image:
    """Eq. 3.15 between frames of a drive, and what algorithm 6 makes of it."""
    drive = open_dataset(DENSE_DRIVE)
    images = [drive[k].image for k in range(len(drive))]
    shares = [histogram(image) for image in images]
    seconds = 0.2 * np.arange(len(drive))
    rho = np.array([[similarity(a, b) for b in shares] for a in shares])
    figure = plot(9, 3.6)
    axes = figure.add_subplot(1, 2, 1)
    shown = axes.imshow(rho, cmap="viridis", vmin=0.5, vmax=1)
    axes.set(title="similarity of frames, eq. 3.15", xlabel="frame, 0.2 s apart", ylabel="frame")
    figure.colorbar(shown, ax=axes, shrink=0.9)
    axes = figure.add_subplot(1, 2, 2)
    for threshold, color, y in ((0.92, GREEN, 0.63), (0.7, ORANGE, 0.59)):
        kept, along = [0], [1.0]
        for k in range(1, len(images)):
            along.append(rho[k, kept[-1]])
            if along[-1] < threshold:
                kept.append(k)
        axes.plot(seconds, along, "-", color=color, linewidth=1.4, label=f"threshold {threshold:g}: {len(kept)} keyframes")
        axes.plot(seconds[kept], [y] * len(kept), "|", color=color, markersize=12, markeredgewidth=1.6)
        axes.axhline(threshold, color=color, linestyle=":", linewidth=1)
    axes.set(
        title="algorithm 6",
        xlabel="time, s",
        ylabel="similarity to the last keyframe",
        ylim=(0.56, 1.2),
        yticks=[0.6, 0.7, 0.8, 0.9, 1],
    )
    axes.legend(fontsize=9, loc="upper right", frameon=False)
    return drawn(figure)


def weighted(street: Street) -> Image:
    """Eq. 3.16: the frames' own curves, their plain and their weighted mean."""
    score = ThesisScore(street.thesis_features, street.T, THESIS)
    shares = [importance(street.source[k].classes) or 0.0 for k in SOME]  # type: ignore[arg-type]
    weights = np.array(shares) / sum(shares)
    figure = plot(9, 3.3)
    unit = np.linspace(-1, 1, 25)
    for place, (axis, half, name) in enumerate(((1, np.deg2rad(2), "r_y, deg"), (5, 0.3, "t_z, cm"))):
        J = np.array([score.frame_scores(se3.exp(x * half * np.eye(6)[axis]) @ street.T) for x in unit])
        axes = figure.add_subplot(1, 2, place + 1)
        x = unit * (2 if axis < 3 else 30)
        for k, own in enumerate(J.T):
            label = "single frames, $J_j$" if k == 0 else None
            axes.plot(x, own - own.min(), color=GREY, linewidth=1, label=label)
        for values, color, label in ((J.mean(axis=1), BLUE, "equal weights"), (J @ weights, ORANGE, "weights $w_j$ of eq. 3.16")):
            axes.plot(x, values - values.min(), color=color, linewidth=2.2, label=label)
        axes.axvline(0, color="0.6", linewidth=1)
        axes.set(
            xlabel=f"offset along ${name.split(',')[0]}$,{name.split(',')[1]}",
            ylabel="score above its lowest" if place == 0 else "",
        )
    figure.legend(handles=[line for line in figure.axes[0].get_lines()[:7] if not str(line.get_label()).startswith("_")],
                  loc="outside upper center", ncols=3, frameon=False)  # fmt: skip
    return drawn(figure)


# ------------------------------------------------------------------------------------------------ second half: the fast form


def kinds(street: Street) -> Image:
    """Edge points of the scan on the image, by what makes the edge."""
    points = street.features(FRAME).points
    of_kind = {color: points.select(np.flatnonzero(points.kind == kind)) for kind, (_, color) in KINDS.items()}
    where = {color: pixels(street, own, street.T) for color, own in of_kind.items()}
    height, width = street.frame.image.shape[:2]
    picture = zoomed(street.frame.image, (slice(0, height), slice(0, width)), where, 1, 2)
    return above_names(fitted(picture), dict(KINDS.values()))


def shift(street: Street) -> Image:
    """Edge points where they were measured, moved outward by half a step, and upward ones spread between the rings."""
    config, frame = street.config, street.frame
    names = {"as measured": (0.0, 0.0, PINK), "half a step outward": (0.5, 0.0, LIME), "and spread upward": (0.5, 1.0, LIME)}
    parts = []
    for outward, top, color in names.values():
        with patch.multiple("calib_ros.lidar.edges", OUTWARD_SHIFT=outward, TOP_SPREAD=top):
            points = deskewed_edges(edge_points(range_image(frame.cloud, config.lidar), config.lidar), frame, config.motion)
        outline = points.select(np.flatnonzero(np.isin(points.kind, (EdgeKind.SIDE, EdgeKind.TOP))))
        parts.append(zoomed(frame.image, POST, {color: pixels(street, outline, street.T)}, 6, 6))
    return tiles(parts, list(names), 3, WIDTH)


def levels(street: Street) -> Image:
    """Oriented edge maps at all resolutions."""
    made, names = [as_color(street.frame.image)], ["image"]
    for level in street.features(FRAME).levels:
        strength = np.clip(level.maps / 4, 0, 1)
        picture = np.tensordot(strength, np.array([VERTICAL, LEVEL], np.float32), (0, 0))
        size = (street.frame.image.shape[1], street.frame.image.shape[0])
        made.append(np.asarray(cv2.resize(np.clip(picture, 0, 255), size, interpolation=cv2.INTER_LINEAR), np.uint8))
        names.append(f"sigma {level.sigma:.1f} px, map 1/{level.scale}")
    made = [np.asarray(cv2.resize(m, (447, 135), interpolation=cv2.INTER_AREA), np.uint8) for m in made]
    return above_names(tiles(made, names, 2, WIDTH), {"vertical lines": VERTICAL, "horizontal lines": LEVEL})


def validation(street: Street) -> Image:
    """The score at an optimum against its null distribution; and frames one by one, one of them paired wrongly."""
    right = [street.features(k) for k in range(0, ALL, 2)]
    wrong = [dataclasses.replace(f, levels=right[(k + 5) % len(right)].levels) for k, f in enumerate(right)]
    around = se3.exp_many((qmc.Sobol(6, seed=0).random(NEIGHBOURS) * 2 - 1) * HALF_WIDTH)
    figure = plot(9, 3.4)
    axes = figure.add_subplot(1, 2, 1)
    for features, color, name, y in (
        (right, GREEN, "scans with\ntheir images", 40),
        (wrong, RED, "with images\nof other places", 28),
    ):
        objective = FastObjective(features, street.T, street.config)
        T = street.T
        if features is wrong:
            T = objective.search(T, SearchBox(3.0, 0.3, rounds=1)).T
        T = objective.optimise(T, searched=True)
        level = objective.score.n_levels - 1
        values = objective.score.values(around @ T, level)
        here = objective.score.at(level).value(T)
        axes.hist(values, np.linspace(-0.3, 0.6, 37).tolist(), color=color, alpha=0.45)
        axes.axvline(here, color=color, linewidth=2.5)
        axes.axvline(float(np.percentile(values, 99)), color=color, linewidth=1.2, linestyle=":")
        z_score = null_distribution(objective.score, T).z_score
        label, beside = f"{name}:\nz-score {z_score:.1f}", "right" if here > 0.8 else "left"
        axes.text(here + (0.13 if beside == "left" else -0.04), y, label, color=color, ha=beside, va="top", fontsize=10)
    axes.set(title="score at the best optimum (line) and around it", xlabel="score", ylabel="extrinsics around it")
    axes.set_ylim(0, 45)
    axes = figure.add_subplot(1, 2, 2)
    one = [*right[:3], wrong[3], *right[4:]]
    z = null_distribution(FastScore(one, street.T, street.config.score), street.T).z_scores
    axes.bar(range(len(z)), z, color=[RED if k == 3 else GREEN for k in range(len(z))])
    limit = OUTLIER_SHARE * float(np.nanmedian(z))
    axes.axhline(limit, color="0.3", linestyle="--", linewidth=1)
    axes.text(3, limit + 0.3, f"{OUTLIER_SHARE:g} of\nthe median", ha="center", va="bottom", fontsize=9)
    axes.set(title="frame by frame; frame 3 has a wrong image", xlabel="frame", ylabel="z-score")
    return drawn(figure)


def spread(street: Street) -> Image:
    """Errors of estimates from 1 to 10 frames, with the two standard deviations that the covariance tells."""
    calibrator = Calibrator(street.source.camera, street.config)
    every = [street.features(k) for k in range(ALL)]
    sets = {n: [every[k :: ALL // n][:n] for k in range(ALL // n)] for n in (1, 2, 5, 10)}
    start = se3.perturb(street.T, [0.3, -0.3, 0.3], [0.03, -0.03, 0.03])
    figure = plot(9, 3.4)
    panels = [figure.add_subplot(1, 2, k + 1) for k in (0, 1)]
    x, refused = 0, 0
    middles: list[tuple[float, int]] = []
    for (n, groups), color in zip(sets.items(), (GREY, BLUE, ORANGE, GREEN), strict=True):
        first = x
        for group in groups:
            result = calibrator.estimate(group, start)
            if result.covariance is None:
                refused += 1
                continue
            xi, sigma = se3.log(result.T_camera_lidar @ se3.inverse(street.T)), np.sqrt(np.diag(result.covariance))
            for axes, axis, scale in zip(panels, (1, 3), (180 / np.pi, 100), strict=True):
                axes.errorbar(x, scale * xi[axis], 2 * scale * sigma[axis], fmt="o", color=color, markersize=4, linewidth=1.6)
            x += 1
        middles.append(((first + x - 1) / 2, n))
        x += 1
    for axes, name, limit in zip(panels, ("yaw $r_y$ off, deg", "sideways $t_x$ off, cm"), (0.3, 7), strict=True):
        axes.axhline(0, color="0.3", linewidth=1)
        axes.set(ylabel=name, xlabel="frames per estimate", ylim=(-limit, limit))
        axes.set_xticks([m for m, _ in middles], [str(n) for _, n in middles])
    print(f"spread: {refused} of {sum(map(len, sets.values()))} estimates refused", file=sys.stderr)
    return drawn(figure)


def deskewed(street: Street) -> Image:
    """Edge points of a scan at 15 m/s, as measured and moved to the image's moment."""
    source = open_dataset(FAST_DRIVE)
    frame, T = source[2], source.reference
    assert T is not None
    parts = []
    config = street.config
    for mode, color in (("off", PINK), ("auto", LIME)):
        features = FeatureExtractor(source.camera, update(config, {"motion": {"deskew": mode}}))(frame)
        uv, inside = source.camera.project(se3.transform(T, features.points.xyz))
        parts.append(zoomed(frame.image, STREET, {color: uv[inside]}, 3, 3))
    return tiles(parts, ["as measured", "at the moment of the image"], 2, WIDTH)


def step(name: str) -> Callable[[Street], Image]:
    """A picture of `calib-ros steps` as it is."""
    return lambda street: street.step_pictures[name]


def together(*names: tuple[str, str]) -> Callable[[Street], Image]:
    """Several of them below each other: title and name of each."""
    return lambda street: stacked({title: street.step_pictures[name] for title, name in names})


def semantic(name: str) -> Callable[[Street], Image]:
    """A picture of what masks and classes add."""
    return lambda street: street.semantic_pictures[name]


PICTURES: dict[str, Callable[[Street], Image]] = {
    "projection.jpg": step("Scan on the image"),
    "errors.jpg": errors,
    "histograms.png": step("Histograms"),
    "equalisation.jpg": equalisation,
    "filters.jpg": step("Filters, magnified"),
    "thresholds.jpg": together(
        ("by height", "Filter by height"),
        ("by reflectivity", "Filter by reflectivity"),
        ("by angle: the camera's field", "Filter by angle"),
        ("by range", "Filter by range"),
    ),
    "ground.jpg": together(
        ("RANSAC (algorithm 1): ground in orange", "Ground found"), ("DBSCAN (algorithm 2): objects", "Clusters")
    ),
    "operators.jpg": operators,
    "blended.jpg": semantic("Blended edges, magnified"),
    "smoothing.jpg": step("Smoothing, magnified"),
    "discontinuity.jpg": step("Depth discontinuity"),
    "completion.jpg": step("Completion, magnified"),
    "density.jpg": together(
        ("depth, ground removed", "Dense depth"),
        ("reflectivity, low values removed", "Low reflectivity removed"),
        ("objects", "Objects closed"),
    ),
    "lidar_edges.jpg": lidar_edges,
    "weight.jpg": step("Weight image"),
    "score.jpg": together(
        ("at the true extrinsic", "Score per pixel"), ("1.5 deg and 15 cm to the side", "Score per pixel, moved")
    ),
    "loss.png": loss,
    "first_guess.jpg": semantic("First guess"),
    "scenes.png": scenes,
    "weighted.png": weighted,
    "kinds.jpg": kinds,
    "shift.jpg": shift,
    "levels.jpg": levels,
    "validation.png": validation,
    "spread.png": spread,
    "deskewed.jpg": deskewed,
}


def encoded(name: str, picture: Image) -> bytes:
    """A picture as the file of that name."""
    how = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if name.endswith(".jpg") else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    return bytes(cv2.imencode(Path(name).suffix, fitted(picture), how)[1])


def differs(file: Path, picture: bytes) -> str:
    """How a picture differs from the file; empty if it does not."""
    if not file.is_file():
        return "missing"
    old, new = cv2.imread(str(file)), cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    if old is None or new is None or old.shape != new.shape:
        return f"{None if old is None else old.shape} instead of {None if new is None else new.shape}"
    share = float((cv2.absdiff(old, new).max(axis=2) > STEP).mean())
    return f"{share:.1%} of the pixels" if share > SAME else ""


def main() -> int:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}; default all")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs/method", help="folder")
    parser.add_argument("--check", action="store_true", help="compare with the files in the folder instead of writing them")
    args = parser.parse_args()
    if unknown := set(args.names) - set(PICTURES):
        parser.error(f"no picture {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    cv2.setNumThreads(1)
    street, failed = Street(), 0
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or PICTURES:
        data = encoded(name, PICTURES[name](street))
        if not args.check:
            (args.out / name).write_bytes(data)
            print(f"{name}: {len(data) / 1024:.0f} KB", flush=True)
        elif difference := differs(args.out / name, data):
            failed += 1
            print(f"{name}: {difference}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
