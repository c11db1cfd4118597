"""Masks: their boundaries as edge maps, masks of a folder, and those that prompts find: every object of a known scene once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from masks_of_pictures import box, compared, frame_of, later, picture_of

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros.registration.classes import MASKS
from calib_ros_semantics.models.masks import Mask, Proposals, accepted_masks, mask_edges, without_duplicates, without_specks
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.ready import MaskFolder
from calib_ros_semantics.models.segment_anything import everything, prompt_points
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


# --- found by prompts -----------------------------------------------------------------------------------------------------


STREET = (376, 1240)
NESTED = 3  # masks that the stand-in gives for a prompt


class StandIn:
    """Answers as Segment Anything does: for each prompt the smallest thing there, what that is part of, and so on.

    noise: 0, or how much boundaries waver, px; then predicted IoUs scatter, and masks of nothing come along: some with a low
    predicted IoU, some whose logits are hardly above the threshold.
    """

    def __init__(self, things: Sequence[np.ndarray], noise: float = 0.0, batch: int = 16) -> None:
        self.size, self.noise, self.batch = things[0].shape, noise, batch
        self.things = sorted(things, key=np.count_nonzero)
        self.asked = 0
        self._signed = [self._distance(thing) for thing in self.things]
        self._random = np.random.default_rng(7)

    def _distance(self, thing: np.ndarray) -> np.ndarray:
        """To the boundary, px, above 0 inside; every other pixel. The border of the picture is none."""
        wide = np.pad(thing, 30, mode="edge").astype(np.uint8)
        signed = cv2.distanceTransform(wide, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - wide, cv2.DIST_L2, 5)
        inner = signed[30:-30, 30:-30]
        return cv2.resize(inner, (self.size[1] // 2, self.size[0] // 2), interpolation=cv2.INTER_AREA)

    def _wave(self) -> np.ndarray:
        rough = self._random.normal(0, 1, (12, 40)).astype(np.float32)
        return cv2.resize(rough, self._signed[0].shape[::-1], interpolation=cv2.INTER_CUBIC)

    def __call__(self, points: np.ndarray) -> Proposals:
        logits, scores = [], []
        for u, v in np.rint(points).astype(int):
            self.asked += 1
            here = [k for k, thing in enumerate(self.things) if thing[v, u]][:NESTED]
            for k in here:
                logits.append(4 * (self._signed[k] + self.noise * self._wave()))
                scores.append(0.95 + 0.02 * np.clip(self._random.normal(), -3, 2) * (self.noise > 0))
            if self.noise:
                logits += [10 * self._wave() - 10, 0.8 * self._wave()]  # of nothing: unsure, or hardly a mask
                scores += [self._random.uniform(0.5, 0.87), 0.93]
        if not logits:
            return Proposals(np.zeros((0, 1, 1), np.float32), np.zeros(0, np.float32), self.size, (1.0, 1.0))
        half = self._signed[0].shape
        return Proposals(np.stack(logits), np.array(scores, np.float32), self.size, (float(half[0]), float(half[1])))


def found_by(model: StandIn, along: int = 16) -> list[Mask]:
    return everything(model, model.size, lambda: model.batch, along, later())


def street() -> list[np.ndarray]:
    """Things in a street; what is in front takes away from what is behind, and parts lie within wholes."""

    def within(left: int, top: int, right: int, bottom: int) -> np.ndarray:
        return box(left, top, right, bottom, STREET)

    road, sky = within(0, 230, 1240, 376), within(0, 0, 1240, 90)
    house, second = within(0, 90, 420, 230), within(760, 40, 1240, 260)
    car, rear, pole, sign = (
        within(480, 190, 700, 330),
        within(640, 170, 850, 290),
        within(930, 10, 940, 340),
        within(900, 15, 975, 95),
    )
    windows = [within(left, 110, left + 90, 200) for left in (20, 150, 300)]
    pane, wheel, speck = within(500, 195, 640, 240), within(500, 280, 560, 330), within(200, 300, 206, 306)
    rear &= ~car
    for whole, fronts in ((sky, second), (road, second), *((w, car | rear | pole | sign) for w in (road, house, second, sky))):
        whole &= ~fronts
    rear &= ~pole
    pole &= ~sign
    return [road, sky, house, second, *windows, car, rear, pane, wheel, pole, sign, speck]


def wide_enough(things: Sequence[np.ndarray], along: int) -> list[np.ndarray]:
    """Those in which a square of the grid's spacing fits, so that a prompt meets them wherever the grid lies."""
    spacing = max(things[0].shape) / along
    return [thing for thing in things if cv2.erode(np.pad(thing, 1).astype(np.uint8), np.ones((int(spacing) + 1,) * 2)).any()]


@pytest.mark.parametrize("along", [16, pytest.param(32, marks=pytest.mark.slow)])
def test_everything_in_a_street_is_found_once(along: int) -> None:
    things = street()
    model = StandIn(things, 1.0)
    masks, large = found_by(model, along), wide_enough(things, along)
    assert len(large) >= 9
    assert compared(masks, large)[0] >= 0.95
    assert compared(masks, things)[1:] == (0, 0)  # nothing twice, and nothing that is not there
    assert model.asked < 0.8 * len(prompt_points(STREET, along))


def test_the_grid_is_as_dense_in_both_directions_and_comes_coarse_to_fine() -> None:
    points = prompt_points((300, 1200), 16)
    assert len(points) == len(np.unique(points, axis=0)) == 64
    assert points.min() == 37
    assert points.max(axis=0).tolist() == [1162, 262]
    gaps = [np.hypot(*(points[:n, None] - points[None, :n]).T)[~np.eye(n, dtype=bool)].min() for n in (2, 4, 16, 64)]
    assert gaps == [600, 300, 150, 75]
    assert len(prompt_points((50, 1200), 4)) == 4


def of(*rectangles: tuple[int, int, int, int], score: float = 0.9) -> Mask:
    mask = Mask.of(np.logical_xor.reduce([box(*corners, (100, 100)) for corners in rectangles]))
    assert mask is not None
    return Mask(mask.left, mask.top, mask.inside, score)


def test_of_the_same_thing_only_the_best_mask_is_kept() -> None:
    good, likely = of((10, 10, 60, 60), score=0.95), of((11, 10, 61, 60), score=0.9)
    assert without_duplicates([likely, good], 0.7) == [good]
    frame = of((10, 10, 60, 60), (15, 15, 55, 55), score=0.91)  # the same box, but not the same thing
    assert without_duplicates([good, frame], 0.7) == [good, frame]
    part = of((10, 10, 60, 40), score=0.99)
    assert without_duplicates([good, part], 0.7) == [part, good]
    spur = of((10, 10, 60, 60), (60, 20, 99, 21), score=0.9)  # another box, but the same thing
    assert without_duplicates([good, spur], 0.7) == [good]
    assert without_duplicates([], 0.7) == []


def test_specks_and_pinholes_are_removed() -> None:
    inside = box(10, 10, 70, 50, (60, 80))
    whole = inside.copy()
    inside[20:23, 20:23] = False  # a pinhole
    inside[30:40, 40:50] = whole[30:40, 40:50] = False  # a hole
    inside[2:4, 2:4] = True  # a speck
    inside[10:12, 10:12] = whole[10:12, 10:12] = False  # a corner is no hole
    assert np.array_equal(without_specks(inside, 4.0), whole)
    assert not without_specks(inside & False, 4.0).any()


def test_soft_boundaries_and_low_scores_are_dropped() -> None:
    u = np.arange(256, dtype=np.float32)
    logits = np.stack([np.tile(slope * (u - 128), (64, 1)) for slope in (1.0, 0.05, 1.0)])
    proposals = Proposals(logits, np.array([0.9, 0.9, 0.8], np.float32), (128, 512), (64.0, 256.0))
    kept = accepted_masks(proposals)
    assert [mask.box for mask in kept] == [(257, 0, 512, 128)]  # the boundary is half a logit, one pixel, behind its place
