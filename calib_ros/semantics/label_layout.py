"""How classes stand in an array that a network gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Size = tuple[int, int]
COARSEST = 64  # pixels of the input per cell of the output; 32 is the deepest stride in use
FINEST = 4  # cells of the output per pixel of the input; networks that enlarge inside do so by 2 or 4


@dataclass(frozen=True)
class Layout:
    """How classes stand in an array: shape without leading ones, axis of the scores; None = it holds class numbers."""

    shape: tuple[int, ...]
    axis: int | None

    @property
    def count(self) -> int | None:
        """Number of classes, where it can be told."""
        return None if self.axis is None else self.shape[self.axis]

    @property
    def cells(self) -> Size:
        """Rows and columns."""
        rows, columns = (n for k, n in enumerate(self.shape) if k != self.axis)
        return rows, columns


def layout_of(shape: Sequence[int], size: Size) -> Layout | None:
    """Layout of an output for an input of this size (height, width): (H, W), (C, H, W) or (H, W, C), with ones in front.

    H and W may be parts of the input's, or up to 4 times as large. None if it is no map of classes.
    """
    plain = tuple(shape)
    while len(plain) > 2 and plain[0] == 1:
        plain = plain[1:]
    if len(plain) == 3 and plain[2] == 1 and _is_part(plain[:2], size):
        plain = plain[:2]
    if len(plain) == 2:
        return Layout(plain, None) if _is_part(plain, size) else None
    if len(plain) == 3:
        for axis, cells in ((0, plain[1:]), (2, plain[:2])):
            if plain[axis] > 1 and _is_part(cells, size):
                return Layout(plain, axis)
    return None


def _is_part(cells: Sequence[int], size: Size) -> bool:
    """Whether rows and columns are those of the input, or of a grid over it, coarser by strides or finer."""
    if min(cells) < 1 or cells[0] > FINEST * size[0] or cells[1] > FINEST * size[1] or max(cells) * COARSEST < max(size):
        return False
    return abs(cells[0] - size[0] * cells[1] / size[1]) <= 1 or abs(cells[1] - size[1] * cells[0] / size[0]) <= 1
