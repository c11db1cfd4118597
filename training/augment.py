"""Augmentation of training pictures towards other cameras. All randomness comes from the generator that is passed in.

Other cameras have wider pictures, shorter focal lengths, harder light and shadows, overexposed skies, or no colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from training.data import BUILDING, NAMES, SKY, VOID, Image, Labels, Pair

# Height and width of crops, about equally many pixels: multiples of the network's stride 16, up to KITTI's 1242x375.
SHAPES = ((288, 384), (224, 496), (192, 576))
SCALES = (0.6, 2.2)
STRETCH = 1.2  # of the width against the height, or its inverse
# Small things, of which pictures show few: every other crop is put around one of them, and every other picture gets
# those of another one.
SMALL = np.isin(np.arange(VOID + 1), [NAMES.index(n) for n in ("pole", "sign", "fence", "car", "pedestrian", "cyclist")])
MOVABLE = np.isin(np.arange(VOID + 1), [NAMES.index(n) for n in ("pole", "sign", "car", "pedestrian", "cyclist")])
GREY_SHARE = 0.3  # of pictures without colour: grey cameras are common beside LiDARs
MEANS = (60, 165)  # grey levels; where cameras that control their exposure bring the mean of a picture
GREY_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)  # of RGB, ITU-R BT.601

Floats = NDArray[np.float32]


def training_crop(pictures: Sequence[Pair], first: int, size: tuple[int, int], rng: np.random.Generator) -> Pair:
    """A crop (height, width) around the first picture with everything random about it: RGB and labels, uint8."""
    image, labels = random_canvas(pictures, first, size, rng)
    return recoloured(image, labels, rng), labels


def random_canvas(pictures: Sequence[Pair], first: int, size: tuple[int, int], rng: np.random.Generator) -> Pair:
    """Scaled, stretched and flipped parts of pictures side by side until the width is full: wide pictures at any scale.

    Rows that a small picture leaves empty are VOID.
    """
    height, width = size
    image, labels = np.full((height, width, 3), 127, np.uint8), np.full(size, VOID, np.uint8)
    number, left = first, 0
    while left < width:
        pair = pictures[number]
        if rng.random() < 0.5:
            pair = with_things_of(pair, pictures[int(rng.integers(len(pictures)))])
        part, classes = _rescaled(pair, rng)
        rows, columns = min(height, part.shape[0]), min(width - left, part.shape[1])
        top, start = _corner(classes, rows, columns, rng)
        row = int(rng.integers(height - rows + 1))
        target = np.s_[row : row + rows, left : left + columns]
        image[target] = part[top : top + rows, start : start + columns]
        labels[target] = classes[top : top + rows, start : start + columns]
        number, left = int(rng.integers(len(pictures))), left + columns
    return image, labels


def with_things_of(pair: Pair, other: Pair) -> Pair:
    """The picture with the movable things of another one at the same places (after ClassMix, Olsson et al. 2021).

    Pictures of another size are left as they are.
    """
    if pair[1].shape != other[1].shape:
        return pair
    moved = MOVABLE[other[1]]
    return np.where(moved[..., None], other[0], pair[0]), np.where(moved, other[1], pair[1])


def _corner(classes: Labels, rows: int, columns: int, rng: np.random.Generator) -> tuple[int, int]:
    """First row and column of a crop: anywhere, or such that one of the small things, each class alike, is in it."""
    free = classes.shape[0] - rows, classes.shape[1] - columns
    if rng.random() < 0.5:
        there = np.flatnonzero((np.bincount(classes.ravel(), minlength=VOID + 1) > 0) & SMALL)
        if len(there):
            spots = np.flatnonzero(classes == there[int(rng.integers(len(there)))])
            row, column = divmod(int(spots[int(rng.integers(len(spots)))]), classes.shape[1])
            top, left = row - int(rng.integers(rows)), column - int(rng.integers(columns))
            return min(max(top, 0), free[0]), min(max(left, 0), free[1])
    return int(rng.integers(free[0] + 1)), int(rng.integers(free[1] + 1))


def recoloured(image: Image, labels: Labels, rng: np.random.Generator) -> Image:
    """The picture under another sky, in other light, by another camera."""
    out = image.astype(np.float32)
    if rng.random() < 0.4:
        _change_sky(out, labels == SKY, rng)
    if rng.random() < 0.3:  # else what is bright and smooth would be sky, house fronts in the sun too
        out[labels == BUILDING] *= np.float32(np.exp(rng.uniform(-0.5, 0.6)))
    if rng.random() < 0.4:
        _cast_shadow(out, labels, rng)
    out = _change_light(out, rng)
    out = _change_sharpness(out, rng)
    if rng.random() < 0.5:
        spread = rng.uniform(0, 14)
        shape = out.shape if rng.random() < 0.5 else (*out.shape[:2], 1)  # noise of colour or of brightness
        out += rng.standard_normal(shape, np.float32) * np.float32(spread)
    if rng.random() < GREY_SHARE:
        out[:] = (out @ GREY_WEIGHTS)[..., None]
    return np.asarray(np.clip(np.rint(out), 0, 255), np.uint8)


def _rescaled(pair: Pair, rng: np.random.Generator) -> Pair:
    image, labels = pair
    scale = np.exp(rng.uniform(*np.log(SCALES)))
    stretch = np.exp(rng.uniform(-1, 1) * np.log(STRETCH) / 2)
    size = (max(round(image.shape[1] * scale * stretch), 16), max(round(image.shape[0] * scale / stretch), 16))
    image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR), np.uint8)
    labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint8)
    return (image[:, ::-1], labels[:, ::-1]) if rng.random() < 0.5 else (image, labels)


def _change_sky(out: Floats, sky: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Sky of one colour, white, grey or blue, that changes from top to bottom, in place of some of its own."""
    top, bottom = rng.uniform(90, 300, 2)  # above 255: overexposed
    blue = np.array([1.0, 1.0, 1.0]) - rng.uniform(0, 0.5) * np.array([1.0, 0.5, 0.0])
    own = rng.uniform(0, 0.5)
    new = (np.linspace(top, bottom, len(out))[:, None] * blue).astype(np.float32)
    out[sky] = np.float32(own) * out[sky] + np.float32(1 - own) * np.broadcast_to(new[:, None], out.shape)[sky]


def _cast_shadow(out: Floats, labels: Labels, rng: np.random.Generator) -> None:
    """Shadows with hard or soft borders on everything but the sky, of leaves (noise) or of something large (a polygon)."""
    height, width = labels.shape
    shade = np.zeros((height, width), np.float32)
    if rng.random() < 0.5:
        cell = rng.uniform(10, 60)
        # Seen at a flat angle, shadows on the ground are wider than high.
        coarse = rng.standard_normal((int(height / cell * 2) + 2, int(width / cell) + 2), np.float32)
        noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        shade[noise > np.quantile(noise, rng.uniform(0.4, 0.85))] = 1
    else:
        for _ in range(int(rng.integers(1, 4))):
            corners = rng.uniform((-0.2, 0.2), (1.2, 1.2), (int(rng.integers(3, 6)), 2)) * (width, height)
            cv2.fillConvexPoly(shade, cv2.convexHull(corners.astype(np.int32)), 1.0)
    shade = np.asarray(cv2.GaussianBlur(shade, (0, 0), rng.uniform(0.5, 4)), np.float32)
    shade[labels == SKY] = 0
    # What lights a shadow is the sky: less red in it.
    light = rng.uniform(0.25, 0.75) * np.array([1.0, 1.0, 1.0]) + rng.uniform(0, 0.1) * np.array([-1.0, 0.0, 1.0])
    out *= 1 - shade[..., None] * (1 - light).astype(np.float32)


def _change_light(out: Floats, rng: np.random.Generator) -> Floats:
    """Exposure, contrast, gamma, white balance, saturation."""
    grey: Floats = (out @ GREY_WEIGHTS)[..., None]
    out = grey + (out - grey) * np.float32(rng.uniform(0, 1.8))
    out *= np.exp(rng.uniform(-0.25, 0.25, 3)).astype(np.float32)
    middle = np.float32(out.mean())
    out = (out - middle) * np.float32(np.exp(rng.uniform(-0.5, 0.5))) + np.float32(rng.uniform(*MEANS))
    return np.asarray((np.clip(out, 0, 255) / 255) ** np.float32(np.exp(rng.uniform(-0.4, 0.4))) * 255, np.float32)


def _change_sharpness(out: Floats, rng: np.random.Generator) -> Floats:
    kind = rng.random()
    if kind < 0.25:
        return np.asarray(cv2.GaussianBlur(out, (0, 0), rng.uniform(0.4, 1.6)), np.float32)
    if kind < 0.5:  # some cameras sharpen
        soft = np.asarray(cv2.GaussianBlur(out, (0, 0), 1.2), np.float32)
        return np.asarray(out + np.float32(rng.uniform(0.3, 1.5)) * (out - soft), np.float32)
    if kind < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 80))]
        data = cv2.imencode(".jpg", np.clip(out, 0, 255).astype(np.uint8), quality)[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.float32)
    return out
