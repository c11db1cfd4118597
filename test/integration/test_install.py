"""What users install: the wheel, which declares and holds what it needs and calibrates alone, and packages for colcon."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
import xml.etree.ElementTree as ET
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest
from catkin_pkg.packages import find_packages
from paths import ROOT

import calib_ros

slow = pytest.mark.slow
# What a user types first; `mypy --strict` accepts it.
USER_SCRIPT = """\
from calib_ros import Calibrator, Result, SearchBox, open_dataset
source = open_dataset("synthetic:seed=1,frames=2,rings=32,width=640,height=192")
assert source.reference is not None
result: Result = Calibrator(source.camera).calibrate([source[0], source[1]], source.reference, SearchBox(0, 0))
print(result.status, result.T_camera_lidar.shape)
"""


def run(*command: object, **more: object) -> subprocess.CompletedProcess[str]:
    env = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")}
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, env=env, **more)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, since a build leaves folders behind."""
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "calib_ros"
    skipped = shutil.ignore_patterns(
        ".git", ".venv*", "build", "install", "log", "*.egg-info", "__pycache__", "*_out", ".*_cache"
    )
    shutil.copytree(ROOT, copy, ignore=skipped)
    options = ["--no-deps", "--no-build-isolation", "-q", "-w", folder]
    done = run(sys.executable, "-m", "pip", "wheel", *options, copy)
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


@slow
def test_it_holds_all_packages_with_types_weights_and_shared_files(wheel):
    with ZipFile(wheel) as file:
        names = file.namelist()
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in ROOT.glob("calib_ros*/__init__.py")
        for path in package.parent.rglob("*")
        if path.suffix in (".py", ".typed", ".onnx", ".yaml") or path.name == "LICENSE"
    }
    files = [ROOT / "package.xml", *(ROOT / "config").iterdir(), *(ROOT / "launch").glob("*.launch.py")]
    shared = {f"calib_ros/{path.relative_to(ROOT).as_posix()}" for path in files} | {
        "ament_index/resource_index/packages/calib_ros",
        *(f"calib_ros/config/presets/{path.name}" for path in (ROOT / "calib_ros_thesis" / "presets").glob("*.yaml")),
    }
    shared = {f"calib_ros-{calib_ros.__version__}.data/data/share/{name}" for name in shared}
    compiled = {name for name in names if name.endswith((".so", ".pyd"))}
    assert {name.partition(".")[0] for name in compiled} == {"calib_ros/registration/score/kernel", "calib_ros_thesis/kernel"}
    assert {name for name in names if ".dist-info/" not in name and not name.endswith((".so", ".pyd"))} == sources | shared


@slow
def test_its_metadata_name_version_requirements_and_extras(wheel):
    with ZipFile(wheel) as file:
        (name,) = (name for name in file.namelist() if name.endswith("METADATA"))
        metadata = Parser().parsestr(file.read(name).decode())
    package = ET.parse(ROOT / "package.xml").getroot()
    assert metadata["Name"] == package.findtext("name") == "calib_ros"
    assert metadata["Version"] == package.findtext("version") == calib_ros.__version__
    assert "# calib_ros" in str(metadata.get_payload())
    requirements = metadata.get_all("Requires-Dist") or []
    always = {re.split(r"[ ;<>=!~]", line)[0].lower() for line in requirements if "extra ==" not in line}
    assert always == {"numpy", "scipy", "pyyaml", "tqdm", "opencv-python-headless"}
    extras = set(metadata.get_all("Provides-Extra") or [])
    assert {"bags", "models", "motion", "evaluation", "all", "cluster", "training", "test"} <= extras


@slow
@pytest.mark.timeout(900)  # pip, a calibration and mypy in a fresh environment
def test_alone_in_an_environment_it_calibrates_and_its_types_are_found(wheel, tmp_path):
    """Without ROS, onnxruntime and rosbags: what install_requires names is enough."""
    venv.create(tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    # What is imported is compiled then: all of SciPy would take longer than the rest.
    done = run(sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-compile", wheel, cwd=tmp_path)
    if done.returncode:
        pytest.skip(f"the dependencies cannot be installed here: {done.stderr.strip().splitlines()[-1]}")
    absent = run(python, "-c", "import onnxruntime", cwd=tmp_path)
    assert absent.returncode
    (tmp_path / "always.yaml").write_text("semantics: {use: always}")
    calibrate = (tmp_path / "venv" / "bin" / "calib-ros", "calibrate", "synthetic:seed=1,frames=4")
    done = run(*calibrate, "--config", "always.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("converged: 4 frames")
    assert "semantics.image_classes is off: models need onnxruntime" in done.stderr

    script = tmp_path / "script.py"
    script.write_text(USER_SCRIPT)
    done = run(python, script, cwd=tmp_path)
    assert done.stdout == "converged (4, 4)\n", done.stderr
    done = run(sys.executable, "-m", "mypy", "--strict", "--python-executable", python, script, cwd=tmp_path)
    assert done.returncode == 0, done.stdout


@pytest.fixture
def workspace(tmp_path):
    """The commands of the README, with a link in place of the clone."""
    (link,) = re.findall(r"^ln -s (\S+) \.", (ROOT / "README.md").read_text(), re.MULTILINE)
    source = tmp_path / "src"
    source.mkdir()
    (source / "calib_ros").symlink_to(ROOT)
    (source / Path(link).name).symlink_to(link)
    return tmp_path


def test_rosdep_finds_both_packages(workspace):
    found = {path: package.name for path, package in find_packages(str(workspace / "src")).items()}
    assert found == {"calib_ros": "calib_ros", "calib_ros_msgs": "calib_ros_msgs"}


@pytest.mark.skipif(shutil.which("colcon") is None, reason="colcon is not installed; see requirements-colcon.txt")
def test_plain_colcon_finds_both_packages(workspace):
    done = subprocess.run(["colcon", "list"], cwd=workspace, capture_output=True, text=True)
    assert [line.split("\t") for line in done.stdout.splitlines()] == [
        ["calib_ros", "src/calib_ros", "(ros.ament_python)"],
        ["calib_ros_msgs", "src/calib_ros_msgs", "(ros.ament_cmake)"],
    ], done.stderr
