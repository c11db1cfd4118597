"""Fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from paths import ROOT
from scenes import Scene

from calib_ros.datasets.synthetic.drive import SyntheticDrive
from calib_ros.frame import Frame


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
    return SyntheticDrive(seed=1, frames=8, rings=32, width=640, height=192, speed=3.0)


@pytest.fixture(scope="session")
def street(drive: SyntheticDrive) -> list[Frame]:
    """The frames of `drive`; frame.reference is the exact extrinsic."""
    return [drive[i] for i in range(len(drive))]


@pytest.fixture(scope="session")
def scene() -> Scene:
    """Four scenes of a street where the vehicle stops, with their features; rendered once per session."""
    return Scene(1)
