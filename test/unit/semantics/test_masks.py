"""Boundaries of masks as edge maps, and masks that are read from a folder."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from masks_of_pictures import box, frame_of, later, picture_of

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros.registration.classes import MASKS
from calib_ros_semantics.models.masks import Mask, mask_edges
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.ready import MaskFolder
from calib_ros_semantics.models.segmentation import load_model

SIZE = (120, 200)
FRAME = frame_of(np.zeros((*SIZE, 3), np.uint8), "000007")


def rectangle(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    return box(left, top, right, bottom, SIZE)


def edges_of(*pictures: np.ndarray) -> np.ndarray:
    return mask_edges([Mask.of(picture) for picture in pictures], pictures[0].shape)


def half_plane(angle_deg: float, cell: int = 1) -> np.ndarray:
    """What lies on one side of a line whose normal has this angle; made of squares of `cell` pixels."""
    v, u = np.mgrid[: SIZE[0] // cell, : SIZE[1] // cell] * cell + (cell - 1) / 2
    angle = np.deg2rad(angle_deg)
    inside = (u - 101.3) * np.cos(angle) + (v - 60.7) * np.sin(angle) > 0
    return inside.repeat(cell, axis=0).repeat(cell, axis=1)


def test_a_vertical_boundary_is_a_horizontal_gradient() -> None:
    horizontal, vertical = edges_of(rectangle(60, 30, 140, 90))
    sides = horizontal[40:80]
    assert set(np.flatnonzero(sides.max(axis=0)).tolist()) == {59, 60, 139, 140}  # the pixels on both sides of the boundary
    assert sides[:, [59, 60, 139, 140]].min() > 0.95
    assert vertical[40:80].max() < 0.01
    assert set(np.flatnonzero(vertical[:, 80:120].max(axis=1)).tolist()) == {29, 30, 89, 90}
    assert vertical[[29, 30, 89, 90], 80:120].min() > 0.95
    assert (horizontal + vertical)[45:75, 75:125].max() == 0


def test_the_strength_is_shared_out_by_the_direction_of_the_normal() -> None:
    for angle, cell in itertools.product((0, 10, 20, 45, 70, 100, 135, 160), (1, 5)):
        horizontal, vertical = edges_of(half_plane(angle, cell))[:, 10:-10, 10:-10]
        strength = horizontal + vertical
        on = strength > 0.5
        assert on.sum() > 90
        error = horizontal[on] / strength[on] - np.cos(np.deg2rad(angle)) ** 2
        assert abs(error.mean()) < 0.04
        assert np.sqrt((error**2).mean()) < (0.03 if cell == 1 else 0.15)


@pytest.mark.parametrize("apart", [-2, -1, 0, 1, 2])
def test_a_boundary_that_two_masks_share_is_no_thicker(apart: int) -> None:
    strength = edges_of(rectangle(20, 20, 100, 100), rectangle(100 + apart, 20, 180, 100)).sum(axis=0)
    across = strength[40:80, 90:110]
    assert ((across > 0).sum(axis=1) <= 2).all()
    assert across.max() == pytest.approx(1)
    assert abs(float((across.sum(axis=0) * np.arange(90, 110)).sum() / across.sum()) - (99.5 + apart / 2)) <= 0.5


def test_the_border_of_the_image_is_no_edge() -> None:
    assert edges_of(np.ones(SIZE, bool)).max() == 0
    strength = edges_of(rectangle(0, 0, 100, 120)).sum(axis=0)
    assert set(np.flatnonzero(strength.max(axis=0)).tolist()) == {99, 100}
    almost = edges_of(rectangle(2, 1, 100, 118)).sum(axis=0)  # as models leave it where an object goes on
    assert set(np.flatnonzero(almost.max(axis=0)).tolist()) == {99, 100}


def test_each_mask_has_its_own_boundary() -> None:
    outer, inner = rectangle(40, 20, 160, 100), rectangle(80, 40, 120, 80)
    alone, both = edges_of(outer), edges_of(outer, inner)
    assert alone[0, 60, [79, 80, 119, 120]].max() == 0
    assert both[0, 60, [39, 40, 79, 80, 119, 120, 159, 160]].min() > 0.95
    pole = edges_of(rectangle(100, 10, 104, 110))[0, 60]
    assert set(np.flatnonzero(pole).tolist()) <= {99, 100, 103, 104}
    assert pole[[99, 104]].min() > 0.5
    unsure = mask_edges([replace(Mask.of(outer), score=0.5)], SIZE).sum(axis=0)
    assert unsure[60, 40] == pytest.approx(0.5, abs=0.03)
    none = mask_edges([], SIZE)
    assert (none.shape, none.dtype, none.max()) == ((2, *SIZE), np.float32, 0)


def written(folder: Path, name: str, picture: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    assert cv2.imwrite(str(path), picture)
    return path


def test_masks_from_a_folder(tmp_path: Path) -> None:
    pictures = [rectangle(10, 10, 60, 50), rectangle(100, 20, 190, 110)]
    written(tmp_path / "000007", "b.png", pictures[1].astype(np.uint8) * 255)
    written(tmp_path / "000007", "a.png", pictures[0].astype(np.uint8))  # 0 and 1
    written(tmp_path / "000007", "c.png", np.zeros(SIZE, np.uint8))
    written(tmp_path / "000008", "a.png", pictures[1].astype(np.uint8) * 255)
    masks = MaskFolder(tmp_path).masks(FRAME, later())
    assert np.array_equal([picture_of(mask, SIZE) for mask in masks], pictures)
    edges = load_model(MASKS, str(tmp_path), SemanticsConfig())
    assert np.array_equal(edges(FRAME, later()), edges_of(*pictures))
    assert "NAME/*.png" in edges.describe()


def test_folders_of_masks_that_cannot_be_used(tmp_path: Path) -> None:
    model = MaskFolder(tmp_path)
    with pytest.raises(ModelError, match=r"no .*000007/\*\.png; .*\(the number of a KITTI frame, 000042\)"):
        model.masks(FRAME, later())
    with pytest.raises(ModelError, match=r"no name"):
        model.masks(replace(FRAME, name=""), later())
    path = written(tmp_path / "000007", "a.png", np.zeros((60, 100), np.uint8))
    with pytest.raises(ModelError, match=r"a\.png is 100x60, but the image is 200x120"):
        model.masks(FRAME, later())
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ModelError, match=r"a\.png is not a complete PNG"):
        model.masks(FRAME, later())
    with pytest.raises(BudgetError):
        model.masks(FRAME, Deadline(0))
