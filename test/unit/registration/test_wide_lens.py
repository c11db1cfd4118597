"""Lenses that no pinhole can show: their images are unrolled onto a sphere, and scored there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib_ros import Calibrator, se3
from calib_ros.camera import Camera
from calib_ros.config import Config, ImageConfig, RefineConfig, SemanticsConfig
from calib_ros.datasets.open import open_dataset
from calib_ros.errors import ConfigError
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.edges import edge_levels, oriented_edges
from calib_ros.registration.features import FeatureExtractor, rectified_camera
from calib_ros_synthetic.rigs import RIGS


def all_around_cloud() -> PointCloud:
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 360, endpoint=False), np.linspace(-0.3, 0.3, 16))
    xyz = 10 * np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return PointCloud(xyz.reshape(-1, 3).astype(np.float32))


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
        camera = rig.sensors["camera"]
        lens = replace(camera.kind, model=model, D=MODELS[model])
        rig = replace(rig, sensors=rig.sensors | {"camera": replace(camera, kind=lens)})
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
