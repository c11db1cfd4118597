"""Plain folders of images and clouds, in every format, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib_ros.datasets import open_dataset
from calib_ros.datasets.folder import FolderSource
from calib_ros.errors import BadInputError

WIDTH, HEIGHT = 40, 24
CALIBRATION = """\
image_width: 40
image_height: 24
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [30.0, 0, 20, 0, 30, 12, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0, 0, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
REFERENCE = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
ROWS = "T_camera_lidar:\n" + "".join(f"- {row}\n" for row in REFERENCE.tolist())


def write_image(path: Path, seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)
    assert cv2.imwrite(str(path), image)
    return image


def cloud(seed: int = 0, count: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1000 + seed)
    xyz = rng.normal(scale=10, size=(count, 3)).astype("<f4")
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        "intensity": rng.random(count).astype("<f4"),
        "ring": rng.integers(0, 32, count).astype("<u2"),
        "time": np.linspace(-0.05, 0.05, count).astype("<f4"),
    }


def pcd_header(columns: dict[str, np.ndarray], data: str) -> bytes:
    kinds = {"f": "F", "u": "U", "i": "I"}
    count = len(columns["x"])
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(c.dtype.itemsize) for c in columns.values()),
        "TYPE " + " ".join(kinds[c.dtype.kind] for c in columns.values()),
        "COUNT " + " ".join("1" for _ in columns),
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {data}",
    ]
    return ("\n".join(lines) + "\n").encode()


def records(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.rec.fromarrays(list(columns.values()), names=list(columns))


def write_pcd(path: Path, columns: dict[str, np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pcd_header(columns, "binary") + records(columns).tobytes())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images 2, 10 and 11, clouds 2, 10 and 12, a reference and no stamps."""
    root = tmp_path / "vehicle"
    for number in (2, 10, 11):
        write_image(root / "images" / f"{number}.png", number)
    for number in (2, 10, 12):
        write_pcd(root / "clouds" / f"{number}.pcd", cloud(number))
    (root / "calibration.yaml").write_text(CALIBRATION + ROWS)
    return root


def test_frames_are_the_names_with_image_and_cloud(folder):
    source = open_dataset(folder)
    assert isinstance(source, FolderSource)
    assert [source[i].name for i in range(len(source))] == ["2", "10"]
    frame = source[1]
    assert np.array_equal(frame.image, write_image(folder / "again.png", 10))
    expected = cloud(10)
    assert np.array_equal(frame.cloud.xyz, np.stack([expected[axis] for axis in "xyz"], axis=1))
    assert np.array_equal(frame.cloud.intensity, expected["intensity"])
    assert np.array_equal(frame.cloud.ring, expected["ring"])
    assert np.allclose(frame.cloud.time, expected["time"], atol=1e-9)
    assert np.array_equal(frame.reference, REFERENCE)
    assert np.array_equal(frame.camera.D, [-0.1, 0.02, 0, 0, 0])
    assert (source.camera_frame, source.lidar_frame) == ("front", "lidar")


def test_files_without_partner_are_named(folder):
    frames = open_dataset(folder).describe()["frames"]
    assert "1 image without cloud (11.png)" in frames
    assert "1 cloud without image (12.pcd)" in frames


def test_a_folder_without_any_pair_is_an_error(folder):
    for name in ("2", "10"):
        (folder / "clouds" / f"{name}.pcd").unlink()
    with pytest.raises(BadInputError, match=r"no name has both an image \(3 in images\) and a cloud \(1 in clouds\)"):
        open_dataset(folder)
