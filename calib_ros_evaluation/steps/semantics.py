"""What masks and classes add: blended edges (thesis 3.4.2, figure 3.10) and weights (3.6)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config.semantics import BUILTIN
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame, SemanticClass
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.registration.classes import EDGE_SHARE, OF_CLASSES, FrameSemantics, edge_weights
from calib_ros_evaluation.steps.pictures import (
    Image,
    Matrix,
    RegisteredFrame,
    Step,
    busiest,
    class_histogram,
    edge_picture,
    enlarged,
    over,
    tiles,
)
from calib_ros_semantics.class_pictures import classes_on_image, cloud_from_above, edges_on_image, palette, with_legend
from calib_ros_semantics.first_guess.guess import first_guess
from calib_ros_semantics.models.class_borders import WEIGHTS
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import importance
from calib_ros_thesis.image import gradient_edges

SECTION = "3.5"
step, wide_step = partial(Step, SECTION), partial(Step, SECTION, wide=True)
MAGNIFIED = 6  # the width of the picture is so many times that of its magnified part
C = SemanticClass
Classes = NDArray[np.uint8]


def semantic_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Masks and classes that the configured models find in the frame, and how they are used."""
    semantics = scene.semantics
    if semantics is None:
        yield step(
            "No semantics",
            "No model is configured (stage semantics of the settings): no semantic edges are blended into E^I, edges of "
            "all classes count alike, and nothing can be guessed from classes. The method works without.",
        )
        return
    for problem in semantics.problems:
        yield step("Problem with a model", f"{problem}.")
    if semantics.edges is not None:
        yield from _edge_steps(scene, semantics, semantics.edges)
    if semantics.classes is not None:
        yield from _image_steps(scene, semantics.classes)
    if semantics.labels is not None:
        known, frame = float((semantics.labels != UNLABELLED).mean()), deskewed_frame(scene.source, scene.config.motion)
        yield step(
            "Classes of points",
            f"Classes by the model for clouds, from above; {known:.0%} of the {len(semantics.labels)} points have a class.",
            cloud_from_above(scene.source, semantics.labels),
        )
        yield step(
            "Classes of points on the image",
            "The same points at the extrinsic of this page. Look for colours that stray beyond the outline of their object.",
            fitted(points_on_image(frame, frame.cloud.xyz, semantics.labels, scene.T), scene),
        )
    if semantics.classes is not None or semantics.labels is not None:
        yield _numbers(scene, semantics.classes, semantics.labels)


def _edge_steps(scene: RegisteredFrame, semantics: FrameSemantics, edges: NDArray[np.float32]) -> Iterator[Step]:
    config, share = scene.config, scene.semantic_share
    fast = f"The edges' own score blends {EDGE_SHARE:.0%} of them into its edges of either direction."
    text = "Semantic edges: where masks of Segment Anything end"
    if semantics.edges_of == OF_CLASSES:
        fast = "The edges' own score uses none of them."
        text = (
            "Semantic edges where there are no masks of Segment Anything: borders between the classes that "
            f"{'the builtin network' if config.semantics.image_classes == BUILTIN else 'semantics.image_classes'} sees, stronger "
            f"where it is sure; those among buildings, vegetation and ground count {WEIGHTS[C.BUILDING]:g}"
        )
    strength = np.minimum(edges.sum(axis=0), 1)
    yield step(
        scene.semantic_edges.capitalize(),
        f"{text}; over the darkened image, coloured by their direction. {(strength > 0.5).mean():.1%} of the pixels lie on one. "
        "Look for outlines of objects without shadows, texture and lane markings.",
        fitted(edges_on_image(scene.source, edges), scene),
    )
    blended = scene.unsmoothed
    yield step(
        "Blended edges",
        f"Figure 3.10 before its smoothing: {1 - share:.0%} gradient edges and {share:.0%} semantic ones. {fast}",
        edge_picture(blended),
    )
    assert scene.semantic is not None
    gradient = gradient_edges(scene.prepared, thesis_of(config))
    semantic = np.minimum(scene.semantic.sum(axis=0), 1)
    height, width = blended.shape
    window = busiest(np.asarray(semantic, np.float32), max(height // 3, 2), max(width // MAGNIFIED, 2))
    pictures = [scene.gray[window], *(np.asarray(255 * e[window], np.uint8) for e in (gradient, semantic, blended))]
    yield wide_step(
        "Blended edges, magnified",
        "Figure 3.10 where the most semantic edges lie. Edges that both kinds have stay strong; texture and shadows fade, and "
        "outlines of little contrast appear.",
        tiles(pictures, ["image", "gradient", "semantic", "blended"], 4, width),
    )


def _image_steps(scene: RegisteredFrame, classes: Classes) -> Iterator[Step]:
    share = importance(classes)
    weight = (
        "No pixel has a class."
        if share is None
        else f"Vehicles, persons, cyclists, poles and signs take w_j = {share:.1%} of the pixels whose class is known (eq. 3.16)."
    )
    used = "weigh by it" if scene.config.semantics.frame_weights else "would weigh by it with semantics.frame_weights"
    yield step(
        "Classes of pixels",
        f"Classes by the model for images. {weight} Several frames {used}.",
        fitted(classes_on_image(scene.source, classes), scene),
    )
    counts = np.bincount(classes.ravel(), minlength=256)
    yield step(
        "Pixels by class",
        "Histogram of the classes' pixels (figures 4.5, 4.8 and 4.11); in orange those of eq. 3.16.",
        class_histogram({c.name.lower(): int(counts[c]) for c in C}, [c.name.lower() for c in MAIN_CLASSES]),
    )


def points_on_image(frame: Frame, xyz: NDArray[np.float32], labels: Classes, T: Matrix) -> Image:
    """Classes (n,) of points (n, 3) at T_camera_lidar (4, 4) over the frame's image; near points hide far ones."""
    p = se3.transform(T, xyz)
    uv, inside = frame.camera.project(p)
    known = np.flatnonzero(inside & (labels != UNLABELLED))
    far_first = known[np.argsort(-p[known, 2], kind="stable")]
    u, v = np.rint(uv[far_first]).astype(np.intp).T
    height, width = frame.image.shape[:2]
    dots = np.zeros((height, width), np.uint8)
    dots[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] = labels[far_first] + 1  # 0 is no dot
    return with_legend(over(frame.image, enlarged(dots), np.roll(palette(), 1, axis=0)), np.unique(labels[known]))


def _numbers(scene: RegisteredFrame, classes: Classes | None, labels: Classes | None) -> Step:
    fast = scene.features.plain or scene.features
    of_edges = fast.points.label
    rows: list[tuple[str, ...]] = [("class", "pixels", "points", "edge points", "weight of an edge")]
    for c in (*C, UNLABELLED):
        shares = ["-" if own is None else f"{(own == c).mean():.1%}" for own in (classes, labels, of_edges)]
        weight = edge_weights(np.array([c], np.uint8))[0]
        rows.append(("unknown" if c == UNLABELLED else C(c).name.lower(), *shares, "-" if labels is None else f"{weight:g}"))
    return wide_step(
        "Classes in numbers",
        "Shares of the classes among the image's pixels, the cloud's points, and the points on its edges, which the fast score "
        "uses; and what an edge of each class counts.",
        table=tuple(rows),
    )


def fitted(picture: Image, scene: RegisteredFrame) -> Image:
    """A picture of the image as recorded, no wider than the others of the page."""
    width = scene.frame.camera.width
    if picture.shape[1] <= width:
        return picture
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def guess_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """The guess from this frame alone and the other hypotheses; nothing where points or pixels have no classes."""
    view = scene.features.view
    if view is None or scene.semantics is None or scene.semantics.labels is None:
        return
    try:
        guesses = first_guess([view], scene.config.search.seed)
    except TooFewFeaturesError as error:
        yield step("First guess", f"Figure 3.21 is missing, for nothing can be guessed from this frame: {error}.")
        return
    frame = deskewed_frame(scene.source, scene.config.motion)
    yield step(
        "First guess",
        "Figure 3.21: classes of points at the best guess from this frame alone, which knows of no extrinsic. "
        f"It is {_off(scene, guesses[0].T)} away from the extrinsic of this page. It is only where the registration "
        "starts; a vehicle guesses from several keyframes.",
        fitted(points_on_image(frame, frame.cloud.xyz, scene.semantics.labels, guesses[0].T), scene),
    )
    rows: list[tuple[str, ...]] = [("hypothesis", "score", "margin", "from", "objects met", "away from this page's extrinsic")]
    for k, h in enumerate(guesses, start=1):
        rows.append((str(k), f"{h.score:.3f}", f"{h.margin:.3f}", h.kind, str(h.inliers), _off(scene, h.T)))
    yield wide_step(
        "Hypotheses",
        "What the classes would allow, best first, from centroids of objects (3.5) or from a sweep over all directions. Score: "
        "mean log likelihood ratio of the points in view times the root of their share, 0 by chance. Those that score nearly as "
        "much as the best are all registered, and their edges decide.",
        table=tuple(rows),
    )


def _off(scene: RegisteredFrame, T: Matrix) -> str:
    return f"{se3.rotation_error_deg(scene.T, T):.1f} deg, {100 * se3.translation_error_m(scene.T, T):.0f} cm"
