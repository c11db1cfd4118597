"""Masks of one picture, each kept within its own box: a hundred masks of a large picture would not fit otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import Frame
from calib_ros.semantics.deadline import Deadline

Pixels = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Mask:
    """Which pixels belong to something.

    left, top: pixel where its box begins. inside: (h, w) bool, the pixels of the box, not empty. score: 0..1, how good
    the model thinks it is. stability: 0..1, how little it changes with its threshold; 1 where nobody can tell.
    """

    left: int
    top: int
    inside: Pixels
    score: float = 1.0
    stability: float = 1.0

    @staticmethod
    def of(picture: Pixels, corner: tuple[int, int] = (0, 0)) -> Mask | None:
        """From pixels (h, w), of which the first is the column and row `corner` of the image; None if none of them is inside."""
        rows, columns = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
        if len(rows) == 0:
            return None
        top, left = int(rows[0]), int(columns[0])
        inside = picture[top : rows[-1] + 1, left : columns[-1] + 1]
        return Mask(corner[0] + left, corner[1] + top, inside.copy())

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom; the last two lie one pixel behind it."""
        height, width = self.inside.shape
        return self.left, self.top, self.left + width, self.top + height

    @cached_property
    def area(self) -> int:
        """Number of pixels."""
        return int(np.count_nonzero(self.inside))

    def covers(self, u: float, v: float) -> bool:
        """Whether the pixel at (u, v), column and row, is inside."""
        x, y = int(u) - self.left, int(v) - self.top
        height, width = self.inside.shape
        return 0 <= x < width and 0 <= y < height and bool(self.inside[y, x])

    def common(self, other: Mask) -> int:
        """Number of pixels in both."""
        left, top, right, bottom = self.box
        left2, top2, right2, bottom2 = other.box
        x, y, x2, y2 = max(left, left2), max(top, top2), min(right, right2), min(bottom, bottom2)
        if x >= x2 or y >= y2:
            return 0
        own = self.inside[y - top : y2 - top, x - left : x2 - left]
        return int(np.count_nonzero(own & other.inside[y - top2 : y2 - top2, x - left2 : x2 - left2]))


@dataclass(frozen=True, eq=False)
class Masks:
    """Masks of a picture of `size` (height, width). They may overlap, nest, and leave pixels without any."""

    size: tuple[int, int]
    masks: tuple[Mask, ...]

    @staticmethod
    def of(size: tuple[int, int], masks: Iterable[Mask | None]) -> Masks:
        """Without those that are None."""
        return Masks(size, tuple(mask for mask in masks if mask is not None))

    def __len__(self) -> int:
        return len(self.masks)

    @property
    def score(self) -> NDArray[np.float32]:
        """Scores (k,) of the masks."""
        return np.array([mask.score for mask in self.masks], np.float32)

    def picture(self, number: int) -> Pixels:
        """One of them as all pixels (H, W) bool of the image."""
        mask, out = self.masks[number], np.zeros(self.size, bool)
        left, top, right, bottom = mask.box
        out[top:bottom, left:right] = mask.inside
        return out


# Whatever gives the masks of a frame, in the size of its image. ModelError if it fails, BudgetError when the time is up.
Segmenter = Callable[[Frame, Deadline], Masks]
