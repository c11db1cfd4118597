"""How a driver or a data set hands out a scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from calib_ros import se3
from calib_ros.frame import PointCloud
from calib_ros_synthetic.rigs import Fields, Intensity, Rig
from calib_ros_synthetic.solids import Floats

SIGNAL = 2000.0  # photons from a white wall 10 m away
BRIGHTEST = 70_000.0


def delivered(
    rig: Rig, T_base_lidar: Floats, cloud: PointCloud, twist: Floats, fields: Fields, rng: np.random.Generator
) -> tuple[PointCloud, NDArray[np.intp]]:
    """A scan as the driver or the data set hands it out, and which of its points (n,) are left.

    cloud: in the frame of the moving scanner, which is at T_base_lidar (4, 4) on the vehicle; twist: (6,) of the scanner.
    """
    assert cloud.intensity is not None
    xyz, intensity = cloud.xyz.astype(float), cloud.intensity
    if rig.intensity is Intensity.BYTE:
        intensity = np.rint(255 * intensity).astype(np.float32)
    elif rig.intensity is Intensity.SIGNAL:
        photons = SIGNAL * 100.0 * intensity / np.maximum(np.square(cloud.xyz).sum(axis=1), 1.0)
        intensity = np.asarray(rng.poisson(np.minimum(photons, 60_000.0)), np.float32)
    elif rig.intensity is Intensity.WIDE:
        bright = BRIGHTEST * rng.random(len(intensity)) ** 3
        intensity = np.asarray(np.where(intensity > 0.97, bright, intensity), np.float32)
    if rig.compensated and cloud.time is not None and twist.any() and len(xyz):  # to where they are at time 0
        time = cloud.time.astype(float)
        knots = np.linspace(time.min(), time.max(), 65)
        at = make_interp_spline(knots, np.array([se3.exp(twist * s)[:3] for s in knots]), k=1)(time)
        xyz = np.einsum("nij,nj->ni", at[:, :, :3], xyz) + at[:, :, 3]
    base = se3.transform(T_base_lidar, xyz)
    keep = np.flatnonzero(np.abs(base[:, 1]) <= rig.crop)
    left_out = ("time", "ring", "intensity")[: list(Fields).index(fields)]
    whole = replace(cloud, xyz=(base if rig.base_frame else xyz).astype(np.float32), intensity=intensity)
    return replace(whole, **dict.fromkeys(left_out)).select(keep), keep  # type: ignore[arg-type]
