"""Networks say which weights they run with."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from pathlib import Path

import pytest
from onnx_graphs import segmentation

from calib_ros.config import SemanticsConfig
from calib_ros_semantics.models.segmentation import SegmentationModels
from calib_ros_semantics.models.weight_sets import of_package, weights_of


def test_name_licence_and_fingerprint_are_read_from_the_file(tmp_path: Path) -> None:
    own = {"name": "roads é", "license": "Apache-2.0", "other": ""}
    path = segmentation(tmp_path / "n.onnx", metadata=own)
    found = weights_of(path)
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert found.text == f"roads é (Apache-2.0; SHA-256 {found.sha256[:12]})"
    before = path.stat().st_mtime_ns
    segmentation(path)  # says nothing
    os.utime(path, ns=(before + 10**9, before + 10**9))
    assert weights_of(path).text.startswith("n (licence not stated; SHA-256 ")
    assert weights_of(path).sha256 != found.sha256


def test_what_is_no_network_has_no_metadata(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = segmentation(tmp_path / "n.onnx", metadata={"a": "b"}).read_bytes()
    path = tmp_path / "other.onnx"
    for data in (b"", b"\x89PNG\r\n\x1a\n and what follows", whole[: len(whole) // 2], bytes(100), b"\xff" * 50):
        path.write_bytes(data)
        assert weights_of(path) is None or weights_of(path).text.startswith("other (licence not known; SHA-256 ")
    assert weights_of(tmp_path / "none.onnx") is weights_of(tmp_path) is None
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path.write_bytes(whole)
    assert weights_of(path).licence is None


def test_everyone_may_use_the_weights_of_the_package() -> None:
    files, licence = sorted(of_package().parent.glob("*.onnx")), (of_package().parent / "LICENSE").read_text()
    assert [path.name for path in files] == ["streets.onnx"], "no others are installed"
    for path in files:
        assert weights_of(path).licence.startswith("Apache-2.0")
        assert path.name in licence
        assert path.stat().st_size < 2e6
    assert "Apache-2.0" in licence


def test_a_model_runs_with_what_its_file_held_when_it_was_loaded(tmp_path: Path) -> None:
    path = tmp_path / "mine.onnx"
    shutil.copy(of_package(), path)
    models = SegmentationModels(SemanticsConfig(image_classes=str(path), cloud_classes="geometric"))
    before = models.in_use()
    assert before == [f"image_classes {weights_of(path).text}", "cloud_classes geometric"]
    assert models.load() == []
    segmentation(path, metadata={"name": "another"})
    assert models.in_use() == before
    path.unlink()
    assert models.in_use() == before
    builtin = SegmentationModels(SemanticsConfig(cloud_classes="source")).in_use()
    assert builtin == [f"image_classes {weights_of(of_package()).text}", "cloud_classes source"]
