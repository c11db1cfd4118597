"""Which pixels of the recorded image are used: all but the vehicle's own bonnet, mirrors or sensor mounts, which do not move."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ImageConfig
from calib_ros.errors import BadInputError
from calib_ros.messages.pictures import read_picture

Mask = NDArray[np.bool_]
Map = NDArray[np.float32]
MIN_USED = 0.05  # share of the image; less hardly holds an edge, and is most likely a mask with its values inverted
FILL_SCALE = 8  # px of a cell in which local means are taken: blurring whole images that widely costs more than their edges
FILL_BLUR = 4.0  # cells; twice the coarsest blur of the maps at the reference focal length
FAR_WEIGHT = 1e-3  # of the mean of the whole image, beside used pixels nearby; it decides only where there are none


def used_pixels(config: ImageConfig, width: int, height: int) -> Mask | None:
    """Pixels (height, width) of the recorded image that ``image.mask`` and ``image.ignored_boxes`` leave; None = all. Raises
    BadInputError if the mask cannot be read, has another size than the image, or hardly leaves a pixel."""
    used = np.ones((height, width), bool)
    if config.mask:
        path = Path(config.mask)
        picture = read_picture(path, "image.mask")
        if picture.shape[:2] != (height, width):
            raise BadInputError(
                f"image.mask {path} is {picture.shape[1]}x{picture.shape[0]}, the camera's image is {width}x{height}; "
                "draw it on an image as recorded"
            )
        # An opacity says nothing, and JPEG has no pure black.
        values = picture if picture.ndim == 2 else picture[:, :, :3].max(axis=2)
        used = np.asarray(values > (0 if path.suffix.lower() in (".png", ".bmp") else 127))
    for left, top, right, bottom in np.reshape(config.ignored_boxes, (-1, 4)):
        x, y = np.rint(np.array([left, right]) * width).astype(int), np.rint(np.array([top, bottom]) * height).astype(int)
        used[y[0] : y[1], x[0] : x[1]] = False
    if used.all():
        return None
    if used.mean() < MIN_USED:
        raise BadInputError(
            f"image.mask and image.ignored_boxes leave {100 * used.mean():.1f} % of the image; in the mask, pixels to use are "
            "white and others black"
        )
    return used


def check_mask(config: ImageConfig, size: tuple[int, int] | None) -> None:
    """BadInputError as of `used_pixels` for images of a size, width x height px; None = not known yet."""
    if size is not None:
        used_pixels(config, *size)
    elif config.mask:
        read_picture(Path(config.mask), "image.mask")


def without_border(used: Mask, reach: int) -> Mask:
    """The used pixels (H, W) that are more than `reach` px away from others; the image's own border is none."""
    kernel = np.ones((2 * reach + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(used.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1), bool)


def filled(values: Map, used: Mask) -> Map:
    """`values` (H, W) with the local mean of the used pixels in place of the others, by normalised convolution (Knutsson 1993).
    Zeros there would be a region without edges, whose outline is one in every map that compares a place with its surroundings."""
    if not used.any():
        return np.zeros_like(values)
    size = (max(values.shape[1] // FILL_SCALE, 1), max(values.shape[0] // FILL_SCALE, 1))
    weight = used.astype(np.float32)
    known, share = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), FILL_BLUR)
        for part in (values * weight, weight)
    )
    mean = np.float32(values[used].mean())
    local = (known + FAR_WEIGHT * mean) / (share + FAR_WEIGHT)
    wide = cv2.resize(local, (values.shape[1], values.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(used, values, wide), np.float32)
