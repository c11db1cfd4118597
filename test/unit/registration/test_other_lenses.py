"""A calibration through lenses of models that OpenCV has no maps for."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calib_ros import Calibrator, se3
from calib_ros.config import Config, SemanticsConfig
from calib_ros.datasets.open import open_dataset
from calib_ros_synthetic.rigs import RIGS

MODELS = {"double_sphere": (-0.2, 0.6), "omnidir": (1.4, -0.05, 0.0, 1e-3, -1e-3)}


@pytest.mark.parametrize("model", MODELS)
def test_a_wide_lens_of_another_model_finds_the_extrinsic_as_an_equidistant_one_does(model, monkeypatch):
    rig = RIGS["os1_128_fisheye"]
    monkeypatch.setitem(RIGS, "os1_128_fisheye", replace(rig, lens=replace(rig.lens, model=model, D=MODELS[model])))
    frame = open_dataset("synthetic:rig=os1_128_fisheye,seed=5,frames=1,width=480")[0]
    assert frame.camera.model == model
    assert frame.camera.field_deg == pytest.approx(190, abs=2)
    config = Config(semantics=SemanticsConfig(image_classes="", cloud_classes=""))
    start = se3.exp([0.015, -0.02, 0.01, 0.06, -0.05, 0.08]) @ frame.reference
    result = Calibrator(frame.camera, config).calibrate([frame], initial=start)
    assert result.converged
    assert se3.rotation_error_deg(frame.reference[:3, :3], result.T_camera_lidar[:3, :3]) < 0.2
    assert se3.translation_error_m(frame.reference, result.T_camera_lidar) < 0.04
