"""The compiled inner loop of the scores, against SciPy's samples of the maps and differences of projected points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import MissingDependencyError
from calib_ros.image.edges import UNIT, EdgeLevel
from calib_ros.registration.score import sampler as sampling
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.sampler import MIN_DEPTH, Sampler, load_kernel, slope_step

WIDTH, HEIGHT, FRAMES = 320, 160, 3
SCALES = ((4, 8.0), (2, 4.0), (1, 1.5))
K = np.array([[150.0, 0, 158], [0, 145, 83], [0, 0, 1]])
PINHOLE, SPHERE = Camera(K, WIDTH, HEIGHT), Camera(K, WIDTH, HEIGHT, "sphere")


def atlas(camera: Camera) -> Atlas:
    """Edge maps of noise, smooth enough for bilinear samples to mean something."""
    rng = np.random.default_rng(1)
    frames = []
    for _ in range(FRAMES):
        levels = []
        for scale, sigma in SCALES:
            maps = np.cumsum(rng.standard_normal((2, HEIGHT // scale, WIDTH // scale)), axis=2) / 8
            levels.append(EdgeLevel.of(maps.astype(np.float32), scale, sigma))
        frames.append(levels)
    return Atlas(frames, camera)


def points_around(n: int, seed: int = 0) -> np.ndarray:
    """In the camera's frame: most of them in view, some beside it, behind it, nearer than is scored and on its very centre."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-20, -8, 0.3], [20, 8, 25], (n, 3))
    xyz[::7] *= -1
    xyz[::11] *= 0.02
    xyz[: min(n, 1)] = 0
    return np.ascontiguousarray(xyz.T, np.float32)


class Reference:
    """See Sampler; pose by pose and in double precision."""

    def __init__(self, points: np.ndarray, weights: np.ndarray, tiles: np.ndarray, maps: Atlas) -> None:
        self.points, self.weights, self.tiles, self.maps = points.T.astype(float), weights.astype(float), tiles, maps

    def samples(self, T: np.ndarray, level: int) -> np.ndarray:
        return self._sampled(self._pixels(T, level), level)

    def values(self, transforms: np.ndarray, level: int) -> np.ndarray:
        return np.array([self.samples(T, level) @ self.weights for T in transforms])

    def group_values(self, transforms: np.ndarray, level: int, first: np.ndarray) -> np.ndarray:
        return np.array([np.add.reduceat(self.samples(T, level) * self.weights, first) for T in transforms])

    def linearise(self, transforms: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        slopes = [self.jacobian(T, level) for T in transforms]
        return np.array([J @ self.weights for J in slopes]), np.array([J * self.weights @ J.T for J in slopes])

    def jacobian(self, T: np.ndarray, level: int) -> np.ndarray:
        own, pixels = self.maps.levels[level], self._pixels(T, level)
        inside = ((pixels >= 0) & (pixels <= [own.width - 1, own.height - 1])).all(axis=1)
        step = slope_step(own) * np.eye(2)
        slope = [(self._sampled(pixels + h, level) - self._sampled(pixels - h, level)) * inside / (2 * h.sum()) for h in step]
        by_twist = [(self._pixels(se3.exp(d) @ T, level) - self._pixels(se3.exp(-d) @ T, level)) / 2e-6 for d in 1e-6 * np.eye(6)]
        return np.array([np.nan_to_num(moved.T * slope).sum(axis=0) for moved in by_twist])

    def _pixels(self, T: np.ndarray, level: int) -> np.ndarray:
        """(n, 2), NaN for points too near or behind."""
        own, xyz = self.maps.levels[level], se3.transform(T, self.points)
        pixels, _ = Camera(own.K, own.width, own.height, self.maps.camera.model).project(xyz)
        distance = np.linalg.norm(xyz, axis=1)
        behind = xyz[:, 2] < -0.95 * distance if self.maps.camera.is_sphere else xyz[:, 2] < MIN_DEPTH
        pixels[behind | (distance < MIN_DEPTH)] = np.nan
        return pixels

    def _sampled(self, pixels: np.ndarray, level: int) -> np.ndarray:
        own = self.maps.levels[level]
        at = np.clip(np.nan_to_num(pixels, nan=-9), -1, [own.width, own.height]) + own.corner[self.tiles]
        return map_coordinates(own.image * float(UNIT), at[:, ::-1].T, order=1)


def samplers(camera: Camera, n: int = 1111) -> tuple[Sampler, Reference]:
    rng, maps = np.random.default_rng(2), atlas(camera)
    weights = rng.uniform(0.1, 1, n).astype(np.float32)
    tiles = rng.integers(0, 2 * FRAMES, n).astype(np.int32)
    given = (points_around(n), weights / weights.sum(), tiles, maps)
    return Sampler(*given), Reference(*given)


def transforms(n: int = 40) -> np.ndarray:
    xi = np.random.default_rng(3).uniform(-1, 1, (n, 6)) * [0.3, 0.3, 0.3, 1, 1, 1]
    xi[0], xi[1] = 0, [0, np.pi, 0, 0, 0, 0]
    return se3.exp_many(xi)


@pytest.mark.parametrize("camera", [PINHOLE, SPHERE], ids=["pinhole", "sphere"])
@pytest.mark.parametrize("n", [1, 8, 257, 1111])
def test_both_give_the_same(camera, n):
    compiled, reference = samplers(camera, n)
    T = transforms()
    for level in range(len(SCALES)):
        size = float(np.abs(atlas(camera).levels[level].image).max())
        for own in T[:8]:
            # The pixel of a point that is 30 m away is known to 1e-5 in float32.
            assert np.abs(compiled.samples(own, level) - reference.samples(own, level)).max() < 2e-3 * size
            J, expected = compiled.jacobian(own, level), reference.jacobian(own, level)
            assert np.abs(J - expected).max() <= 5e-3 * np.abs(expected).max()
        values = reference.values(T, level)
        assert compiled.values(T, level) == pytest.approx(values, abs=(1e-4 if n > 100 else 1e-3) * size)
        first = np.unique(np.array([0, n // 3, n // 2]))
        groups = compiled.group_values(T, level, first)
        assert groups == pytest.approx(reference.group_values(T, level, first), abs=(1e-4 if n > 100 else 1e-3) * size)
        assert groups.sum(axis=1) == pytest.approx(values, abs=(1e-4 if n > 100 else 1e-3) * size)
        for found, wanted in zip(compiled.linearise(T, level), reference.linearise(T, level), strict=True):
            assert np.abs(found - wanted).max() <= 2e-4 * np.abs(wanted).max() + 1e-9
        assert np.array_equal(compiled.gradients(T, level), compiled.linearise(T, level)[0])


@pytest.mark.parametrize("camera", [PINHOLE, SPHERE], ids=["pinhole", "sphere"])
def test_one_pose_alone_gives_the_same_bits_as_among_others(camera):
    compiled, _ = samplers(camera)
    T = transforms(9)
    values, (gradients, scales) = compiled.values(T, 2), compiled.linearise(T, 2)
    for k in range(len(T)):
        assert compiled.values(T[k : k + 1], 2)[0] == values[k]
        gradient, scale = compiled.linearise(T[k : k + 1], 2)
        assert np.array_equal(gradient[0], gradients[k])
        assert np.array_equal(scale[0], scales[k])
        assert np.array_equal(scale[0], scale[0].T)


@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e30])
@pytest.mark.parametrize("camera", [PINHOLE, SPHERE], ids=["pinhole", "sphere"])
def test_a_pose_that_is_no_pose_reads_nothing_outside_the_maps(camera, bad):
    compiled, _ = samplers(camera)
    T = np.eye(4)
    T[:3, 3] = bad
    assert np.isfinite(compiled.samples(T, 1)).all()
    T[:3, :3] = bad
    assert np.isfinite(compiled.samples(T, 1)).all()
    assert np.isfinite(compiled.values(T[None], 1)).all()


def test_without_a_kernel_of_these_sources_it_is_said_how_to_build_one(monkeypatch, tmp_path):
    monkeypatch.setattr(sampling, "__file__", str(tmp_path / "sampler.py"))
    with pytest.raises(MissingDependencyError, match=r"was not built: install gcc, then `pip install \.` or `colcon build`"):
        load_kernel()
    (tmp_path / "kernel.abi3.so").write_bytes(b"\x7fELF, but not for us")
    with pytest.raises(MissingDependencyError, match="was built from other sources or for another machine"):
        load_kernel()
