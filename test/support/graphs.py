"""Rigs as graphs alone: true poses, and edges and priors with errors of known size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros import se3
from calib_ros.rig.description import prior_covariance
from calib_ros.rig.graph import Edge

SIGMA = np.r_[np.full(3, np.deg2rad(0.05)), np.full(3, 0.01)]  # of edges
Poses = Mapping[str, np.ndarray]
Pairs = Sequence[tuple[str, str]]


def rig(lidars: int, cameras: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([seed, lidars, cameras])
    poses = {"l0": np.eye(4)} | {f"l{k}": se3.exp(np.r_[rng.normal(0, 0.3, 3), rng.normal(0, 1, 3)]) for k in range(1, lidars)}
    return poses | {f"c{k}": se3.exp(np.r_[rng.uniform(-1.5, 1.5, 3), rng.normal(0, 1, 3)]) for k in range(cameras)}


# A ring of cameras around a LiDAR, a stereo pair under one, and two LiDARs whose views most cameras share: poses and pairs.
RIGS: dict[str, tuple[dict[str, np.ndarray], Pairs]] = {
    "ring": (rig(1, 6), [(f"c{k}", "l0") for k in range(6)]),
    "stereo": (rig(1, 2), [("c0", "l0"), ("c1", "l0")]),
    "loops": (rig(2, 3), [("l0", "l1"), ("c0", "l0"), ("c0", "l1"), ("c1", "l0"), ("c1", "l1"), ("c2", "l1")]),
}


def edges(poses: Poses, pairs: Pairs, rng: np.random.Generator, sigma: np.ndarray = SIGMA) -> list[Edge]:
    """Measured edges, each a left twist of the truth."""
    return [
        Edge(a, b, se3.exp(rng.normal(size=6) * sigma) @ se3.inverse(poses[a]) @ poses[b], np.diag(sigma**2)) for a, b in pairs
    ]


def priors(poses: Poses, rng: np.random.Generator, deg: float = 3.0, m: float = 0.2) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What a drawing says of all sensors but the first."""
    found = {}
    for name, T in list(poses.items())[1:]:
        e = rng.normal(size=6)
        R = se3.exp(np.r_[e[:3] * np.deg2rad(deg), 0, 0, 0])[:3, :3] @ T[:3, :3]
        P = se3.from_parts(R, T[:3, 3] + e[3:] * m)
        found[name] = P, prior_covariance(P, deg, m)
    return found
