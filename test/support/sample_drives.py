"""The recordings that pages of the documentation name: small streets under those names in a folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from sample_sources import kitti
from scenes import RenderedDrive

from calib_ros.datasets.bag_writer import write_bag
from calib_ros.result import Result

KITTI_RAW = "2011_09_26/2011_09_26_drive_0005_sync"


def street(frames: int = 4) -> RenderedDrive:
    """Where the vehicle stops for every frame."""
    return RenderedDrive(seed=1, frames=frames, rings=64, width=640, height=240, speed=0, stride=30)


def bags(folder: Path, *names: str) -> None:
    """The same street as a bag of each name."""
    write_bag(street(), folder / names[0])
    for name in names[1:]:
        shutil.copytree(folder / names[0], folder / name)


def kitti_raw(folder: Path, frames: int) -> None:
    """With the calibration of the day beside the drive."""
    kitti(folder, "raw", [*street(frames)])
    for path in folder.glob("calib_*.txt"):
        path.rename(folder.parent / path.name)


def for_check(folder: Path) -> None:
    bags(folder, "bag", "drive_00", "week_31/monday")
    next((folder / "bag").glob("*.mcap")).rename(folder / "drive.mcap")
    Result(street().reference, "converged").save(folder / "result.json")


def for_fleet(folder: Path) -> None:
    bags(folder, "fleet/car1/monday", "day_1/car1_monday", "day_2/car1_tuesday")


def for_offline(folder: Path) -> None:
    kitti_raw(folder / KITTI_RAW, 6)
    bags(folder, "my_bag")


def for_tutorial_python(folder: Path) -> None:
    kitti_raw(folder / "kitti/raw" / KITTI_RAW, 6)


def for_vehicle(folder: Path) -> None:
    """A capture, whose extrinsic is right."""
    bags(folder, "FOLDER/bag")
    Result(street().reference, "converged").save(folder / "FOLDER/result.json")
    (folder / "FOLDER/config.yaml").write_text("/**:\n  ros__parameters:\n    search.rotation_deg: 3.0\n")
