"""ONNX models: loading, defects, time limits, execution providers, the YAML beside them, and which weights they run with."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx_graphs import save as save_graph
from onnx_graphs import segmentation, value

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros_semantics.models.onnx_model import Deadline, OnnxModel
from calib_ros_semantics.models.segmentation import SegmentationModels
from calib_ros_semantics.models.sidecar import Sidecar
from calib_ros_semantics.models.weight_sets import of_package, weights_of

CONFIG = SemanticsConfig()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    return segmentation(tmp_path / "good.onnx", metadata={"author": "nobody", "names": "[]"})


def message(path: Path, config: SemanticsConfig = CONFIG) -> str:
    """What the error says, in one line, with the file."""
    with pytest.raises(ModelError) as caught:
        OnnxModel(path, config)
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_model_reports_its_inputs_and_outputs(good: Path) -> None:
    model = OnnxModel(good, CONFIG)
    assert model.tensors == "inputs: input float32 1x3x256x512; outputs: scores float32 1x19x256x512"
    assert (model.provider, model.fallback) == ("cpu", "")
    assert OnnxModel(good, SemanticsConfig(provider="auto")).fallback == ""
    assert model.metadata["author"] == "nobody"
    zeros = model.run({"input": np.zeros((1, 3, 256, 512))}, Deadline(60))  # float64 is converted
    assert zeros[0].shape == (1, 19, 256, 512)
    assert zeros[0].argmax(axis=1).max() == 9  # 0.485 lies in the tenth band
    assert model.run({"input": np.zeros((1, 3, 256, 512))}, Deadline(60), ["scores"])[0].tobytes() == zeros[0].tobytes()


def test_files_without_a_model_are_refused(tmp_path: Path, good: Path) -> None:
    assert "no such file" in message(tmp_path / "missing.onnx")
    assert "a folder" in message(tmp_path)
    data, path = good.read_bytes(), tmp_path / "my-opset.onnx"  # the word in the path tells nothing
    parts = [data[: int(share * len(data))] for share in (0.01, 0.5, 0.999)]
    for wrong in (b"", b"nothing", *parts, cv2.imencode(".png", np.zeros((40, 60, 3), np.uint8))[1].tobytes()):
        path.write_bytes(wrong)
        assert "cannot be loaded" in message(path)
        assert message(path).endswith("; download or export it again")


def test_advice_depends_on_what_is_wrong_with_the_file(tmp_path: Path, good: Path) -> None:
    model = onnx.load(str(good))
    apart = tmp_path / "apart.onnx"
    onnx.save_model(onnx.load(str(good)), str(apart), save_as_external_data=True, location="apart.weights", size_threshold=0)
    (tmp_path / "apart.weights").unlink()
    missing = f"its weights are in {tmp_path / 'apart.weights'}, which is missing; put that file beside it"
    assert missing in message(apart)
    for opset, version in ((99, model.ir_version), (17, 60)):
        model.opset_import[0].version, model.ir_version = opset, version
        (tmp_path / "new.onnx").write_bytes(model.SerializeToString())
        advice = f"; export it again, with an opset that onnxruntime {onnxruntime.__version__} knows"
        assert advice in message(tmp_path / "new.onnx")


def test_a_tensor_type_that_no_network_has(tmp_path: Path) -> None:
    text, same = (value(name, [1], onnx.TensorProto.STRING) for name in ("text", "same"))
    path = save_graph(tmp_path / "text.onnx", [onnx.helper.make_node("Identity", ["text"], ["same"])], [text], [same])
    assert "tensor text is of type tensor(string)" in message(path)


EVERY_ENTRY = """{family: cenet, mean: [1, 2.5, -3], std: [0.5, 1, 2], scale: 0.00392, channels: [range, x, y], size: [64, 2048],
labels: {0: void, 9: road}, fov_deg: [15, -15.5], azimuth_deg: 90, output: logits}"""


def test_the_yaml_beside_a_model(tmp_path: Path) -> None:
    assert Sidecar.beside(tmp_path / "model.onnx") == Sidecar()
    (tmp_path / "model.yaml").write_text("")
    assert Sidecar.beside(tmp_path / "model.onnx") == Sidecar()
    (tmp_path / "other.yml").write_text("channels: bgr\nlabels: cityscapes\nmean:\n")
    assert Sidecar.beside(tmp_path / "other.onnx") == Sidecar(channels="bgr", labels="cityscapes")
    (tmp_path / "model.yaml").write_text(EVERY_ENTRY)
    expected = Sidecar("cenet", (1, 2.5, -3), (0.5, 1, 2), 0.00392, ("range", "x", "y"), (64, 2048), {0: "void", 9: "road"})
    expected = dataclasses.replace(expected, fov_deg=(15, -15.5), azimuth_deg=90, output="logits")
    assert Sidecar.beside(tmp_path / "model.onnx") == expected


WRONG = {
    "a name": ("family: 3", "output: [a]"),
    "a list of numbers": ("mean: 0.5", "mean: [a]", "mean: [.nan, 0, 0]", "mean: []"),
    "above 0": ("std: [1, 0, 1]", "std: [1, -1, 1]", "scale: 0", "scale: true", "scale: big"),
    "rgb, bgr or a list of names": ("channels: rbg", "channels: [1, 2]"),
    "[height, width]": ("size: 512", "size: [512]", "size: [512.5, 1024]", "size: [0, 1024]", "size: [512, 100000]"),
    "class names": ("labels: 19", "labels: [road, 3]", "labels: {road: 1}", "labels: {-1: road}", "labels: {true: road}"),
    "[highest, lowest]": ("fov_deg: 28", "fov_deg: [-25, 3]", "fov_deg: [3, -95]"),
    "up to 360": ("azimuth_deg: 0", "azimuth_deg: 720"),
    "unknown entry 'colours'; known are family": ("colours: rgb",),
    "must hold names and values": ("- a",),
    "not valid YAML": ("mean: [",),
    "UTF-8": ("\udcff\udcfe\0",),
}


@pytest.mark.parametrize(("entry", "says"), [(entry, says) for says, entries in WRONG.items() for entry in entries])
def test_a_wrong_entry_is_named(tmp_path: Path, entry: str, says: str) -> None:
    (tmp_path / "model.yaml").write_bytes(entry.encode(errors="surrogateescape"))
    with pytest.raises(ModelError) as caught:
        Sidecar.beside(tmp_path / "model.onnx")
    assert says in str(caught.value)
    assert str(tmp_path / "model.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


# --- weights --------------------------------------------------------------------------------------------------------------


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
