"""Ray tables of real scanners, from their makers' data sheets and calibration files: one row per laser of a spinning one, per ray
of a solid-state one.

Sources: Velodyne's user manuals (VLP-16, VLP-32C, HDL-32E, HDL-64E S2, VLS-128) and the calibration files of its ROS driver,
whose HDL-64E is that of one unit; Hesai's user manuals of the Pandar40P and Pandar64; Ouster's software manual. The lines of the
M1 and the FT120 are not published: their number, field and steps are those of the data sheets.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib_ros_synthetic.solids import Floats

# Elevations and azimuths in degrees, delays in microseconds after the firing of a column begins, by the maker's laser number.
Table = tuple[Floats, Floats, Floats]


def above_each_other(elevation: Floats) -> Callable[[], Table]:
    """Lasers at elevations (n,) deg that fire together."""
    return lambda: (elevation, np.zeros_like(elevation), np.zeros_like(elevation))


def vlp16() -> Table:
    """16 lasers, 2 deg apart, fired one after the other: low and high ones take turns."""
    k = np.arange(16.0)
    return np.where(k % 2 == 0, -15 + k, k), np.zeros(16), 2.304 * k


def vlp32c() -> Table:
    """32 lasers in four columns, 0.33 deg apart around the horizon and up to 9.4 deg below it; fired in pairs."""
    elevation = [
        -25.0, -1.0, -1.667, -15.639, -11.31, 0.0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4.0,
        -4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667, -3.0, 7.0, 4.667, -2.333, -2.0, 15.0, 10.333, -1.333,
    ]  # fmt: skip
    azimuth = [
        -1.4, 4.2, -1.4, 1.4, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -4.2, 1.4,
        -1.4, 4.2, -1.4, 4.2, -4.2, 1.4, -1.4, 1.4, -1.4, 1.4, -1.4, 4.2, -4.2, 1.4, -1.4, 1.4,
    ]  # fmt: skip
    return np.array(elevation), np.array(azimuth), 2.304 * (np.arange(32.0) // 2)


def hdl32e() -> Table:
    """32 lasers, 1.33 deg apart, from 10.67 to -30.67 deg."""
    k = np.arange(32.0)
    return np.where(k % 2 == 0, -92 / 3, -28 / 3) + (k // 2) * (4 / 3), np.zeros(32), 1.152 * k


def hdl64e() -> Table:
    """Two blocks of 32 lasers, 0.34 and 0.51 deg apart, each in four columns; both blocks fire at the same time."""
    elevation = [
        -7.158, -6.818, 0.318, 0.658, -6.478, -6.138, -8.521, -8.180, -5.798, -5.458, -7.839, -7.499, -3.080,
        -2.741, -5.118, -4.778, -2.401, -2.061, -4.439, -4.099, -1.722, -1.382, -3.759, -3.420, 0.999, 1.339,
        -1.042, -0.702, 1.680, 2.021, -0.362, -0.022, -22.738, -22.226, -11.514, -11.002, -21.715, -21.204, -24.711,
        -24.276, -20.693, -20.183, -23.763, -23.250, -16.615, -16.106, -19.673, -19.163, -15.597, -15.087, -18.558, -18.144,
        -14.577, -14.067, -17.634, -17.125, -10.490, -9.977, -13.557, -13.047, -9.464, -8.950, -12.536, -12.025,
    ]  # fmt: skip
    azimuth = [
        -4.0, -2.25, 4.0, 6.0, 0.8, 2.25, 0.0, 1.3, 4.7, 6.5, 4.0, 6.0, -3.9, -2.0, -4.8, -2.75,
        0.5, 2.25, 0.0, 1.75, 4.9, 6.25, 4.0, 6.0, -3.5, -2.0, -4.5, -2.7, 0.6, 2.0, -0.25, 1.7,
        -7.0, -3.5, 5.5, 8.5, -0.5, 3.5, -1.0, 2.0, 7.0, 10.0, 6.0, 9.5, -6.5, -3.25, -8.0, -5.0,
        0.0, 3.2, -1.0, 2.0, 7.0, 9.5, 6.0, 9.0, -6.0, -3.5, -8.0, -4.5, 0.0, 2.5, -1.0, 1.8,
    ]  # fmt: skip
    return np.array(elevation), np.array(azimuth), 6.0 * (np.arange(64.0) % 32 // 4)


def pandar40p() -> Table:
    """40 lasers, 0.33 deg apart from 2 to -6 deg, 1 to 6 deg outside."""
    elevation = np.r_[15, 11, 8, 5, 3, 2, np.arange(5, -18, -1) / 3, -np.arange(6.0, 15), -19, -25]
    middle = np.tile([3.125, -5.208, -1.042], 8)  # three columns between 2 and -6 deg
    delay = [
        42.22, 28.47, 16.04, 3.62, 45.49, 31.74, 47.46, 54.67, 20.62, 33.71, 40.91, 8.19, 20.62, 27.16, 50.73, 8.19,
        14.74, 36.98, 45.49, 52.70, 23.89, 31.74, 38.95, 11.47, 18.65, 25.19, 48.76, 6.23, 12.77, 35.01, 21.92, 9.50,
        43.52, 29.77, 17.35, 4.92, 42.22, 28.47, 16.04, 3.62,
    ]  # fmt: skip
    return elevation, np.r_[np.full(6, -1.042), middle, np.full(10, -1.042)], np.array(delay)


def pandar64() -> Table:
    """64 lasers, 0.17 deg apart from 2 to -6 deg, 1 to 6 deg outside."""
    elevation = [
        14.882, 11.032, 8.059, 5.057, 3.04, 2.028, 1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337,
        0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.86, -2.028, -2.198, -2.365,
        -2.536, -2.7, -2.873, -3.04, -3.21, -3.375, -3.548, -3.712, -3.884, -4.05, -4.221, -4.385, -4.558, -4.72, -4.892, -5.057,
        -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.06, -9.885, -11.032, -12.006, -12.974, -13.93, -18.889,
        -24.897,
    ]  # fmt: skip
    columns = np.resize([1.042, 3.125, 5.208, -5.208, -3.125, -1.042], 48)
    azimuth = np.r_[np.full(6, -1.042), columns, np.full(10, -1.042)]
    # Channels fire in pairs, first those with the long reach.
    order = [
        50, 60, 44, 59, 38, 56, 8, 54, 48, 62, 42, 58, 6, 55, 52, 63, 46, 61, 40, 57, 5, 53, 4, 47, 3, 49, 2, 51, 1, 45, 0, 43,
        23, 32, 26, 41, 20, 35, 14, 29, 21, 36, 15, 30, 9, 24, 18, 33, 12, 27, 19, 34, 13, 28, 7, 22, 16, 31, 10, 25, 17, 37, 11,
        39,
    ]  # fmt: skip
    step = np.arange(32)
    pair = 1.304 * np.minimum(step, 15) + 1.968 * np.maximum(step - 15, 0) + 3.62
    delay = np.zeros(64)
    delay[order] = np.repeat(pair, 2)
    return np.array(elevation), azimuth, delay


def os1_64() -> Table:
    """64 lasers (first generation), evenly over 33.2 deg, in four columns; a column's lasers fire together."""
    return np.linspace(16.611, -16.611, 64), np.tile([3.164, 1.055, -1.055, -3.164], 16), np.zeros(64)


def os1_128() -> Table:
    """128 lasers, evenly over 45 deg, in four columns; a column's lasers fire together."""
    return np.linspace(22.5, -22.5, 128), np.tile([4.23, 1.41, -1.41, -4.23], 32), np.zeros(128)


def vls128() -> Table:
    """128 lasers in eight columns, 0.11 deg apart around the horizon and up to 5.4 deg below it; fired in groups of eight."""
    elevation = [
        -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19,
        -3.86, 1.53, -9.244, -1.77, 2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58,
        -0.34, 5.18, -3.64, 1.75, -25.0, -2.43, 2.96, -5.73, 0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85,
        3.18, -5.51, -0.12, 5.73, -4.3, 1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15.0, -3.42, 1.97, -6.85, -1.33,
        -5.62, -0.23, 5.43, -3.53, 0.98, -19.582, -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44, 3.95,
        -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2, -13.565, -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65,
        1.42, -10.346, -1.88, 3.51, -6.06, -0.67, 4.72, -3.97, 2.3, -6.39, -1.0, 4.39, -5.18, 0.21, 6.98, -3.09,
        4.98, -3.75, 1.64, -8.352, -2.54, 2.85, -5.84, -0.45, 8.43, -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43,
    ]  # fmt: skip
    azimuth = np.tile([-6.354, -4.548, -2.732, -0.911, 0.911, 2.732, 4.548, 6.354], 16)
    return np.array(elevation), azimuth, 2.665 * (np.arange(128.0) // 8)


def rs_m1() -> Table:
    """A micromirror sweeps five lasers, 24 deg apart, to and fro over fields of 25 by 25 deg: lines that bend, no two alike."""
    lines, along = 126, 125
    line, k = np.divmod(np.arange(lines * along), along)
    fast = np.where(line % 2 == 0, 1, -1) * (2 * (k + 0.5) / along - 1)  # of half a field
    slow = 1 - 2 * (line + (k + 0.5) / along) / lines
    channel = np.arange(5.0)[None] - 2
    roll = np.deg2rad(0.8 * channel)
    a, e = 12.5 * fast[:, None], 12.5 * slow[:, None] + 0.7 * np.square(fast[:, None]) * channel / 2
    azimuth, elevation = a * np.cos(roll) - e * np.sin(roll) - 24 * channel, a * np.sin(roll) + e * np.cos(roll)
    delay = np.broadcast_to(np.linspace(0, 1e5, lines * along)[:, None], (*a.shape[:1], 5))
    return elevation.ravel(), azimuth.ravel(), delay.ravel()


def ft120() -> Table:
    """A flash: 160 by 120 pixels behind a lens, 100 by 75 deg; lines bend as in wide pictures. A row after the other."""
    y, z = np.meshgrid(np.linspace(50, -50, 160), np.linspace(37.5, -37.5, 120))
    r = np.deg2rad(np.hypot(y, z))  # equidistant
    x, side = np.cos(r), np.sin(r) / np.maximum(np.hypot(y, z), 1e-9)
    azimuth, elevation = np.arctan2(y * side, x), np.arcsin(z * side)
    return np.rad2deg(elevation).ravel(), np.rad2deg(azimuth).ravel(), np.linspace(0, 1000.0, 160 * 120)
