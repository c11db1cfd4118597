#!/usr/bin/env python3
"""Make .venv: ROS 2 from wheels, the libraries, the generated messages, calib_ros itself. `make_env.py jazzy` makes .venv-jazzy.

Quick when nothing changed; a run that was cut off is made good by the next one.
"""

from __future__ import annotations  # so that an older Python gets as far as the message that it is too old

import fcntl
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DISTRIBUTION = sys.argv[1] if __name__ == "__main__" and sys.argv[1:] else "kilted"
VENV = ROOT / (".venv" if DISTRIBUTION == "kilted" else f".venv-{DISTRIBUTION}")
REQUIREMENTS = ["requirements.txt", "constraints.txt"] + [f"requirements-{DISTRIBUTION}.txt"] * (DISTRIBUTION != "kilted")
PYTHON = VENV / "bin" / "python"
STAMPS = VENV / "stamps"
PIP_INSTALL = [PYTHON, "-m", "pip", "install", "-q", "--no-input", "--disable-pip-version-check"]
PIP_RUNNING = VENV / "pip-is-running"
KERNELS = ["calib_ros/registration/score/kernel.c", "calib_ros_thesis/kernel.c"]
MESSAGE_PACKAGES = ["tools/pip_only/tf2_msgs", "tools/pip_only/livox_ros_driver2", "calib_ros_msgs"]
SHARE = {
    "config": "calib_ros/config",
    "launch": "calib_ros/launch",
    "resource/calib_ros": "ament_index/resource_index/packages/calib_ros",
}
PYTHON_INCLUDE = sysconfig.get_path("include", "posix_prefix")

# A sourced ROS install, or another environment of wheels, would shadow the one made here.
FOREIGN = [
    "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONHOME",
    "PYTHONPATH", "RMW_IMPLEMENTATION", "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
]  # fmt: skip

SMOKE = """
import rclpy, tf2_msgs.msg, calib_ros, cv2, jinja2, matplotlib, onnxruntime, pandas, rosbags, scipy, sklearn
import rclpy.action, rclpy.lifecycle
from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic
from calib_ros_msgs.srv import GetExtrinsic
from calib_ros.registration.score import sampler
from rclpy.serialization import deserialize_message, serialize_message
assert deserialize_message(serialize_message(Extrinsic(score=0.5)), Extrinsic).score == 0.5
serialize_message(tf2_msgs.msg.TFMessage()), serialize_message(GetExtrinsic.Response()), serialize_message(Calibrate.Result())"""


class EnvError(Exception):
    """What went wrong and what to do about it."""


def run(*command: object, advice: str = "") -> str:
    """Run a command in the repository and return its output; when it fails, raise with the output's end."""
    env = {name: value for name, value in os.environ.items() if name not in FOREIGN}
    env["PATH"] = f"{VENV / 'bin'}{os.pathsep}{env.get('PATH', os.defpath)}"
    done = subprocess.run(
        [str(word) for word in command], cwd=ROOT, env=env, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
    )  # fmt: skip
    if done.returncode:
        tail = "\n".join("    " + line for line in done.stdout.strip().splitlines()[-12:])
        raise EnvError(f"{command[0]} {command[1]} ... failed:\n{tail}\n{advice}".rstrip())
    return done.stdout


def check_platform() -> None:
    libc, version = platform.libc_ver()
    fits = (
        sys.implementation.name == "cpython"
        and (3, 10) <= sys.version_info[:2] <= (3, 14)
        and (sys.platform, platform.machine(), libc) == ("linux", "x86_64", "glibc")
        and tuple(map(int, version.split(".")[:2])) >= (2, 28)
    )
    if not fits:
        raise EnvError(
            f"this is {sys.implementation.name} {platform.python_version()} on {platform.platform()}, but the"
            " ROS 2 wheels are for CPython 3.10 to 3.14 on Linux x86_64 with glibc 2.28 or newer. Use another"
            " Python (make env PYTHON=...), or a ROS 2 install and colcon (README.md, 'On a vehicle')."
        )


def check_system_packages() -> None:
    """What no wheel brings: a C++ compiler, and ensurepip and Python.h, which Debian packages apart."""
    python = f"python3.{sys.version_info.minor}"
    needs = {
        f"{python}-venv": importlib.util.find_spec("ensurepip"),
        f"{python}-dev": Path(PYTHON_INCLUDE, "Python.h").exists(),
        "g++": os.environ.get("CXX") or any(shutil.which(name) for name in ("g++", "c++", "clang++")),
    }
    if missing := [package for package, found in needs.items() if not found]:
        command = ["apt-get", "install", "-y", *missing]
        advice = f"Missing: {', '.join(missing)}. Install them and run this again: sudo {' '.join(command)}"
        if os.geteuid() != 0 or shutil.which("apt-get") is None:
            raise EnvError(advice)
        run("apt-get", "update", advice=advice)
        run(*command, advice=advice)


def create_venv() -> None:
    check_system_packages()
    run(sys.executable, "-m", "venv", "--clear", VENV)


def merged_requirements() -> Path:
    """The requirements, where another distribution than Kilted replaces the lines of the ROS packages."""
    common, constraints, *own = [(ROOT / name).read_text() for name in REQUIREMENTS]
    if not own:
        return ROOT / "requirements.txt"
    folder = VENV / "requirements"
    folder.mkdir(exist_ok=True)
    for name, text, more in (("requirements.txt", common, own[0]), ("constraints.txt", constraints, "")):
        (folder / name).write_text(re.sub(r"(?m)^ros-.*\n", "", text) + more)
    return folder / "requirements.txt"


def install_requirements() -> None:
    # pip takes a package that was cut off half way for installed, so the next run has to start afresh.
    PIP_RUNNING.touch()
    advice = (
        "Check the network and the disk space (900 MB). Without a network: `pip download -d WHEELS -r"
        " requirements.txt` on a machine that has one and the same Python, bring the folder WHEELS over, then"
        " `PIP_NO_INDEX=1 PIP_FIND_LINKS=$PWD/WHEELS make env`."
    )
    run(*PIP_INSTALL, "-r", merged_requirements(), advice=advice)
    PIP_RUNNING.unlink()
    # The wheels name include folders of the machine that built them; CMake refuses folders that do not exist.
    numpy_include = run(PYTHON, "-c", "import numpy; print(numpy.get_include())").strip()
    for path in VENV.glob("share/*/cmake/*__rosidl_generator_py*.cmake"):
        text = re.sub(r'/opt/python/[^;"\s]*/numpy/[^;"\s]*include', numpy_include, path.read_text())
        path.write_text(re.sub(r'/opt/python/[^;"\s]*/include/python[^;"/\s]*', PYTHON_INCLUDE, text))


def build_messages() -> None:
    cmake = VENV / "bin/cmake"
    for folder in MESSAGE_PACKAGES:
        build = VENV / "build" / folder
        # What was built before goes first, else a renamed message would stay, with half of it working.
        for manifest in build.glob("install_manifest.txt"):
            for file in manifest.read_text().splitlines():
                Path(file).unlink(missing_ok=True)
        shutil.rmtree(build, ignore_errors=True)
        run(
            cmake, "-G", "Ninja", "-S", folder, "-B", build, "-Wno-dev", "-DBUILD_TESTING=OFF",
            f"-DCMAKE_PREFIX_PATH={VENV}", f"-DCMAKE_INSTALL_PREFIX={VENV}", f"-DPython3_EXECUTABLE={PYTHON}",
        )  # fmt: skip
        run(cmake, "--build", build, "--target", "install")


def install_package() -> None:
    # Without --use-pep517 an older pip would obey setup.cfg and put the scripts where only `ros2 run` looks.
    run(*PIP_INSTALL, "--no-deps", "--no-build-isolation", "--use-pep517", "-e", ".")
    # An editable install leaves the data files out; as links they are never older than the sources.
    for source, target in SHARE.items():
        link = VENV / "share" / target
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(ROOT / source)
    run(PYTHON, "-c", SMOKE, advice=f"The environment is broken; delete {VENV.name} and run this again.")


# A step is redone when one of its inputs, or a step before it, changed.
STEPS = [
    ("create .venv", create_venv, ["tools/make_env.py"]),
    ("install requirements", install_requirements, REQUIREMENTS),
    ("build messages", build_messages, MESSAGE_PACKAGES),
    ("install calib_ros", install_package, ["setup.py", "setup.cfg", "calib_ros/version.py", *KERNELS]),
]


def digest(seed: str, inputs: list[str]) -> str:
    total = hashlib.sha256(seed.encode())
    for name in inputs:
        path = ROOT / name
        for file in [path] if path.is_file() else sorted(path.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                total.update(f"{file.relative_to(ROOT)}\0".encode() + file.read_bytes())
    return total.hexdigest()


def main() -> None:
    check_platform()
    if missing := [name for name in REQUIREMENTS if not (ROOT / name).exists()]:
        raise EnvError(f"no wheels of {DISTRIBUTION} are known: {missing[0]} is missing")
    # Two runs at once, as from `make -j test lint`, wait for each other.
    with open(__file__) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        stale = PIP_RUNNING.exists() or not PYTHON.exists()
        # ROOT, because a venv that was moved keeps its old path in every script.
        key = f"{ROOT}\n{sys.version}\n{os.path.realpath(sys.executable)}"
        for name, step, inputs in STEPS:
            key = digest(key, inputs)
            stamp = STAMPS / name.replace(" ", "-")
            stale = stale or not stamp.exists() or stamp.read_text() != key
            if stale:
                start = time.monotonic()
                print(f"make_env: {name} ... ", end="", flush=True)
                stamp.unlink(missing_ok=True)
                step()
                STAMPS.mkdir(exist_ok=True)
                stamp.write_text(key)
                print(f"{time.monotonic() - start:.1f} s", flush=True)


if __name__ == "__main__":
    try:
        main()
    except EnvError as error:
        sys.exit(f"\nmake_env: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
