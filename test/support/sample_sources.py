"""Small sources of every kind, intact: bags, KITTI drives, plain folders, nuScenes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from bag_recorder import as_ros1
from compressed_bags import compressed_bag
from fuzzing import STAMP, K

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.registration.initial_guess import nominal


def frames(count: int = 2) -> list[Frame]:
    """Tiny frames, of too few points for features."""
    rng = np.random.default_rng(1)
    out = []
    for k in range(count):
        cloud = PointCloud(rng.normal(size=(30, 3)).astype(np.float32), rng.random(30).astype(np.float32))
        image = rng.integers(0, 256, (24, 40, 3), np.uint8)
        out.append(Frame(image, cloud, Camera(K, 40, 24), STAMP + k * NANOSECONDS // 10, None, nominal(0.0), f"{k}"))
    return out


class Listed:
    """A source made of frames."""

    def __init__(self, listed: list[Frame]) -> None:
        self.frames, self.name, self.camera_frame, self.lidar_frame = listed, "listed", "camera", "lidar"
        self.camera, self.reference = listed[0].camera, listed[0].reference

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]

    def describe(self) -> dict[str, str]:
        return {}


def kitti(folder: Path, layout: str, listed: Sequence[Frame] = ()) -> None:
    """A drive of two frames, or of those, which stand still; in the object layout each has its own extrinsic."""
    import cv2

    def text(values: Any) -> str:
        return " ".join(f"{v:e}" for v in np.ravel(values))

    some = 0.0 if listed else 0.1  # of a shift and of a speed
    listed = listed or frames()
    T, P = listed[0].reference[:3], f"P2: {text(np.c_[listed[0].camera.K, [10 * some, 0, 0]])}\n"
    files: dict[str, str] = {}
    if layout == "raw":
        rectified = f"R_rect_00: {text(np.eye(3))}\n{P.replace('2', '_rect_02', 1)}"
        files["calib_cam_to_cam.txt"] = f"calib_time: 09-Jan-2012 13:57:47\n{rectified}"
        files["calib_velo_to_cam.txt"] = f"R: {text(T[:, :3])}\nT: {text(T[:, 3] + some)}\ndelta_f: 0 0\n"
        files["calib_imu_to_velo.txt"] = f"R: {text(np.eye(3))}\nT: -0.8 0.3 -0.8\n"
        for name in ("image_02/timestamps.txt", *(f"velodyne_points/timestamps{s}.txt" for s in ("", "_start", "_end"))):
            files[name] = "".join(f"{np.datetime64(f.stamp, 'ns')}\n".replace("T", " ") for f in listed)
        files |= {f"oxts/data/{k:010d}.txt": f"{text(some * np.arange(30))}\n" for k in range(len(listed))}
    elif layout == "odometry":
        files |= {"calib.txt": f"{P}Tr: {text(T)}\n", "times.txt": "0.0\n1.03e-1\n"}
    else:
        own = [f"{P}R0_rect: {text(np.eye(3))}\nTr_velo_to_cam: {text(frame.reference[:3])}\n" for frame in listed]
        files |= {f"calib/{k:06d}.txt": content for k, content in enumerate(own)}
    raw = layout == "raw"
    images, clouds = ("image_02/data", "velodyne_points/data") if raw else ("image_2", "velodyne")
    for k, frame in enumerate(listed):
        name = f"{k:0{10 if raw else 6}d}"
        for place in (images, clouds):
            (folder / place).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / images / f"{name}{'.jpg' if layout == 'odometry' and k else '.png'}"), frame.image)
        np.c_[frame.cloud.xyz, frame.cloud.intensity].astype("<f4").tofile(folder / clouds / f"{name}.bin")
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


def plain(folder: Path) -> None:
    """A plain folder of two frames, a cloud in PCD and one in PLY."""
    import cv2
    from pypcd4 import Encoding
    from pypcd4 import PointCloud as PcdFile

    (folder / "images").mkdir(parents=True)
    (folder / "clouds").mkdir()
    K_text = ", ".join(f"{v:g}" for v in K.ravel())
    rows = "".join(f"- {row}\n" for row in nominal(0.0).tolist())
    (folder / "calibration.yaml").write_text(
        f"image_width: 40\nimage_height: 24\ncamera_matrix: {{rows: 3, cols: 3, data: [{K_text}]}}\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}}\nT_camera_lidar:\n{rows}"
    )
    (folder / "times.csv").write_text(f"name,image_ns,cloud_ns\n0,{STAMP},{STAMP}\n1,{STAMP + 10**8},\n")
    first, second = frames()
    for frame in (first, second):
        cv2.imwrite(str(folder / "images" / f"{frame.name}.{'bmp' if frame is first else 'png'}"), frame.image)
    points = np.c_[first.cloud.xyz, first.cloud.intensity]
    PcdFile.from_xyzi_points(points).save(folder / "clouds/0.pcd", Encoding.BINARY_COMPRESSED)
    header = "ply\nformat ascii 1.0\nelement vertex 30\n" + "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    lines = "".join(f"{x} {y} {z}\n" for x, y, z in second.cloud.xyz.tolist())
    (folder / "clouds/1.ply").write_text(header + lines)


def plain_otherwise(folder: Path) -> None:
    """The same in other formats: LAS and CSV, TIFF and WebP, a camera of Kalibr."""
    import cv2
    import laspy

    plain(folder)
    for part in ("images", "clouds"):
        for path in (folder / part).iterdir():
            path.unlink()
    first, second = frames()
    cv2.imwrite(str(folder / "images/0.tif"), first.image)
    cv2.imwrite(str(folder / "images/1.webp"), second.image)
    las = laspy.create()
    las.x, las.y, las.z = first.cloud.xyz.T.astype(float)
    las.write(folder / "clouds/0.las")
    np.savetxt(folder / "clouds/1.csv", second.cloud.xyz, "%.3f", ",", header="x,y,z")
    (folder / "calibration.yaml").unlink()
    lens = f"[-0.2, 0.6, {K[0, 0]:g}, {K[1, 1]:g}, {K[0, 2]:g}, {K[1, 2]:g}]"
    (folder / "camchain.yaml").write_text(f"cam0:\n  camera_model: ds\n  intrinsics: {lens}\n  resolution: [40, 24]\n")


def ros1(folder: Path) -> None:
    """A bag of ROS 1 of the same frames."""
    path = write_bag(Listed(frames()), folder.parent / "to_convert")
    folder.mkdir()
    as_ros1(path, folder / "drive.bag")
    shutil.rmtree(path)


Measured = tuple[str, str, str, int, np.ndarray, bool, np.ndarray | None]


def nuscenes(
    folder: Path, sensors: dict[str, tuple[np.ndarray, np.ndarray | None]] | None = None, measured: Sequence[Measured] = ()
) -> None:
    """A scene of two key frames; or sensors with T_ego_sensor (4, 4) and K, None of a LiDAR, and what they measured: scene,
    sample, channel, stamp in us, T_global_ego (4, 4), whether it is a key frame, and a picture or points, None without a file."""
    import cv2

    def pose(token: str, T: np.ndarray, **more: Any) -> dict[str, Any]:
        x, y, z, w = se3.quaternion_from_rotation(T[:3, :3])
        return {"token": token, "translation": T[:3, 3].tolist(), "rotation": [w, x, y, z], **more}

    T = se3.from_parts(np.eye(3), [0.1, 0.2, 0.3])
    sensors = sensors or {"CAM_FRONT": (T, K), "LIDAR_TOP": (T, None)}
    for frame in () if measured else frames():
        points = np.c_[frame.cloud.xyz, frame.cloud.intensity, np.zeros(30)]
        own = "scene-0061", f"f{frame.name}"
        contents = {"CAM_FRONT": frame.image, "LIDAR_TOP": points}.items()
        measured = [*measured, *((*own, channel, frame.stamp // 1000, T, True, content) for channel, content in contents)]
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": name, "name": name} for name in dict.fromkeys(own[0] for own in measured)],
        "sample": [{"token": own, "scene_token": scene} for scene, own in dict.fromkeys(own[:2] for own in measured)],
        "sensor": [
            {"token": f"s{name}", "channel": name, "modality": "lidar" if own is None else "camera"}
            for name, (_, own) in sensors.items()
        ],
        "calibrated_sensor": [
            pose(f"c{name}", T, sensor_token=f"s{name}", camera_intrinsic=[] if own is None else own.tolist())
            for name, (T, own) in sensors.items()
        ],
        "sample_data": [],
        "ego_pose": [],
    }
    for _, sample, channel, stamp, T, key, content in measured:
        is_camera = sensors[channel][1] is not None
        file = folder / ("samples" if key else "sweeps") / channel / f"{stamp}{'.png' if is_camera else '.pcd.bin'}"
        file.parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            cv2.imwrite(str(file), content) if is_camera else content.astype("<f4").tofile(file)
        token, (height, width) = f"{channel}{stamp}", (0, 0) if content is None else content.shape[:2]
        row = {"token": token, "sample_token": sample, "ego_pose_token": f"p{token}", "calibrated_sensor_token": f"c{channel}"}
        row |= {"timestamp": stamp, "filename": str(file.relative_to(folder)), "is_key_frame": key}
        tables["sample_data"].append(row | {"width": width, "height": height})
        tables["ego_pose"].append(pose(f"p{token}", T, timestamp=stamp))
    (folder / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows, indent=0))


def originals(root: Path) -> list[Path]:
    """Four bags, three KITTI drives, two plain folders and nuScenes, intact."""
    out = [write_bag(Listed(frames()), root / f"bag_{storage}", storage) for storage in ("mcap", "sqlite3")]
    for layout in ("raw", "odometry", "object"):
        folder = root / layout
        folder.mkdir()
        kitti(folder, layout)
        out.append(folder)
    for make in (plain, plain_otherwise, nuscenes):
        make(root / make.__name__)
        out.append(root / make.__name__)
    ros1(root / "bag_ros1")
    out.append(root / "bag_ros1")
    return [*out, compressed_bag(out[0], root / "bag_compressed")] if find_spec("av") else out
