"""Automatic mask generation: every object of a known scene is found once."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from masks_of_pictures import box as rectangle
from masks_of_pictures import compared, later

from calib_ros_semantics.models.masks import Mask, Proposals, accepted_masks, without_duplicates, without_specks
from calib_ros_semantics.models.segment_anything import everything, prompt_points

SIZE = (376, 1240)
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


def box(*corners: int) -> np.ndarray:
    return rectangle(*corners, SIZE)


def street() -> list[np.ndarray]:
    """Things in a street; what is in front takes away from what is behind, and parts lie within wholes."""
    road, sky = box(0, 230, 1240, 376), box(0, 0, 1240, 90)
    house, second = box(0, 90, 420, 230), box(760, 40, 1240, 260)
    car, rear, pole, sign = box(480, 190, 700, 330), box(640, 170, 850, 290), box(930, 10, 940, 340), box(900, 15, 975, 95)
    windows = [box(left, 110, left + 90, 200) for left in (20, 150, 300)]
    pane, wheel, speck = box(500, 195, 640, 240), box(500, 280, 560, 330), box(200, 300, 206, 306)
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
    assert model.asked < 0.8 * len(prompt_points(SIZE, along))


def test_the_grid_is_as_dense_in_both_directions_and_comes_coarse_to_fine() -> None:
    points = prompt_points((300, 1200), 16)
    assert len(points) == len(np.unique(points, axis=0)) == 64
    assert points.min() == 37
    assert points.max(axis=0).tolist() == [1162, 262]
    gaps = [np.hypot(*(points[:n, None] - points[None, :n]).T)[~np.eye(n, dtype=bool)].min() for n in (2, 4, 16, 64)]
    assert gaps == [600, 300, 150, 75]
    assert len(prompt_points((50, 1200), 4)) == 4


def of(*rectangles: tuple[int, int, int, int], score: float = 0.9) -> Mask:
    mask = Mask.of(np.logical_xor.reduce([rectangle(*corners, (100, 100)) for corners in rectangles]))
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
    inside = rectangle(10, 10, 70, 50, (60, 80))
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
