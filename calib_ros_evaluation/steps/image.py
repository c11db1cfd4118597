"""What happens to the image: preparation (thesis 3.2) and edges (3.4.1, 3.4.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np

from calib_ros.image.edges import GRADIENT_PERCENTILE, REFERENCE_FOCAL_LENGTH
from calib_ros.image.enhance import (
    BILATERAL_COLOR,
    BILATERAL_DIAMETER,
    BILATERAL_SPACE,
    CLAHE_CLIP,
    CLAHE_TILES,
    GAUSSIAN_SIGMA,
    equalize,
    smooth,
)
from calib_ros_evaluation.steps.pictures import Image, RegisteredFrame, Step, busiest, edge_picture, histograms, outlines, tiles
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.image import OPERATORS, gradient_edges

preparation_step, edge_step = partial(Step, "3.2"), partial(Step, "3.4.2")
wide_preparation_step, wide_edge_step = partial(preparation_step, wide=True), partial(edge_step, wide=True)
METHODS = {
    "none": "none: as recorded",
    "global": "global: one curve for all pixels",
    "adaptive": "adaptive: a curve per tile",
    "clahe": "CLAHE: per tile, clipped",
}
USED = " Used in this run."
STRONG = 0.5  # edge strength that captions call strong


def preparation_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Original image to the prepared grey one."""
    image, gray = scene.frame.image, scene.gray
    recorded, camera = scene.source.camera, scene.frame.camera
    made = [f"shrunk from {recorded.width} x {recorded.height} px"] if recorded.width != camera.width else []
    made += [] if recorded.is_pinhole else ["freed of its lens distortion, so that eq. 2.3 projects points onto it"]
    yield preparation_step(
        "Image",
        f"The camera's image, {camera.width} x {camera.height} px{', ' + ' and '.join(made) if made else ''}. "
        "All pictures of the camera's view below have this size.",
        image,
    )
    color = "The source is grey already." if image.ndim == 2 else "The edge operators work on one channel."
    yield preparation_step(
        "Grey image",
        f"{color} Grey levels spread by {gray.std():.0f} around a mean of {gray.mean():.0f}. This is also what equalisation "
        "'none' leaves.",
        gray,
    )
    equalized = {method: equalize(gray, method) for method in METHODS}
    yield from _equalized(scene, equalized)
    texts = {
        "bilateral": f"Bilateral filter, eq. 3.5: the mean over {BILATERAL_DIAMETER} px of pixels that are near (sigma "
        f"{BILATERAL_SPACE:g} px) and alike (sigma {BILATERAL_COLOR:g} grey levels). Texture goes, edges stay.",
        "gaussian": f"Gaussian filter, eq. 3.6 and 3.7, sigma {GAUSSIAN_SIGMA:g} px. Texture and edges are blurred alike.",
    }
    pictures = {"before": equalized["clahe"]}
    for name, text in texts.items():
        pictures[name] = smooth(equalized["clahe"], name)
        change = float(cv2.absdiff(pictures[name], equalized["clahe"]).mean())
        text += f" A pixel changes by {change:.1f} grey levels on average.{USED if name == 'bilateral' else ''}"
        yield preparation_step(f"{name.capitalize()} filter", text, pictures[name])
    window = busiest(outlines(equalized["clahe"]), *_size(equalized["clahe"]))
    yield wide_preparation_step(
        "Filters, magnified",
        "Before, bilateral and Gaussian, where the image has its strongest outlines. Compare how sharp outlines and texture are.",
        tiles([p[window] for p in pictures.values()], list(pictures), 3, camera.width),
    )


def _equalized(scene: RegisteredFrame, equalized: dict[str, Image]) -> Iterator[Step]:
    image = scene.frame.image
    tiles_text = f"{CLAHE_TILES} x {CLAHE_TILES} tiles"
    texts = {
        "global": "Global equalisation, eq. 3.1 to 3.4: the distribution of all pixels becomes the curve that maps grey levels. "
        "Look for bright and dark areas that run together.",
        "adaptive": f"Adaptive equalisation: a curve for each of {tiles_text}. Shadows open up, but so does the noise of flat "
        "areas, as of sky and road.",
        "clahe": f"CLAHE: as adaptive, but each tile's histogram is clipped at {CLAHE_CLIP:g} times its mean, so that "
        "flat areas stay calm.",
    }
    for method, text in texts.items():
        picture = equalized[method]
        numbers = f" Grey levels spread by {picture.std():.0f} instead of {scene.gray.std():.0f}."
        name = "CLAHE" if method == "clahe" else f"Equalised, {method}"
        yield preparation_step(name, text + numbers + (USED if method == "clahe" else ""), picture)
    if image.ndim == 3:
        yield preparation_step(
            "CLAHE on colour",
            "Figure 3.5: CLAHE on the blue, green and red channel by themselves. Colours shift where the channels' histograms "
            "differ. Not used: the method works on the grey image.",
            equalize(image),
        )
    yield wide_preparation_step(
        "Histograms",
        "Figure 3.3: share of pixels of each grey level (blue, eq. 3.1) and their distribution (orange, eq. 3.2 and 3.3). Global "
        "equalisation turns the distribution into a straight line, with gaps in the "
        "histogram; CLAHE bends it less than adaptive equalisation.",
        histograms({METHODS[method]: picture for method, picture in equalized.items()}),
    )
    window = busiest(outlines(equalized["clahe"]) - outlines(scene.gray), *_size(scene.gray))
    yield wide_preparation_step(
        "Equalisation, magnified",
        f"Figure 3.4: the part of the image where CLAHE strengthens outlines most, rows {window[0].start} to "
        f"{window[0].stop}, columns {window[1].start} to {window[1].stop}. Look for outlines that only the local methods show.",
        tiles([p[window] for p in equalized.values()], list(METHODS), 4, scene.frame.camera.width),
    )


def edge_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Prepared image to E^I."""
    thesis = thesis_of(scene.config)
    yield edge_step(
        "Prepared image",
        "What the edge operators get: equalisation clahe, filter bilateral (the dotted box of figure 3.10).",
        scene.prepared,
    )
    thresholds = f"{thesis.canny_low:g} and {thesis.canny_high:g} of a full edge"
    full = f"A full edge (1) is the strength that {100 - GRADIENT_PERCENTILE:g} % of the pixels exceed."
    texts = {
        "sobel": f"Sobel operator, algorithm 3 with the kernels of eq. 3.9: the strength of the grey slope. {full} ",
        "canny": f"Canny operator, algorithm 4: ridges of the slope, one pixel wide, between the thresholds {thresholds}. ",
        "mix": "Mix, algorithm 5: half Sobel, half Canny. Weak edges stay, strong ones stand out. ",
    }
    whole = "E^I before its smoothing (figure 3.11a)"
    if scene.semantic is not None:
        whole = f"what {1 - scene.semantic_share:.0%} of {whole} is made of; the rest are {scene.semantic_edges}, see Semantics"
    for operator in OPERATORS:
        edges = gradient_edges(scene.prepared, dataclasses.replace(thesis, operator=operator))
        used = f"{USED[:-1]}: this is {whole}." if thesis.operator == operator else ""
        share = f"{(edges > STRONG).mean():.1%} of the pixels are stronger than {STRONG:g}.{used}"
        yield edge_step(f"{operator.capitalize()} edges", texts[operator] + share, edge_picture(edges))
    focal_length = float(scene.features.camera.K[0, 0])
    for level, (edges, sigma) in enumerate(zip(scene.thesis.image_edges, thesis.smoothing, strict=True)):
        high = max(float(f"{np.percentile(edges, 99.8):.1g}"), 0.1)
        yield edge_step(
            f"Image edges, sigma {sigma:g} px",
            f"E^I of level {level + 1} of {len(thesis.smoothing)}, figure 3.11b: Gaussian smoothing of "
            f"{sigma * focal_length / REFERENCE_FOCAL_LENGTH:.1f} px at this focal length. The wider it is, the farther off an "
            f"extrinsic may be and still be drawn to the edge. White is a strength of {high:g} and more.",
            edge_picture(edges, "edge strength", high),
        )
    window = busiest(outlines(scene.prepared), *_size(scene.prepared))
    pictures = [
        np.asarray(255 * e[window] / max(float(e[window].max()), 1e-6), np.uint8)
        for e in (scene.unsmoothed, *scene.thesis.image_edges)
    ]
    names = ["not smoothed", *(f"sigma {sigma:g} px" for sigma in thesis.smoothing)]
    yield wide_edge_step(
        "Smoothing, magnified",
        "Figure 3.11, where the image has its strongest outlines; each tile is scaled to its own brightest pixel. "
        "Without smoothing a LiDAR edge two pixels off its partner scores hardly anything. "
        f"{scene.semantic_edges.capitalize()} are blended in (figure 3.10, see Semantics).",
        tiles(pictures, names, len(names), scene.frame.camera.width),
    )


def _size(gray: Image) -> tuple[int, int]:
    """Height and width of a part worth magnifying."""
    return max(gray.shape[0] // 4, 2), max(gray.shape[1] // 10, 2)
