"""Oriented, multi-level image edge maps of the fast score.

A left/right range jump of the scan must meet a horizontal gradient, an upward jump a vertical one: keeping the two apart removes
false optima whose score exceeds that of the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import quantile
from calib_ros.image.enhance import BILATERAL_DIAMETER, prepare
from calib_ros.image.mask import filled, without_border

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]
# Blur of the levels, coarse to fine, px at this focal length: a finer first level loses starts, a coarser one finds wrong optima.
SIGMAS, REFERENCE_FOCAL_LENGTH = (16.0, 8.0, 4.0, 2.0, 1.2), 720.0
GRADIENT_PERCENTILE = 97.0  # of the gradient magnitude, which counts as a full edge: relative, for pictures of any contrast
MIN_MAGNITUDE = 8.0  # Sobel magnitude of two grey levels; rounding of the filters makes steps of one even in a black image
# Where the picture is flat, its gradient is the noise's: each component normal, the magnitude Rayleigh distributed.
TILES = 16  # a side; the noise is that of their flattest quarter: leaves and bricks fill whole tiles
MIN_TILE = 8  # px
FLAT_TILES = 25.0  # percentile of tiles
LOW = 20.0  # percentile of a tile's magnitudes that gives its scale: edges through a flat tile lie above
NOISE_PASSED = 0.01  # share of noise above the limit; 0.02 in practice, since the flattest tiles are also so by chance
EDGE_REACH = 2  # px; of Sobel and of non-maximum suppression
STORED_BLUR = 1.9  # px of a stored level, at least; 2 would store a camera of 719 px at twice the size of one of 721 px
MIN_SIGMA = 0.8  # px; with less blur, pixel noise dominates the gradient of the maps
# The local mean of a level is its edges blurred LOCAL_MEAN times as wide, plus a share of the mean over the picture.
LOCAL_MEAN, LOCAL_OFFSET = 3.0, 0.3
# Maps have mean 0 and deviation 1. One pixel of an edge in 2000 reaches 45 deviations; rounding is noise of 0.0006 of one.
UNIT, LARGEST = 1 / 512, 63.0
SMALLEST_BLUR, MIN_SHRUNK = 1.65, 8  # px of a shrunk image: sigma at least, and its sides


@dataclass(frozen=True, eq=False)
class EdgeLevel:
    """One resolution of the edge maps. packed: (c, h, w) int16, `maps` in units of UNIT: keyframes take half the memory, and the
    score half the time to look them up. scale: full size = h * scale. sigma: blur in full-size pixels."""

    packed: NDArray[np.int16]
    scale: int
    sigma: float

    @staticmethod
    def of(maps: Map, scale: int, sigma: float) -> EdgeLevel:
        """A level of maps (c, h, w), which are rounded to UNIT and end at LARGEST."""
        return EdgeLevel(np.rint(np.clip(maps, -LARGEST, LARGEST) / UNIT).astype(np.int16), scale, sigma)

    @property
    def maps(self) -> Map:
        """(c, h, w) float32, standardised; of oriented edges [0] horizontal gradients (vertical lines), [1] vertical ones."""
        return np.asarray(self.packed * np.float32(UNIT), np.float32)


def oriented_edges(gray: NDArray[np.uint8], used: Mask | None = None, across: Map | None = None) -> tuple[Map, ...]:
    """Prepared grey image (H, W) -> edge strength of horizontal and of vertical gradients, two (H, W) maps in 0..1.

    Sobel magnitude, saturated at a percentile, half of it thinned by non-maximum suppression, split by the direction of
    the gradient: E cos^2 and E sin^2. used: (H, W), the pixels whose percentile it is; None = all. across: unit vectors
    (2, H, W) of the direction that counts as horizontal; None = along the rows.
    """
    gx, gy = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    # cv2.magnitude rounds by the alignment of the array in memory: not repeatable
    along = gx if across is None else gx * across[0] + gy * across[1]
    square = gy * gy
    square += gx * gx
    magnitude = np.sqrt(square)
    cv2.threshold(magnitude, smallest_magnitude(magnitude, used), 0, cv2.THRESH_TOZERO, dst=magnitude)
    sample = (magnitude if used is None else magnitude[used]).ravel()[::4]  # a full sort would cost more than all the rest
    k = _rank(len(sample), GRADIENT_PERCENTILE)
    full = float(np.partition(sample, k)[k]) if len(sample) else 0.0
    steep = np.abs(gx) >= np.abs(gy)  # masks are combined bit by bit: np.where, which branches, takes ten times as long
    ridge = (steep & _is_ridge(magnitude, 1)) | (~steep & _is_ridge(magnitude, 0))
    edge = magnitude * np.float32(1 / (full + 1e-6))
    cv2.threshold(edge, 1, 0, cv2.THRESH_TRUNC, dst=edge)
    edge *= ridge * np.float32(0.5) + np.float32(0.5)
    square += np.float32(1e-6)
    along = along * along / square
    along *= edge
    return along, edge - along


def smallest_magnitude(magnitude: Map, used: Mask | None = None) -> float:
    """Sobel magnitude (H, W) -> the magnitude from which on it counts as an edge: above some 98 % of the picture's own noise.
    used: (H, W), the pixels that are asked; None = all."""
    rows, columns = (_parts(size, max(min(TILES, size // MIN_TILE), 1)) for size in magnitude.shape)
    scales: list[float] = []
    for (top, down, height), (left, across, width) in product(rows, columns):  # tiles of one size at once
        block = np.s_[top : top + down * height, left : left + across * width]
        tiles = magnitude[block].reshape(down, height, across, width)[:, ::2, :, ::2].transpose(0, 2, 1, 3)
        values = tiles.reshape(down * across, -1)
        if used is not None:
            asked = used[block].reshape(down, height, across, width)[:, ::2, :, ::2].all(axis=(1, 3)).ravel()
            values = values[asked]
        k = _rank(values.shape[1], LOW)
        scales += np.partition(values, k, axis=1)[:, k].tolist()
    # What is over- or underexposed has no gradients at all, nor noise.
    scale = np.array([s for s in scales if s > 0]) / np.sqrt(-2 * np.log(1 - LOW / 100))
    if not len(scale):
        return MIN_MAGNITUDE
    return max(MIN_MAGNITUDE, float(quantile(scale, FLAT_TILES / 100)) * float(np.sqrt(-2 * np.log(NOISE_PASSED))))


def _parts(size: int, count: int) -> list[tuple[int, int, int]]:
    """(begin, number, size) of `count` parts of about the same size, the larger ones first."""
    small, larger = divmod(size, count)
    parts = [(0, larger, small + 1), (larger * (small + 1), count - larger, small)]
    return [part for part in parts if part[1] > 0]


def _rank(count: int, percentile: float) -> int:
    return min(int(count * percentile / 100), count - 1)


def _is_ridge(magnitude: Map, axis: int) -> NDArray[np.bool_]:
    out = np.ones(magnitude.shape, bool)
    before, after = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
    out[after] &= magnitude[after] >= magnitude[before]
    out[before] &= magnitude[before] >= magnitude[after]
    return out


def edge_levels(
    image: NDArray[np.uint8],
    focal_length: float,
    semantic: Map | None = None,
    share: float = 0.0,
    used: Mask | None = None,
    across: Map | None = None,
    least: float = 0.0,
) -> list[EdgeLevel]:
    """Rectified image (H, W[, 3]) -> oriented edge maps per level, coarse to fine (see `blurred_levels`).

    semantic: oriented edges (2, H, W) in 0..1, of which `share` is blended in (figure 3.10). used: (H, W), False where there are
    to be no edges, nor one along the border; None = everywhere. across: see `oriented_edges`. least: of the blur, rad.
    """
    if used is not None:
        used = without_border(used, BILATERAL_DIAMETER // 2 + EDGE_REACH)
    edges = oriented_edges(prepare(image), used, across)
    if semantic is not None:
        edges = tuple(np.asarray((1 - share) * g + share * s, np.float32) for g, s in zip(edges, semantic, strict=True))
    if used is not None:
        edges = tuple(filled(e, used) for e in edges)
    return blurred_levels(edges, focal_length, local_contrast=True, least=least)


def blurred_levels(
    edges: Sequence[Map], focal_length: float, sigmas: Sequence[float] = SIGMAS, local_contrast: bool = False, least: float = 0.0
) -> list[EdgeLevel]:
    """Edge maps (H, W) of any number of channels -> levels, coarse to fine.

    The blur is an angle: it grows with the focal length (px). Coarse levels are stored smaller, at about half their blur.
    local_contrast: divide every level by its local mean. least: of the blur, rad: by how much what meets the maps is off, below
    which its best match is one of chance.
    """
    levels = []
    for sigma in sigmas:
        height, width = edges[0].shape
        # At most the size of the image, whatever the focal length, and at least one pixel remains.
        blur = min(max(sigma * focal_length / REFERENCE_FOCAL_LENGTH, MIN_SIGMA), max(height, width))
        scale = 1 << int(np.log2(min(max(blur / STORED_BLUR, 1), height, width)))
        blur = max(blur, min(least * focal_length, height, width))  # the size stays: frames lie side by side
        levels.append(EdgeLevel(np.stack([_blurred(e, blur, scale, local_contrast) for e in edges]), scale, blur))
    return levels


def _blurred(edge: Map, sigma: float, scale: int, local_contrast: bool) -> NDArray[np.int16]:
    """Blur, shrink and standardise to mean 0 and deviation 1, so that 0 is also the value outside the image; in units of UNIT."""
    if scale > 1:
        h, w = edge.shape[0] // scale, edge.shape[1] // scale
        edge = np.asarray(cv2.resize(edge[: h * scale, : w * scale], (w, h), interpolation=cv2.INTER_AREA), np.float32)
        sigma = float(np.sqrt(sigma**2 - (scale**2 - 1) / 12)) / scale  # the box filter of the shrinking is part of the blur
    edge = np.asarray(cv2.GaussianBlur(edge, (0, 0), sigma), np.float32)
    if local_contrast:
        # (a - b) / (b + OFFSET mean b) for an edge map a and its local mean b. Without it a coarse level measures how many edges
        # there are: a cloud over the busiest part scores more than the truth.
        wide = _wide_blur(edge, float(np.sqrt(LOCAL_MEAN**2 - 1)) * sigma)
        offset = np.float32(LOCAL_OFFSET * cv2.mean(wide)[0] + 1e-6)
        np.subtract(edge, wide, out=edge)
        wide += offset
        edge /= wide
    mean = cv2.mean(edge)[0]
    deviation = np.sqrt(max(cv2.norm(edge, cv2.NORM_L2SQR) / edge.size - mean**2, 0.0))  # meanStdDev takes four times as long
    if deviation < 1e-6:  # a uniform image has no edges
        return np.zeros(edge.shape, np.int16)
    units = 1 / (deviation * UNIT)
    return np.asarray(cv2.addWeighted(edge, units, edge, 0, -mean * units, dtype=cv2.CV_16S), np.int16)


def _wide_blur(values: Map, sigma: float) -> Map:
    """Gaussian blur of (h, w), px, to 1 or 2 % of the mean, on a smaller image: the time of a kernel grows with its width."""
    height, width = values.shape
    scale = 1 << max(int(np.log2(sigma / SMALLEST_BLUR)), 0)
    scale = min(scale, max(height // MIN_SHRUNK, 1), max(width // MIN_SHRUNK, 1))
    if scale < 2:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)
    margin = scale * int(np.ceil(2 * sigma / scale))  # within which the picture goes on as a mirror image
    below, right = margin - height % -scale, margin - width % -scale
    whole = cv2.copyMakeBorder(values, margin, below, margin, right, cv2.BORDER_REFLECT_101)
    small = cv2.resize(whole, (whole.shape[1] // scale, whole.shape[0] // scale), interpolation=cv2.INTER_AREA)
    # The box filter of the shrinking and the triangle of the enlarging are part of the blur.
    rest = np.sqrt(sigma**2 - (scale**2 - 1) / 12 - scale**2 / 6) / scale
    wide = cv2.resize(cv2.GaussianBlur(small, (0, 0), rest), (whole.shape[1], whole.shape[0]))
    return np.asarray(wide[margin : margin + height, margin : margin + width], np.float32)
