"""Fixtures that all tests share, the marker of the laboratory, and a ROS domain for every process that runs tests."""

# ruff: noqa: E402
from __future__ import annotations

import os
import subprocess
import sys

from paths import ROOT

# `colcon test` runs in the sources, but `colcon build` leaves the kernels where it installs.
if not (ROOT / "calib_ros_thesis/kernel.abi3.so").exists():
    subprocess.run([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], cwd=ROOT, check=True)

from calib_ros.runtime import use_one_blas_thread

use_one_blas_thread()  # as the commands and the node do; processes that run tests share the cores
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import fcntl
import math
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

import pytest
from paths import ROOT
from scenes import RENDERINGS, RenderedDrive, Scene, picture_once, scan_once

from calib_ros.datasets.bag_writer import write_bag
from calib_ros.frame import Frame
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.rig import SyntheticRig

LABORATORY = ("evaluation", "benchmarks")  # folders of tests that do not guard the product
LONGEST_FIRST = ("integration", "evaluation", "unit")  # so that no long file begins when the others are done
LOCKS: list[IO[str]] = []  # open as long as this process runs
DOMAINS = 100  # ROS domains 1 to 100 need none of the ports that Linux gives to outgoing connections


def pytest_configure(config: pytest.Config) -> None:
    """ROS stays on this machine, and processes that run tests at the same time do not meet."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    os.environ["ROS_DOMAIN_ID"] = str(1 + (zlib.crc32(run.encode()) + int(worker)) % DOMAINS)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    if "PYTEST_XDIST_WORKER" not in os.environ:  # whose environment is this one's
        os.environ[RENDERINGS] = folder_of_renderings()


def folder_of_renderings() -> str:
    """A new one, locked until this process ends; those of runs that were killed are removed."""
    prefix = "calib_ros_renderings_"
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    file = (folder / "lock").open("w")
    fcntl.flock(file, fcntl.LOCK_EX)
    LOCKS.append(file)
    for lock in Path(tempfile.gettempdir()).glob(f"{prefix}*/lock"):
        with suppress(OSError), lock.open() as other:
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)
    return str(folder)


def pytest_unconfigure() -> None:
    if "PYTEST_XDIST_WORKER" not in os.environ:
        shutil.rmtree(os.environ.pop(RENDERINGS, ""), ignore_errors=True)


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out what -m does not want
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks the laboratory, begins with the longest files, and leaves short forms out where the long ones run."""

    def folder(item: pytest.Item) -> str:
        return item.path.relative_to(ROOT / "test").parts[0]

    if "not slow" not in config.option.markexpr:
        long = {item.parent.nodeid + item.originalname for item in items if item.get_closest_marker("slow")}
        left_out = [i for i in items if i.get_closest_marker("short") and i.parent.nodeid + i.originalname in long]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]

    for item in items:
        if folder(item) in LABORATORY:
            item.add_marker("laboratory")
    order = {name: k for k, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: order.get(folder(item), len(order)))


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    """The folder with real KITTI frames, which are not part of the repository."""
    chosen = os.environ.get("KITTI_ROOT")
    root = Path(chosen) if chosen else ROOT / ".." / "shared" / "kitti"
    if not (root / "raw").is_dir():
        pytest.skip(f"no KITTI frames in {'$KITTI_ROOT' if chosen else '../shared/kitti'}; set KITTI_ROOT to their folder")
    return root.resolve()


@pytest.fixture(scope="session")
def drive() -> SyntheticDrive:
    """A small synthetic street for tests of the whole; frames are rendered once per session."""
    return RenderedDrive(seed=1, frames=8, rings=32, width=640, height=192, speed=3.0)


@pytest.fixture(scope="session")
def street(drive: SyntheticDrive) -> list[Frame]:
    """The frames of `drive`; frame.reference is the exact extrinsic."""
    return [drive[i] for i in range(len(drive))]


@pytest.fixture(scope="module")
def rendered_once() -> Iterator[None]:
    """Sources named `synthetic:` are rendered once per session, also in commands that run in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SyntheticRig, "_scan", scan_once)
        patch.setattr(SyntheticRig, "_picture", picture_once)
        yield


@pytest.fixture(scope="session")
def street_bag(drive: SyntheticDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`drive` as a bag. Tests only read it."""
    return write_bag(drive, tmp_path_factory.mktemp("bags") / "street", "sqlite3")


@pytest.fixture(scope="session")
def scene() -> Scene:
    """Four scenes of a street where the vehicle stops, with their features; rendered once per session."""
    return Scene(1)


@pytest.fixture(scope="module")
def ros_in_this_process() -> Iterator[None]:
    """Nodes that start in this process are discovered by nodes of the same process only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
        patch.setattr("calib_ros.ros.inputs.SILENCE_S", math.inf)  # how fast a test sends depends on the machine
        yield
