"""ONNX models: loading, defects, time limits, execution providers, and the YAML beside them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from onnx_graphs import endless, failing, segmentation, value
from onnx_graphs import save as save_graph

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros_semantics.models.onnx_model import Deadline, OnnxModel, Sidecar

CONFIG = SemanticsConfig()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    return segmentation(
        tmp_path / "good.onnx", 19, outputs=[("scores", [1, 19, 256, 512])], metadata={"author": "nobody", "names": "[]"}
    )


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
    assert model.metadata["author"] == "nobody"
    zeros = model.run({"input": np.zeros((1, 3, 256, 512))})  # float64 is converted
    assert zeros[0].shape == (1, 19, 256, 512)
    assert zeros[0].argmax(axis=1).max() == 9  # 0.485 lies in the tenth band
    assert model.run({"input": np.zeros((1, 3, 256, 512))}, Deadline(60), ["scores"])[0].tobytes() == zeros[0].tobytes()


def test_files_without_a_model_are_refused(tmp_path: Path, good: Path) -> None:
    assert "no such file" in message(tmp_path / "missing.onnx")
    assert "a folder" in message(tmp_path)
    (tmp_path / "empty.onnx").write_bytes(b"")
    assert "cannot be loaded" in message(tmp_path / "empty.onnx")
    data = good.read_bytes()
    for share in (0.01, 0.2, 0.5, 0.9, 0.999):
        cut = tmp_path / f"cut_{share}.onnx"
        cut.write_bytes(data[: int(share * len(data))])
        assert "download or export it again" in message(cut)
    picture = tmp_path / "picture.onnx"
    picture.write_bytes(cv2.imencode(".png", np.zeros((40, 60, 3), np.uint8))[1].tobytes())
    assert "cannot be loaded" in message(picture)


def test_advice_depends_on_what_is_wrong_with_the_file(tmp_path: Path, good: Path) -> None:
    import onnx

    model = onnx.load(str(good))
    apart = tmp_path / "apart.onnx"
    onnx.save_model(model, str(apart), save_as_external_data=True, location="apart.weights", size_threshold=0)
    (tmp_path / "apart.weights").unlink()
    missing = f"its weights are in {tmp_path / 'apart.weights'}, which is missing; put that file beside it"
    assert missing in message(apart)
    model = onnx.load(str(good))
    model.opset_import[0].version = 99
    (tmp_path / "new.onnx").write_bytes(model.SerializeToString())
    assert f"with an opset that onnxruntime {onnxruntime.__version__} knows" in message(tmp_path / "new.onnx")
    model.opset_import[0].version, model.ir_version = 17, 60
    (tmp_path / "newer.onnx").write_bytes(model.SerializeToString())
    assert "export it again, with an opset" in message(tmp_path / "newer.onnx")
    (tmp_path / "my-opset.onnx").write_bytes(b"nothing")  # the word in the path tells nothing
    text = message(tmp_path / "my-opset.onnx")
    assert text.endswith("; download or export it again")


def test_a_tensor_type_that_no_network_has(tmp_path: Path) -> None:
    from onnx import TensorProto, helper

    text = value("text", [1], TensorProto.STRING)
    nodes = [helper.make_node("Identity", ["text"], ["same"])]
    path = save_graph(tmp_path / "text.onnx", nodes, [text], [value("same", [1], TensorProto.STRING)])
    assert "tensor text is of type tensor(string)" in message(path)


def test_a_network_that_fails_while_it_runs(tmp_path: Path) -> None:
    model = OnnxModel(failing(tmp_path / "fails.onnx"), CONFIG)
    with pytest.raises(ModelError, match=r"fails\.onnx failed: .*Reshape.*it has inputs: input float32 1x3x64x64") as caught:
        model.run({"input": np.full((1, 3, 64, 64), 7.0)}, Deadline(60))
    assert "\n" not in str(caught.value)


def test_arrays_that_do_not_fit(good: Path) -> None:
    model = OnnxModel(good, CONFIG)
    with pytest.raises(ModelError, match=r"good\.onnx failed: .*it has inputs: input float32 1x3x256x512"):
        model.run({"input": np.zeros((1, 3, 10, 10))})


def test_a_run_is_broken_off_and_the_next_one_works(tmp_path: Path) -> None:
    model = OnnxModel(endless(tmp_path / "endless.onnx"), CONFIG)
    slow, quick = np.full((1, 3, 64, 64), 0.5), np.full((1, 3, 64, 64), -0.5)
    with pytest.raises(BudgetError, match=r"budget of 0\.2 s \(semantics\.budget_s\)"):
        model.run({"input": slow}, Deadline(0.2))
    level = 0.485 - 0.5 * 0.229
    assert (model.run({"input": quick}, Deadline(60))[0].argmax(axis=1) == int(level * 19)).all()


def test_a_run_ends_when_it_is_cancelled(tmp_path: Path) -> None:
    model = OnnxModel(endless(tmp_path / "endless.onnx"), CONFIG)
    asked: list[int] = []

    def cancelled() -> bool:
        asked.append(1)
        return len(asked) > 4  # while it runs: before it, the deadline is asked twice

    with pytest.raises(BudgetError, match="no longer wanted"):
        model.run({"input": np.full((1, 3, 64, 64), 0.5)}, Deadline(600, cancelled))
    assert len(asked) > 4


def test_no_run_starts_after_the_deadline(good: Path) -> None:
    model = OnnxModel(good, CONFIG)
    with pytest.raises(BudgetError):
        model.run({"input": np.zeros((1, 3, 256, 512))}, Deadline(0.0))
    with pytest.raises(BudgetError):
        Deadline(60, lambda: True).check()
    Deadline(60).check()


@pytest.mark.parametrize("provider", ["cuda", "tensorrt"])
def test_without_an_accelerator_it_runs_on_the_cpu_and_says_so(good: Path, provider: str) -> None:
    if any(p.startswith(("CUDA", "Tensorrt")) for p in onnxruntime.get_available_providers()):
        pytest.skip("onnxruntime has an accelerator here")
    model = OnnxModel(good, SemanticsConfig(provider=provider))
    assert model.provider == "cpu"
    assert model.fallback == f"onnxruntime has no {provider} here: good.onnx runs on cpu"
    assert model.run({"input": np.zeros((1, 3, 256, 512))})[0].shape == (1, 19, 256, 512)


def test_the_fastest_provider_there_is(good: Path) -> None:
    assert OnnxModel(good, SemanticsConfig(provider="auto")).fallback == ""


SIDECAR = """
family: cenet
mean: [1, 2.5, -3]
std: [0.5, 1, 2]
scale: 0.00392
channels: [range, x, y]
size: [64, 2048]
labels: {0: void, 9: road}
fov_deg: [15, -15.5]
azimuth_deg: 90
output: logits
"""


def test_every_entry_of_the_yaml_beside_a_model(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text(SIDECAR)
    assert Sidecar.beside(tmp_path / "model.onnx") == Sidecar(
        family="cenet",
        mean=(1.0, 2.5, -3.0),
        std=(0.5, 1.0, 2.0),
        scale=0.00392,
        channels=("range", "x", "y"),
        size=(64, 2048),
        labels={0: "void", 9: "road"},
        fov_deg=(15.0, -15.5),
        azimuth_deg=90,
        output="logits",
    )


def test_a_yaml_may_be_absent_empty_or_called_yml(tmp_path: Path) -> None:
    assert Sidecar.beside(tmp_path / "model.onnx") == Sidecar()
    (tmp_path / "model.yaml").write_text("")
    assert Sidecar.beside(tmp_path / "model.onnx") == Sidecar()
    (tmp_path / "other.yml").write_text("channels: bgr\nlabels: cityscapes\nmean:\n")
    assert Sidecar.beside(tmp_path / "other.onnx") == Sidecar(channels="bgr", labels="cityscapes")


def test_a_wrong_entry_is_named(tmp_path: Path) -> None:
    for entry, says in (
        ("family: 3", "a name"),
        ("mean: 0.5", "a list of numbers"),
        ("mean: [a]", "a list of numbers"),
        ("mean: [.nan, 0, 0]", "a list of numbers"),
        ("mean: []", "a list of numbers"),
        ("std: [1, 0, 1]", "above 0"),
        ("std: [1, -1, 1]", "above 0"),
        ("scale: 0", "above 0"),
        ("scale: true", "above 0"),
        ("scale: big", "above 0"),
        ("channels: rbg", "rgb, bgr or a list of names"),
        ("channels: [1, 2]", "rgb, bgr or a list of names"),
        ("size: 512", "[height, width]"),
        ("size: [512]", "[height, width]"),
        ("size: [512.5, 1024]", "[height, width]"),
        ("size: [0, 1024]", "[height, width]"),
        ("size: [512, 100000]", "[height, width]"),
        ("labels: 19", "class names"),
        ("labels: [road, 3]", "class names"),
        ("labels: {road: 1}", "class names"),
        ("labels: {-1: road}", "class names"),
        ("labels: {true: road}", "class names"),
        ("fov_deg: 28", "[highest, lowest]"),
        ("fov_deg: [-25, 3]", "[highest, lowest]"),
        ("fov_deg: [3, -95]", "[highest, lowest]"),
        ("azimuth_deg: 0", "up to 360"),
        ("azimuth_deg: 720", "up to 360"),
        ("output: [a]", "a name"),
        ("colours: rgb", "unknown entry 'colours'; known are family"),
        ("- a", "must hold names and values"),
        ("mean: [", "not valid YAML"),
    ):
        (tmp_path / "model.yaml").write_text(entry)
        with pytest.raises(ModelError) as caught:
            Sidecar.beside(tmp_path / "model.onnx")
        text = str(caught.value)
        assert says in text
        assert str(tmp_path / "model.yaml") in text
        assert "\n" not in text


def test_a_wrong_yaml_stops_its_model(good: Path) -> None:
    good.with_suffix(".yaml").write_text("size: 5")
    with pytest.raises(ModelError, match="size = 5 must be"):
        OnnxModel(good, CONFIG)
    good.with_suffix(".yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelError, match="UTF-8"):
        OnnxModel(good, CONFIG)
