#!/usr/bin/env python3
"""Build what a release publishes into a folder: `build_wheels.py dist`, run by `make dist`.

calib_ros: sdist, and one wheel for every Python, since its C kernels are called through ctypes. calib_ros_msgs: a wheel for this
Python, of the messages that `make env` has built, for the extra `ros`. pip puts their libraries into lib/, where those of the
ROS wheels lie and ros-wheels-bootstrapper lets the loader look.
"""

from __future__ import annotations

import platform
import re
import shutil
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

from make_env import PYTHON, ROOT, VENV, EnvError, run

MESSAGES = "calib_ros_msgs"
# tf2_msgs has no wheel of its own. The extra `ros` is for machines without a ROS install, where it shadows nothing.
BUILDS = [VENV / "build/tools/pip_only/tf2_msgs", VENV / "build" / MESSAGES]
SETUP = """\
from setuptools import Distribution, setup

class Binary(Distribution):
    def has_ext_modules(self):
        return True

setup(distclass=Binary, zip_safe=False, package_data={{"": ["*.so"]}}, **{arguments!r})
"""
# Libraries that the ROS wheels bring.
OF_ROS = [word for name in ("lib*rosidl*", "libfastcdr*", "librcutils*") for word in ("--exclude", name)]


def build(source: Path, folder: Path, *options: str) -> None:
    run(PYTHON, "-m", "build", "--no-isolation", *options, "--outdir", folder, source)


def repair(wheel: Path, folder: Path, *options: str) -> None:
    """Tag the wheel with the oldest glibc that it runs with; nothing has to be copied into it."""
    run(PYTHON, "-m", "auditwheel", "repair", "--strip", *options, "--wheel-dir", folder, wheel)


def stage_messages(stage: Path) -> Path:
    """Sources of a wheel of the generated messages: Python packages, and what pip puts into lib/ and share/."""
    for folder in BUILDS:
        run(VENV / "bin/cmake", "--install", folder, "--prefix", stage / "prefix", "--strip")
    source = stage / "source"
    (packages,) = stage.glob("prefix/lib/python3*/site-packages")
    shutil.copytree(packages, source, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__", "*.c"))
    for top in ("lib", "share"):
        left_out = shutil.ignore_patterns("python3*", "cmake", "environment")
        shutil.copytree(stage / "prefix" / top, source / top, ignore=left_out)
    shutil.copy(ROOT / "LICENSE", source)
    package = ET.parse(ROOT / MESSAGES / "package.xml").getroot()
    pins = (ROOT / "requirements.txt").read_text(encoding="utf-8")
    files = [path.relative_to(source) for top in ("lib", "share") for path in (source / top).rglob("*") if path.is_file()]
    arguments = {
        **{name: package.findtext(name) for name in ("name", "version", "description", "license")},
        "license_files": ["LICENSE"],
        "install_requires": re.findall(r"^ros-(?:geometry|std)-msgs==\S+$", pins, re.MULTILINE),
        "packages": [str(path.parent.relative_to(source)).replace("/", ".") for path in source.rglob("__init__.py")],
        "data_files": [(str(path.parent), [str(path)]) for path in files],
    }
    (source / "setup.py").write_text(SETUP.format(arguments=arguments))
    return source


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("calib_ros*"):
        old.unlink()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        build(ROOT, scratch)
        (sdist,) = scratch.glob("*.tar.gz")
        shutil.copy(sdist, folder)
        (wheel,) = scratch.glob("*.whl")
        repair(wheel, folder)
        build(stage_messages(scratch), scratch, "--wheel")
        (wheel,) = scratch.glob(f"{MESSAGES}-*.whl")
        # auditwheel sees no libc in some of these libraries, so it has to be told the newest one allowed.
        newest = f"manylinux_{platform.libc_ver()[1].replace('.', '_')}_{platform.machine()}"
        repair(wheel, folder, "--plat", newest, *OF_ROS)
    for path in sorted(folder.iterdir()):
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]).resolve())
    except EnvError as error:
        sys.exit(f"build_wheels: {error}")
