"""Dense depth by a network in place of eq. 3.11: in the maps, in the score, and when it cannot be used."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from onnx_graphs import completion

from calib_ros import se3
from calib_ros.cli import main
from calib_ros.config import Config, update
from calib_ros.errors import ConfigError
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.score.point_score import nearest_per_pixel, project
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.cloud import depth as depth_of
from calib_ros_thesis.completion import FrameCompletion
from calib_ros_thesis.config import ThesisConfig, thesis_of
from calib_ros_thesis.maps import EMPTY, PointLevels, complete_depth, edge_maps
from calib_ros_thesis.score import ThesisScore, registration_maps

SMALL = "synthetic:seed=31,frames=2,rings=32,width=640,height=240"
SHAPE = (60, 80)


def config_with(choice: str) -> Config:
    return Config.from_dict({"refine": {"objective": "thesis"}, "thesis": {"completion": choice}})


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive.from_text(SMALL)


def levels_of(depth: np.ndarray) -> PointLevels:
    n = len(depth)
    return PointLevels(np.rint(100 * depth).astype(np.int16), np.full(n, 301, np.int16), np.ones(n, np.uint8))


def test_depths_of_a_network_fill_what_morphology_would_fill():
    """A wall at 20 m with points in every fourth row; the network sees a box at 8 m between them, and a sky at 55 m."""
    v, u = (a.ravel() for a in np.mgrid[24:60:4, :80])
    learned = np.full(SHAPE, 20.0, np.float32)
    learned[:20], learned[30:50, 30:60] = 55.0, 8.0
    thesis = ThesisConfig(operator="sobel")
    levels, pixels = levels_of(np.full(len(u), 20.0)), v * SHAPE[1] + u
    plain, own = (edge_maps(pixels, levels, SHAPE, thesis, *given) for given in ((), (learned,)))
    assert np.array_equal(own.dense_depth != EMPTY, plain.dense_depth != EMPTY)
    filled = own.dense_depth != EMPTY
    np.testing.assert_array_equal(own.dense_depth[filled], np.rint(100 * learned[filled]))
    assert not plain.depth_edges[25:58, 5:75].any()
    columns = np.flatnonzero(own.depth_edges[40])
    assert set(columns) == {29, 30, 59, 60}  # the box's sides
    assert own.depth_edges[40, 30] == pytest.approx(1.0)
    for name in ("reflectivity_edges", "object_edges", "sparse_depth"):
        np.testing.assert_array_equal(getattr(own, name), getattr(plain, name))


def test_depths_out_of_reach_are_cut_and_unknown_ones_are_those_of_morphology():
    v, u = (a.ravel() for a in np.mgrid[20:60:2, :80])
    learned = np.full(SHAPE, 500.0, np.float32)
    learned[:, :40] = 0.0
    maps = edge_maps(v * SHAPE[1] + u, levels_of(np.full(len(u), 20.0)), SHAPE, ThesisConfig(), learned)
    assert (maps.dense_depth[:, :40] == 2000).all()
    assert (maps.dense_depth[:, 40:] == 6000).all()


def test_the_network_gets_the_points_of_the_ground_too(tmp_path: Path):
    image = np.zeros((*SHAPE, 3), np.uint8)
    dense = FrameCompletion(str(completion(tmp_path / "own.onnx")), Config().semantics, image)(
        np.array([0, 82, 200]), np.array([3.0, 5, 9])
    )
    assert dense.shape == SHAPE
    assert [dense[0, 0], dense[1, 2], dense[2, 40]] == [5.0, 5.0, 9.0]  # the largest within 2 px


def test_the_score_is_that_of_the_maps(drive, tmp_path: Path):
    """Fast and written out, for a network whose depths differ from those of morphology."""
    config = config_with(str(completion(tmp_path / "own.onnx", channels=(0.05,))))
    T = se3.perturb(drive.reference, [0.3, -0.2, 0.1], [0.02, 0, 0.01])
    J = {}
    for name, used in (("network", config), ("morphology", update(config, {"thesis": {"completion": "morphological"}}))):
        features = FeatureExtractor(drive.camera, used)(drive[0]).own
        thesis = thesis_of(used)
        maps = registration_maps(features, T, thesis)
        written_out = maps.edge_registration_score() / maps.lidar_mass()
        assert ThesisScore([features], T, used).frame_scores(T) == pytest.approx([written_out], rel=1e-5)
        J[name] = written_out
        assert (features.completion is None) == (name == "morphology")
    assert abs(J["network"] / J["morphology"] - 1) > 0.001


def test_the_package_s_network_knows_held_out_depths(drive):
    """A tenth of the points left out: at theirs it is right to a few per cent, and better than morphology far from points."""
    frame, rng = drive[0], np.random.default_rng(0)
    xyz = frame.cloud.xyz[np.argsort(-depth_of(frame.cloud.xyz), kind="stable")]
    camera = drive.camera
    u, v, inside = project(xyz, drive.reference, camera)
    pixels, kept = nearest_per_pixel(v * camera.width + u, inside, camera.height * camera.width)
    depth, keep = depth_of(xyz)[kept], rng.random(len(kept)) > 0.1
    dense = FrameCompletion("network", Config().semantics, frame.image)(pixels[keep], depth[keep])
    error = np.abs(dense.ravel()[pixels[~keep]] / depth[~keep] - 1)
    assert np.median(error) < 0.02
    assert np.mean(error > 0.2) < 0.1
    sparse = np.zeros(camera.width * camera.height, np.int16)
    sparse[pixels] = np.minimum(np.rint(100 * depth), 6000)
    assert dense[complete_depth(sparse.reshape(dense.shape), 6000) != EMPTY].min() > 1.0


def test_a_network_that_cannot_be_used_is_refused_with_the_configuration(tmp_path: Path, capsys):
    no_yaml = completion(tmp_path / "no_yaml.onnx", None)
    (tmp_path / "cut.onnx").write_bytes(no_yaml.read_bytes()[:100])
    two = completion(tmp_path / "two.onnx", inputs="depth 1 1 h w; image 1 1 h w", outputs="dense 1 1 h w; other 1 1 h w")
    cases = {
        str(no_yaml): "must say 'depth_scale:'",
        str(tmp_path / "cut.onnx"): "cannot be loaded",
        str(two): "which output is the dense depth",
        "netwrok": r"thesis.completion \(morphological, network, or an ONNX file\): model netwrok: there is no such file",
    }
    for choice, says in cases.items():
        with pytest.raises(ConfigError, match=says):
            config_with(choice)
        Config.from_dict({"thesis": {"completion": choice}})  # nobody uses it
        file = tmp_path / "config.yaml"
        file.write_text(f"{{refine: {{objective: thesis}}, thesis: {{completion: '{choice}'}}}}")
        assert main.main(["calibrate", SMALL, "--config", str(file)]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "thesis.completion" in err


def test_a_file_that_changes_is_loaded_again(tmp_path: Path):
    path, image = tmp_path / "own.onnx", np.full(SHAPE, 100, np.uint8)
    run = FrameCompletion(str(completion(path)), Config().semantics, image)
    assert run(np.array([5]), np.array([2.0]))[50, 50] == pytest.approx(1.0)
    completion(path, channels=(0.0321,))
    assert run(np.array([5]), np.array([2.0]))[50, 50] == pytest.approx(3.21)


def test_features_keep_the_image_for_a_network_only(drive, tmp_path: Path):
    own = FeatureExtractor(drive.camera, config_with(str(completion(tmp_path / "own.onnx"))))(drive[0]).own
    assert own.completion.image.shape[:2] == (drive.camera.height, drive.camera.width)
    assert dataclasses.replace(own, completion=None).completion is None
