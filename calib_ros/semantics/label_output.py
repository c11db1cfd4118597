"""The output of a network that holds classes: which it is, how it is laid out, and reading it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.label_tables import table_of
from calib_ros.semantics.labels import Classes, Names
from calib_ros.semantics.onnx_model import Array, OnnxModel

Size = tuple[int, int]
COARSEST = 64  # pixels of the input per cell of the output; 32 is the deepest stride in use


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

    H and W may be parts of the input's. None if it is no map of classes.
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
    """Whether rows and columns are those of the input, or of a grid over it as of a network with strides."""
    if min(cells) < 1 or cells[0] > size[0] or cells[1] > size[1] or max(cells) * COARSEST < max(size):
        return False
    return abs(cells[0] - size[0] * cells[1] / size[1]) <= 1 or abs(cells[1] - size[1] * cells[0] / size[0]) <= 1


class ClassOutput:
    """The output of a network that counts, and what its numbers mean.

    feeds, size: an example of its inputs and their (height, width); it is run on them only if the file does not tell the sizes
    of its outputs. by_count, by_number: see label_tables. conventions: those known, for the error. ModelError if none of its
    outputs holds classes.
    """

    def __init__(
        self,
        model: OnnxModel,
        example: tuple[Mapping[str, Array], Size],
        by_count: Mapping[int, Names],
        by_number: Sequence[Names],
        conventions: str,
        deadline: Deadline,
    ) -> None:
        feeds, size = example
        shapes = _declared(model, feeds) or [out.shape for out in model.run(feeds, deadline)]
        layouts = [layout_of(shape, size) for shape in shapes]
        at = _chosen(model, layouts, size)
        layout = layouts[at] if at is not None else None
        if at is None or layout is None:
            sizes = ", ".join(f"{t.name} {'x'.join(map(str, s))}" for t, s in zip(model.outputs, shapes, strict=True))
            raise model.error(
                f"none of its outputs is a map of classes for an input of {size[0]}x{size[1]} ({sizes}); known are {conventions}"
            )
        self.count, self.name, self._model = layout.count, model.outputs[at].name, model
        self.is_pidnet = at == 1 and not model.sidecar.output
        self.table = table_of(model, self.count, by_count, by_number)

    @property
    def text(self) -> str:
        """For people."""
        return f"{self.name}: " + ("class numbers" if self.count is None else f"scores of {self.count} classes")

    def run(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size, wanted: Size) -> Classes:
        """Classes in the wanted size, of inputs of a size (height, width). ModelError, BudgetError."""
        found = self._model.run(feeds, deadline, [self.name])[0]
        layout = layout_of(found.shape, size)
        if layout is None or layout.count != self.count:
            raise self._model.error(f"its output {self.name} has become {'x'.join(map(str, found.shape))}")
        values = found.reshape(layout.shape)
        try:
            if layout.axis is not None:
                numbers = best(np.moveaxis(values, layout.axis, 0), wanted)
                return self.table.classes(numbers)
            return resized(self.table.classes(_whole(values)), wanted)
        except ModelError as error:
            raise self._model.error(f"output {self.name}: {error}") from None


def best(scores: NDArray[Any], size: Size) -> NDArray[np.int16]:
    """Number (H, W) of the class of highest score, scores (C, h, w); interpolated to the size first; -1 where all are NaN.

    Cells cover equal parts of the image, as networks place them that do not align corners.
    """
    highest, winner = np.full(size, -np.inf, np.float32), np.full(size, -1, np.int16)
    for number, score in enumerate(scores):
        plane = np.ascontiguousarray(score, np.float32)
        if plane.shape != size:
            plane = cv2.resize(plane, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
        better = plane > highest
        np.copyto(highest, plane, where=better)
        np.copyto(winner, np.int16(number), where=better)
    if winner.max() < 0:
        raise ModelError("there is no number in it; float16 may have overflowed, export it as float32")
    return winner


def resized(classes: Classes, size: Size) -> Classes:
    """Classes (h, w) in another size, each pixel that of the cell its centre lies in."""
    if classes.shape == size:
        return classes
    return np.asarray(cv2.resize(classes, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT), np.uint8)


def _whole(values: NDArray[Any]) -> NDArray[np.int64]:
    """Class numbers, which some exports give as floats."""
    if values.dtype == np.bool_ or not np.isfinite(values).all() or (values != np.rint(values)).any():
        raise ModelError("it has one channel, but holds no class numbers: a network for a single class cannot be used")
    return values.astype(np.int64)


def _declared(model: OnnxModel, feeds: Mapping[str, Array]) -> list[tuple[int, ...]] | None:
    """Shapes of the outputs for these inputs, if the file tells them all."""
    if any(None in t.shape[1:] or not t.shape for t in model.inputs if t.name in feeds):
        return None
    shapes = []
    for t in model.outputs:
        shape = (1, *t.shape[1:]) if len(t.shape) > 2 and t.shape[0] is None else t.shape
        sizes = tuple(n for n in shape if n is not None)
        if not shape or len(sizes) < len(shape):
            return None
        shapes.append(sizes)
    return shapes


def _chosen(model: OnnxModel, layouts: Sequence[Layout | None], size: Size) -> int | None:
    """Which output counts: that of the YAML; scores rather than numbers; the first, but of PIDNet's three the middle one."""
    names = [t.name for t in model.outputs]
    if model.sidecar.output:
        if model.sidecar.output not in names:
            raise model.error(f"there is no output '{model.sidecar.output}', which {model.path.with_suffix('.yaml')} asks for")
        return names.index(model.sidecar.output)
    maps = {k: layout for k, layout in enumerate(layouts) if layout is not None}
    scores = [k for k, layout in maps.items() if layout.count is not None]
    if 0 in scores and 1 in scores and len(names) == 3 and _is_pidnet(model, maps, size):
        return 1
    return next(iter(scores or maps), None)


def _is_pidnet(model: OnnxModel, maps: Mapping[int, Layout], size: Size) -> bool:
    """Whether three outputs are those of PIDNet: two alike, in an eighth of the input's size unless enlarged, and boundaries."""
    in_eighths = abs(size[1] / maps[1].cells[1] - 8) < 1
    boundaries = 2 in maps and maps[2].count is None
    return maps[0].shape == maps[1].shape and (in_eighths or boundaries or model.sidecar.family.lower() == "pidnet")
