"""The output of a network that holds classes: which it is, and reading it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.label_layout import Layout, Size, layout_of
from calib_ros.semantics.label_tables import table_of
from calib_ros.semantics.labels import Classes, Names
from calib_ros.semantics.onnx_model import Array, OnnxModel


class ClassOutput:
    """The output of a network that counts, and what its numbers mean.

    feeds, size: an example of its inputs and their (height, width); if the file does not tell the sizes of its outputs, settle()
    runs it on them. by_count, by_number: see label_tables. conventions: those known, for the error. ModelError if none of its
    outputs holds classes.

    count: number of classes, None = it gives their numbers. name: that of the output, empty until it is settled. is_pidnet:
    it has the three outputs of PIDNet.
    """

    def __init__(
        self,
        model: OnnxModel,
        example: tuple[Mapping[str, Array], Size],
        by_count: Mapping[int, Names],
        by_number: Mapping[str, Names],
        conventions: str,
    ) -> None:
        asked = model.sidecar.output
        if asked and asked not in [t.name for t in model.outputs]:
            raise model.error(f"there is no output '{asked}', which {model.path.with_suffix('.yaml')} asks for")
        self._model, self._feeds, self._size = model, *example
        self._by_count, self._by_number, self._conventions = by_count, by_number, conventions
        self.count: int | None = None
        self.name, self.is_pidnet = "", False
        shapes = _declared(model, self._feeds)
        if shapes is not None:
            self._choose(shapes)

    def settle(self, deadline: Deadline) -> None:
        """Chooses the output if that has not been done. ModelError if none holds classes; BudgetError."""
        if not self.name:
            self._choose([out.shape for out in self._model.run(self._feeds, deadline)])

    def _choose(self, shapes: Sequence[tuple[int, ...]]) -> None:
        model, size = self._model, self._size
        layouts = [layout_of(shape, size) for shape in shapes]
        maps = {k: layout for k, layout in enumerate(layouts) if layout is not None}
        is_pidnet = not model.sidecar.output and _is_pidnet(model, maps, size)
        at = 1 if is_pidnet else _chosen(model, maps)
        if at is None:
            sizes = ", ".join(f"{t.name} {'x'.join(map(str, s))}" for t, s in zip(model.outputs, shapes, strict=True))
            raise model.error(
                f"none of its outputs is a map of classes for an input of {size[0]}x{size[1]} ({sizes}); known are "
                f"{self._conventions}"
            )
        self._table = table_of(model, maps[at].count, self._by_count, self._by_number)
        self.count, self.name, self.is_pidnet = maps[at].count, model.outputs[at].name, is_pidnet

    @property
    def text(self) -> str:
        """For people."""
        if not self.name:
            return "what it gives is seen in its first run"
        if self.count is not None:
            return f"{self.name}: scores of {self.count} classes"
        guess = self._table.guess
        return f"{self.name}: class numbers" + (f", read as {guess} until told otherwise by labels:" if guess else "")

    def run(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size, wanted: Size) -> Classes:
        """Classes in the wanted size, of inputs of a size (height, width), once it is settled. ModelError, BudgetError."""
        return self.classes(self.values(feeds, deadline, size), wanted)

    def values(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size) -> Array:
        """Scores (C, h, w), or numbers (h, w) if there is no count, of inputs of a size (height, width), once it is settled.

        ModelError, BudgetError.
        """
        found = self._model.run(feeds, deadline, [self.name])[0]
        layout = layout_of(found.shape, size)
        if layout is None or layout.count != self.count:
            raise self._model.error(f"its output {self.name} has become {'x'.join(map(str, found.shape))}")
        values = found.reshape(layout.shape)
        return values if layout.axis is None else np.moveaxis(values, layout.axis, 0)

    def classes(self, values: Array, wanted: Size) -> Classes:
        """Classes in the wanted size (height, width) of what values() gave. ModelError for what are no classes."""
        try:
            if self.count is not None:
                return self._table.classes(best(values, wanted))
            return resized(self._table.classes(_whole(values)), wanted)
        except ModelError as error:
            raise self._model.error(f"output {self.name}: {error}") from None

    def meaning(self) -> Classes:
        """SemanticClass (count,) of each score."""
        return self._table.classes(np.arange(self.count or 0))


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


def _chosen(model: OnnxModel, maps: Mapping[int, Layout]) -> int | None:
    """Which output counts: that of the YAML; scores rather than numbers, integers rather than what may be a confidence."""
    if model.sidecar.output:
        at = [t.name for t in model.outputs].index(model.sidecar.output)
        return at if at in maps else None
    scores = [k for k, layout in maps.items() if layout.count is not None]
    integers = [k for k in maps if np.issubdtype(model.outputs[k].dtype, np.integer)]
    return next(iter(scores or integers or maps), None)


def _is_pidnet(model: OnnxModel, maps: Mapping[int, Layout], size: Size) -> bool:
    """Whether three outputs are those of PIDNet: two alike, in an eighth of the input's size unless enlarged, and boundaries.

    The middle one counts.
    """
    if len(model.outputs) != 3 or not {0, 1} <= set(maps) or maps[0].count is None or maps[0].shape != maps[1].shape:
        return False
    in_eighths = abs(size[1] / maps[1].cells[1] - 8) < 1
    boundaries = 2 in maps and maps[2].count is None
    return in_eighths or boundaries or model.sidecar.family.lower() == "pidnet"
