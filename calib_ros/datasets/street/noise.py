"""Procedural noise for the textures of the synthetic street: tables made once from a fixed seed, and looked up."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Floats = NDArray[np.float64]

SIZE = 512  # entries per side of the plane table, which repeats
CELLS = 32  # entries per side of the space table, which repeats
LEAF_SIZE = 0.08  # m; grain of foliage
ROW = 1024  # OpenCV refuses to remap very long rows


@lru_cache(maxsize=1)
def _plane() -> Float32:
    """Fractal noise (SIZE, SIZE), mean 0, standard deviation 1, without seams."""
    rng = np.random.default_rng(0)
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE)))
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE))
    frequency[0, 0] = 1
    noise = np.fft.irfft2(spectrum / frequency, (SIZE, SIZE))
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


@lru_cache(maxsize=1)
def _space() -> Float32:
    """Smoothed random numbers (CELLS**3,) with values spread evenly over 0..1."""
    noise = np.random.default_rng(1).standard_normal((CELLS,) * 3)
    for axis in range(3):
        noise = noise + 0.6 * (np.roll(noise, 1, axis) + np.roll(noise, -1, axis))
    return (np.argsort(np.argsort(noise, axis=None)) / noise.size).astype(np.float32)


@lru_cache(maxsize=1)
def _hash() -> Float32:
    return np.random.default_rng(2).random(4096).astype(np.float32)


def noise2(u: Float32, v: Float32, scale: float) -> Float32:
    """Fractal noise at u, v (n,) metres, `scale` table entries per metre, between the entries linear -> (n,)."""
    n = u.size
    if n == 0:
        return np.zeros(0, np.float32)
    maps = []
    for a in (u, v):
        a = a * np.float32(scale / SIZE)
        padded = np.zeros(-(-n // ROW) * ROW, np.float32)
        padded[:n] = (a - np.floor(a)) * np.float32(SIZE)
        maps.append(padded.reshape(-1, ROW))
    return np.asarray(cv2.remap(_plane(), maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)).ravel()[:n]


def cell(*index: Float32 | Floats | float) -> Float32:
    """A random number in 0..1 for each combination of whole numbers, given as float arrays or scalars."""
    primes = (73, 179, 283, 419)
    total = sum(np.floor(np.asarray(i, np.float32)).astype(np.int64) * p for i, p in zip(index, primes, strict=False))
    return np.asarray(_hash()[np.asarray(total) & 4095], np.float32)


def leaf_gap(x: Float32, y: Float32, z: Float32, openness: float) -> NDArray[np.bool_]:
    """Whether there is no leaf at x, y, z (n,) metres in foliage. openness: 0..1, how open this clump is."""
    a = 1 / LEAF_SIZE
    # Skewed axes, for a person sees grains that lie in rows.
    i = np.floor(a * x + (0.37 * a) * z + 64 * openness).astype(np.int32) & (CELLS - 1)
    j = np.floor(a * y + (0.31 * a) * x).astype(np.int32) & (CELLS - 1)
    k = np.floor(a * z + (0.43 * a) * y).astype(np.int32) & (CELLS - 1)
    return np.asarray(_space().take((i * CELLS + j) * CELLS + k) < 0.40 + 0.25 * openness)
