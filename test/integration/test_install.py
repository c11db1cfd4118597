"""What users install: the wheel, which declares and holds what it needs and calibrates alone, and packages for colcon."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import signal
import subprocess
import sys
import venv
import xml.etree.ElementTree as ET
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest
from catkin_pkg.packages import find_packages
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from paths import ROOT
from waiting import LIMIT_S

import calib_ros

slow = pytest.mark.slow
PINS = (ROOT / "requirements.txt").read_text(encoding="utf-8")
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
def dist(tmp_path_factory):
    """What `make dist` builds, from a copy, since a build leaves folders behind."""
    folder = tmp_path_factory.mktemp("dist")
    skipped = shutil.ignore_patterns(
        ".git", ".venv*", "build", "dist", "install", "log", "*.egg-info", "__pycache__", "*_out", ".*_cache"
    )
    copy = shutil.copytree(ROOT, folder / "copy", ignore=skipped)
    (copy / ".venv").symlink_to(sys.prefix)
    done = run(sys.executable, copy / "tools/build_wheels.py", folder / "dist")
    assert done.returncode == 0, done.stderr
    return folder / "dist"


@pytest.fixture(scope="module")
def wheel(dist):
    (built,) = dist.glob("calib_ros-*.whl")
    return built


def metadata_of(wheel: Path) -> Message:
    with ZipFile(wheel) as file:
        (name,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(file.read(name).decode())


def link_requirements(environment: Path, wheel: Path, extra: str = "") -> None:
    """What the wheel requires, and what that requires, as links into the environment that runs the tests: nothing to download."""
    lines = [(line, extra) for line in metadata_of(wheel).get_all("Requires-Dist") or []]
    seen = {"calib-ros", "calib-ros-msgs"}
    while lines:
        line, extra = lines.pop()
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        if name in seen or (requirement.marker and not requirement.marker.evaluate({"extra": extra})):
            continue
        seen.add(name)
        distribution = importlib.metadata.distribution(requirement.name)
        lines += [(line, wanted) for wanted in requirement.extras or {""} for line in distribution.requires or []]
        for file in distribution.files or []:
            source = Path(os.path.abspath(file.locate())).relative_to(sys.prefix)
            if source.parts[0] == "lib" and len(source.parts) > 4:  # below site-packages: whole folders
                source = Path(*source.parts[:4])
            target = environment / source
            if source.parts[0] in ("lib", "share") and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                target.symlink_to(Path(sys.prefix, source))


@slow
def test_it_holds_all_packages_with_types_weights_and_shared_files(wheel):
    with ZipFile(wheel) as file:
        names = [name for name in file.namelist() if not name.endswith("/")]
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
    metadata = metadata_of(wheel)
    package = ET.parse(ROOT / "package.xml").getroot()
    assert metadata["Name"] == package.findtext("name") == "calib_ros"
    assert metadata["Version"] == package.findtext("version") == calib_ros.__version__
    assert "# calib_ros" in str(metadata.get_payload())
    requirements = metadata.get_all("Requires-Dist") or []
    always = {re.split(r"[ ;<>=!~]", line)[0].lower() for line in requirements if "extra ==" not in line}
    assert always == {"numpy", "scipy", "pyyaml", "tqdm", "opencv-python-headless", "rosbags"}
    extras = set(metadata.get_all("Provides-Extra") or [])
    assert {"ros", "view", "fleet", "semantics", "video", "all"} <= extras
    # ROS by the pins that everything is tested with.
    pinned = re.findall(r"^(ros-rclpy.*|ros-rmw.*|ros-(?!ament|rosidl)\S+-msgs==.*|ros-std-srvs.*)$", PINS, re.MULTILINE)
    of_ros = {line.partition(";")[0].strip() for line in requirements if 'extra == "ros"' in line}
    assert of_ros == {*pinned, f"calib_ros_msgs=={calib_ros.__version__}"}


@pytest.fixture(scope="module")
def alone(wheel, tmp_path_factory):
    """An environment of the wheel and of what it requires, not more; only its commands are found, no compiler."""
    folder = tmp_path_factory.mktemp("alone") / "venv"
    venv.create(folder)
    link_requirements(folder, wheel)
    install(folder, wheel)
    return folder


def install(environment: Path, wheel: Path) -> None:
    options = ["--no-deps", "--no-index", "--no-compile", "-q"]
    done = run(sys.executable, "-m", "pip", "--python", environment / "bin/python", "install", *options, wheel)
    assert done.returncode == 0, done.stderr


@slow
@pytest.mark.timeout(900)  # a calibration, a check and mypy
def test_alone_in_an_environment_it_calibrates_checks_a_bag_and_its_types_are_found(alone, tmp_path, monkeypatch):
    """Without ROS, onnxruntime and a compiler: what install_requires names is enough."""
    monkeypatch.setenv("PATH", str(alone / "bin"))
    assert shutil.which("gcc") is None
    (tmp_path / "always.yaml").write_text("semantics: {use: always}")
    done = run("calib-ros", "calibrate", "synthetic:seed=1,frames=4", "--config", "always.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("converged: 4 frames")
    assert "semantics.image_classes is off: models need onnxruntime" in done.stderr

    done = run("python", "-m", "calib_ros", "convert", "synthetic:seed=1,frames=8,rings=32", "street", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = run("calib-ros", "check", "street", cwd=tmp_path)
    assert (done.returncode, done.stdout[:5]) == (0, "pass:"), done.stderr
    for command in (["calib-ros", "play", "street"], ["calib_node"], ["calib_lifecycle_node"]):
        done = run(*command, cwd=tmp_path)
        assert done.returncode == 2, done.stderr
        assert len(done.stderr.splitlines()) == 1
        assert "pip install 'calib_ros[ros]'" in done.stderr

    script = tmp_path / "script.py"
    script.write_text(USER_SCRIPT)
    done = run("python", script, cwd=tmp_path)
    assert done.stdout == "converged (4, 4)\n", done.stderr
    done = run(sys.executable, "-m", "mypy", "--strict", "--python-executable", alone / "bin/python", script, cwd=tmp_path)
    assert done.returncode == 0, done.stdout


@slow
@pytest.mark.ros
def test_with_the_extra_ros_its_node_answers_without_a_ros_install(dist, alone, wheel, monkeypatch):
    """calib_ros_msgs and tf2_msgs from their wheel, ROS from its wheels; the client here has the generated ones."""
    from calib_ros.ros.client import ExtrinsicClient

    (messages,) = dist.glob("calib_ros_msgs-*.whl")
    link_requirements(alone, wheel, "ros")
    install(alone, messages)
    monkeypatch.setenv("PATH", str(alone / "bin"))
    for name in ("AMENT_PREFIX_PATH", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        monkeypatch.delenv(name, raising=False)
    where = "import calib_ros_msgs.action, tf2_msgs.msg; print(calib_ros_msgs.__file__, tf2_msgs.__file__)"
    done = run("python", "-c", where)
    assert all(path.startswith(str(alone)) for path in done.stdout.split()), done.stderr
    start = ["--ros-args", "-p", "initial_translation_m:=[0.1, 0.2, 0.3]", "-p", "initial_quaternion_xyzw:=[0.0, 0.0, 0.0, 1.0]"]
    node = subprocess.Popen([alone / "bin/calib_node", *start], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        with ExtrinsicClient(draws=False) as client:
            _, _, answer, _ = client.get_extrinsic(LIMIT_S)
    finally:
        node.send_signal(signal.SIGINT)
        said = node.communicate(timeout=LIMIT_S)[0]
    assert node.returncode == 0, said
    assert answer.status == "initial"
    assert answer.T_camera_lidar[:3, 3].tolist() == [0.1, 0.2, 0.3]


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
