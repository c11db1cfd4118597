"""Lenses that no pinhole can show: their images are unrolled onto a sphere, and scored there."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib_ros import Calibrator, se3
from calib_ros.camera import SPHERE, Camera
from calib_ros.config import Config, ImageConfig, RefineConfig, ScoreConfig, SemanticsConfig
from calib_ros.datasets.open import open_dataset
from calib_ros.errors import ConfigError
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.edges import EdgeLevel, edge_levels, oriented_edges
from calib_ros.lidar.edges import UPWARD, EdgePoints
from calib_ros.registration.features import FeatureExtractor, FrameFeatures, rectified_camera
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.score.fast_score import FastScore
from calib_ros_synthetic.rigs import RIGS

WIDTH, HEIGHT = 340, 160
CAMERA = Camera(np.array([[100.0, 0, 168.2], [0, 105, 81.3], [0, 0, 1]]), WIDTH, HEIGHT, SPHERE)  # 194 deg wide
T = se3.exp([0.02, 0.1, -0.05, 0.1, 0.2, -0.1]) @ nominal()


def all_around(n: int = 800) -> EdgePoints:
    rng = np.random.default_rng(3)
    azimuth, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(2, 30, n)
    distance[: n // 20] *= 0.05
    xyz = np.c_[distance * np.cos(azimuth), distance * np.sin(azimuth), distance * rng.uniform(-0.7, 0.7, n)]
    return EdgePoints(xyz.astype(np.float32), np.ones(n, np.float32), rng.integers(0, 5, n).astype(np.uint8))


def all_around_cloud() -> PointCloud:
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 360, endpoint=False), np.linspace(-0.3, 0.3, 16))
    xyz = 10 * np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return PointCloud(xyz.reshape(-1, 3).astype(np.float32))


def features() -> FrameFeatures:
    rng = np.random.default_rng(9)
    levels = []
    for scale, sigma in ((2, 4.0), (1, 2.0)):
        maps = [cv2.GaussianBlur(rng.standard_normal((HEIGHT // scale, WIDTH // scale)), (0, 0), 12 / scale) for _ in range(2)]
        levels.append(EdgeLevel.of(np.stack([m / m.std() for m in maps]).astype(np.float32), scale, sigma))
    return FrameFeatures(all_around(), levels, CAMERA, 0, "", True)


def seen(border: float, nearest: float) -> tuple[FrameFeatures, FastScore, np.ndarray, np.ndarray, np.ndarray]:
    """Features, their score, its points in the camera's frame and on the picture, and which are in it, so far from its border."""
    f = features()
    score = FastScore([f], T, ScoreConfig(), 0.2)
    P = se3.transform(T, score.points.T.astype(float))
    uv, inside = CAMERA.project(P)
    within = (np.abs(uv - [WIDTH / 2, HEIGHT / 2]) < [WIDTH / 2 - border, HEIGHT / 2 - border]).all(axis=1)
    return f, score, P, uv, inside & within & (np.linalg.norm(P, axis=1) > nearest)


def test_points_are_sampled_where_the_sphere_projects_them():
    f, score, P, uv, inside = seen(4, 0.5)
    assert (inside & (P[:, 2] < 0)).sum() > 10  # some are behind the image plane
    kept = f.points.xyz[:, None] == score.points.T[None]
    upward = np.isin(f.points.kind, UPWARD)[kept.all(axis=2).argmax(axis=0)]
    for level, own in enumerate(f.levels):
        u, v = ((uv + 0.5) / own.scale - 0.5).astype(np.float32).T
        expected = np.where(upward, *(cv2.remap(own.maps[k], u, v, cv2.INTER_LINEAR).ravel() for k in (1, 0)))
        sampled = score.sample(T, level)
        assert np.abs(sampled - expected)[inside].max() < 0.05
        assert not sampled[np.nan_to_num(uv[:, 0], nan=-9) < -own.scale].any()
        other = se3.exp([0, 0.1, 0, 0.2, 0, 0]) @ T
        assert score.values(np.stack([T, other]), level) == pytest.approx(
            [score.at(level).value(T), score.at(level).value(other)], abs=1e-4
        )


def test_the_slope_on_a_sphere_is_the_difference():
    _, score, _, _, inside = seen(12, 1.0)
    assert inside.sum() > 200
    J = score.jacobian(T, 1)
    for k in range(6):
        d = np.zeros(6)
        d[k] = 2e-3 if k < 3 else 1e-2
        numeric = (score.sample(se3.exp(d) @ T, 1) - score.sample(se3.exp(-d) @ T, 1)) / (2 * d[k])
        size = np.sqrt(np.mean(numeric[inside] ** 2))
        assert np.sqrt(np.mean((J[k] - numeric)[inside] ** 2)) < 0.12 * size, k


def test_only_the_widest_lenses_are_unrolled():
    K = np.array([[250.0, 0, 400], [0, 250, 300], [0, 0, 1]])
    fisheye = Camera(K, 800, 600, "equidistant", np.array([0.01, 0, 0, 0]))
    narrow = Camera(2 * K * [[1, 1, 0.5], [1, 1, 0.5], [1, 1, 0.5]], 800, 600, "equidistant", np.array([0.01, 0, 0, 0]))
    thesis = Config(refine=RefineConfig(objective="thesis"))
    pinhole, sphere = (Config(image=ImageConfig(projection=name)) for name in ("pinhole", "sphere"))
    unrolled = [(fisheye, Config()), (narrow, sphere)]
    flat = [(narrow, Config()), (fisheye, pinhole), (fisheye, thesis)]
    assert all(rectified_camera(*given).is_sphere for given in unrolled)
    assert all(rectified_camera(*given).is_pinhole for given in flat)
    with pytest.raises(ConfigError, match="sphere does not go with"):
        replace(thesis, image=ImageConfig(projection="sphere"))


def test_lines_parallel_to_the_cameras_y_axis_are_edges_of_one_kind_everywhere(monkeypatch):
    """Stripes of azimuth on the sphere: the first map has them all, where along the rows alone it would not."""
    lens = Camera(np.array([[100.0, 0, 200], [0, 100, 150], [0, 0, 1]]), 400, 300, "equidistant", np.array([0.02, 0, 0, 0]))
    monkeypatch.setattr("calib_ros.image.edges.prepare", lambda image: image)
    extract = FeatureExtractor(lens, Config())
    rays = lens.unproject(np.stack(np.meshgrid(np.arange(400), np.arange(300)), axis=-1)).reshape(300, 400, 3)
    stripes = np.where(np.floor(np.arctan2(rays[..., 0], rays[..., 2]) / 0.2) % 2, 190, 60).astype(np.uint8)
    stripes[~(np.abs(rays[..., 1]) < 0.85)] = 125  # near the poles stripes are narrower than a pixel
    across = extract.across
    gray = extract.working_image(stripes)
    shares = [first.sum() / (first + second).sum() for first, second in (oriented_edges(gray, None, a) for a in (across, None))]
    assert shares[0] > shares[1] + 0.1
    assert shares[0] > 0.85
    frame = Frame(stripes, all_around_cloud(), lens, 0)
    expected = edge_levels(gray, float(extract.camera.K[0, 0]), used=extract.used, across=across)
    assert all(np.array_equal(a.packed, b.packed) for a, b in zip(extract(frame).levels, expected, strict=True))
    assert FeatureExtractor(Camera(np.diag([300.0, 300, 1]), 400, 300)).across is None


MODELS = {"equidistant": None, "double_sphere": (-0.2, 0.6), "omnidir": (1.4, -0.05, 0.0, 1e-3, -1e-3)}


@pytest.mark.parametrize("model", MODELS)
def test_a_fisheye_of_any_model_is_used_beyond_its_image_plane_and_finds_the_extrinsic(model, monkeypatch):
    """OpenCV has maps for none but the first."""
    rig = RIGS["os1_128_fisheye"]
    if model != "equidistant":
        rig = replace(rig, lens=replace(rig.lens, model=model, D=MODELS[model]))
    monkeypatch.setitem(RIGS, "os1_128_fisheye", rig)
    frame = open_dataset("synthetic:rig=os1_128_fisheye,seed=5,frames=1,width=480")[0]
    assert frame.camera.model == model
    assert frame.camera.field_deg == pytest.approx(190, abs=2)
    config = Config(semantics=SemanticsConfig(image_classes="", cloud_classes=""))
    extract = FeatureExtractor(frame.camera, config)
    assert extract.camera.is_sphere
    assert extract.camera.width / extract.camera.K[0, 0] > np.deg2rad(185)
    assert 0.8 < extract.used.mean() < 1
    start = se3.exp([0.015, -0.02, 0.01, 0.06, -0.05, 0.08]) @ frame.reference
    result = Calibrator(frame.camera, config).calibrate([frame], initial=start)
    assert result.converged
    assert se3.rotation_error_deg(frame.reference[:3, :3], result.T_camera_lidar[:3, :3]) < 0.2
    assert se3.translation_error_m(frame.reference, result.T_camera_lidar) < 0.04
