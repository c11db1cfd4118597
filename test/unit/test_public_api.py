"""What `import calib_ros` gives: the names of the README, lazily, documented, one version everywhere; and extensions."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from paths import ROOT

import calib_ros
from calib_ros import extensions
from calib_ros.config import Config
from calib_ros.registration.search.constraints import NOMINAL_BOX, SEMANTIC_BOX

CLASSES = ("Calibrator", "Camera", "Config", "Frame", "PointCloud", "Recalibrator", "Result", "SearchBox")


def test_every_public_name_is_importable() -> None:
    assert {"CalibrationError", "open_dataset", "se3", *CLASSES} <= set(calib_ros.__all__) <= set(dir(calib_ros))
    for name in calib_ros.__all__:
        assert getattr(calib_ros, name) is not None, name
    assert calib_ros.open_source is calib_ros.open_dataset
    with pytest.raises(AttributeError, match="has no attribute 'calibrator'"):
        _ = calib_ros.calibrator


def test_importing_the_package_loads_no_library() -> None:
    code = "import calib_ros, sys; print(sorted({'numpy', 'scipy', 'cv2', 'yaml'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("name", [*CLASSES, "open_dataset"])
def test_public_classes_and_functions_have_numpy_docstrings(name: str) -> None:
    doc = inspect.getdoc(getattr(calib_ros, name)) or ""
    sections = ("Parameters\n----------", "Attributes\n----------", "Raises\n------")
    assert any(section in doc for section in sections), f"{name} has no section of parameters, attributes or errors"


def test_one_version_for_package_metadata_and_results_and_types_are_declared() -> None:
    assert all((ROOT / package / "py.typed").exists() for package in ("calib_ros", "calib_ros_evaluation"))
    assert ET.parse(ROOT / "package.xml").findtext("version") == calib_ros.__version__
    assert ET.parse(ROOT / "calib_ros_msgs" / "package.xml").findtext("version") == calib_ros.__version__
    assert calib_ros.Result(calib_ros.se3.exp([0.0] * 6), "initial").to_dict()["version"] == calib_ros.__version__


def test_the_default_search_box_is_that_of_the_configuration() -> None:
    search, box = Config().search, calib_ros.SearchBox()
    assert (box.rotation_deg, box.translation_m) == (search.rotation_deg, search.translation_m)
    assert all(wide.reach > box.reach for wide in (NOMINAL_BOX, SEMANTIC_BOX))


@pytest.mark.parametrize("room", ["calib_ros.cli", "calib_ros.ros"])
@pytest.mark.parametrize("wanted", [None, "3"])
def test_programs_use_one_thread_for_linear_algebra_unless_told_otherwise(room: str, wanted: str | None) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    if wanted:
        environment["OPENBLAS_NUM_THREADS"] = wanted
    script = f"import os, sys, {room}; print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", wanted or "1"]


def test_a_service_whose_libraries_are_missing_is_told_and_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "needs_a_library.py").write_text("import a_library_that_nobody_has\n")
    monkeypatch.syspath_prepend(tmp_path)
    group = extensions.NODE_SERVICES
    entries = [EntryPoint("absent", "needs_a_library:Server", group), EntryPoint("there", "fractions:Fraction", group)]
    monkeypatch.setattr(extensions, "_entries", lambda group: {entry.name: entry for entry in entries})
    lines: list[str] = []
    assert list(extensions.node_services(lines.append)) == ["there"]
    (line,) = lines
    assert "~/absent" in line
    assert "a_library_that_nobody_has" in line
