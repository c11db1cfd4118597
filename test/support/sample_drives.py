"""The recordings that pages of the documentation name: small streets under those names in a folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
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
    """KITTI's layout: calibration of the day, pictures, scans without rings, the moments of both, velocities of zero."""
    drive = street(frames)
    day = folder.parent
    folder.mkdir(parents=True)

    def text(values: object) -> str:
        return " ".join(f"{v:e}" for v in np.ravel(np.asarray(values, float)))

    T = drive.reference
    files = {
        day / "calib_cam_to_cam.txt": f"R_rect_00: {text(np.eye(3))}\nP_rect_02: {text(np.c_[drive.camera.K, np.zeros(3)])}\n",
        day / "calib_velo_to_cam.txt": f"R: {text(T[:3, :3])}\nT: {text(T[:3, 3])}\n",
        day / "calib_imu_to_velo.txt": f"R: {text(np.eye(3))}\nT: {text(np.zeros(3))}\n",
    }
    moments = "".join(f"2011-09-26 13:02:{25 + 3 * k}.000000000\n" for k in range(frames))
    for name in ("image_02/timestamps.txt", *(f"velodyne_points/timestamps{s}.txt" for s in ("", "_start", "_end"))):
        files[folder / name] = moments
    for k in range(frames):
        files[folder / f"oxts/data/{k:010d}.txt"] = text(np.zeros(30)) + "\n"
        for place in ("image_02/data", "velodyne_points/data"):
            (folder / place).mkdir(parents=True, exist_ok=True)
        frame = drive[k]
        cv2.imwrite(str(folder / f"image_02/data/{k:010d}.png"), frame.image)
        np.c_[frame.cloud.xyz, frame.cloud.intensity].astype("<f4").tofile(folder / f"velodyne_points/data/{k:010d}.bin")
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)


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
