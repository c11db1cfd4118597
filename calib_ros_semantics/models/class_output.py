"""The output of a segmentation network: which output holds classes, in which layout, and reading it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calib_ros.errors import ModelError
from calib_ros.frame import SemanticClass
from calib_ros_semantics.models.labels import Classes, Names, resized, table_of
from calib_ros_semantics.models.onnx_model import Array, Deadline, OnnxModel
from calib_ros_semantics.models.tiles import enlarged

Size = tuple[int, int]
MAX_STRIDE = 64  # pixels of the input per cell of the output; 32 is the deepest stride in use
# Copies for borders and classes come on top; 1024x2048 with the 66 classes of Mapillary takes half of it.
MAX_OUTPUT_BYTES = 1_000_000_000
MAX_UPSAMPLING = 4  # cells of the output per pixel of the input; networks that upsample inside do so by 2 or 4


class ClassOutput:
    """The output of a network that holds classes, and the meaning of its class numbers. ModelError if there is none.

    example: inputs by name and their (height, width), to run the network on if its file does not declare sizes of outputs.
    by_count, by_number: see `labels.table_of`. conventions: known outputs, for the error. count: of classes; None = the output
    holds class numbers. is_pidnet: whether the network has the three of PIDNet.
    """

    def __init__(
        self,
        model: OnnxModel,
        example: tuple[Mapping[str, Array], Size],
        by_count: Mapping[int, Names],
        by_number: Mapping[str, Names],
        conventions: str,
    ) -> None:
        self._model, self._feeds, self._size = model, *example
        self._by_count, self._by_number, self._conventions = by_count, by_number, conventions
        self.count: int | None = None
        self._name, self.is_pidnet = "", False
        shapes = _declared(model, self._feeds)
        if shapes is not None:
            self._choose(shapes)

    def settle(self, deadline: Deadline) -> None:
        """Choose the output if that has not been done. Raises ModelError if none holds classes, BudgetError."""
        if not self._name:
            self._choose([out.shape for out in self._model.run(self._feeds, deadline)])

    def _choose(self, shapes: Sequence[tuple[int, ...]]) -> None:
        model, size, names = self._model, self._size, [t.name for t in self._model.outputs]
        layouts = [layout_of(shape, size) for shape in shapes]
        maps = {k: layout for k, layout in enumerate(layouts) if layout is not None}
        is_pidnet = not model.sidecar.output and _is_pidnet(model, maps, size)
        # The output of the YAML, else scores before class numbers, integers before a possible confidence.
        scores = [k for k, layout in maps.items() if layout.classes is not None]
        integers = [k for k in maps if np.issubdtype(model.outputs[k].dtype, np.integer)]
        asked = [names.index(model.sidecar.output)] if model.sidecar.output else scores or integers or maps
        at = 1 if is_pidnet else next(iter(asked), None)
        if at is None or at not in maps:
            sizes = ", ".join(f"{name} {_text(shape)}" for name, shape in zip(names, shapes, strict=True))
            none = f"none of its outputs is a map of classes for an input of {_text(size)} ({sizes})"
            raise model.error(f"{none}; known are {self._conventions}")
        taken = math.prod(shapes[at]) * np.dtype(model.outputs[at].dtype).itemsize
        if taken > MAX_OUTPUT_BYTES:
            fitting = _text([int(n * math.sqrt(MAX_OUTPUT_BYTES / taken)) // 32 * 32 for n in size])
            raise model.error(
                f"its output {names[at]}, {_text(shapes[at])}, takes {taken / 1e9:.1f} GB for an input of {_text(size)}, and at "
                f"most {MAX_OUTPUT_BYTES / 1e9:g} GB are taken; export it for {fitting} or less, without its last upsampling, or "
                "with its argmax inside"
            )
        self._table = table_of(model, maps[at].classes, self._by_count, self._by_number)
        if not self.known - {SemanticClass.OTHER}:
            raise model.error(
                "none of its classes is of use here: they are all other things, or unknown; name them by 'labels:' in "
                f"{model.yaml}, or take a network for streets"
            )
        self.count, self._name, self.is_pidnet = maps[at].classes, names[at], is_pidnet

    @property
    def text(self) -> str:
        """Name and kind, as text."""
        if not self._name:
            return "output known after its first run"
        if self.count is not None:
            return f"{self._name}: scores of {self.count} classes"
        guess = self._table.guess
        return f"{self._name}: class numbers" + (f", assumed to be {guess} without labels: in its YAML" if guess else "")

    @property
    def known(self) -> frozenset[int]:
        """The SemanticClasses that the network tells apart, once settled."""
        return self._table.known

    def values(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size) -> Array:
        """Scores (C, h, w), or class numbers (h, w) without a count, for inputs of a size (height, width), once settled."""
        found = self._model.run(feeds, deadline, [self._name])[0]
        layout = layout_of(found.shape, size)
        if layout is None or layout.classes != self.count:
            raise self._model.error(f"its output {self._name} has become {_text(found.shape)}")
        values = found.reshape(layout.shape)
        return values if layout.axis is None else np.moveaxis(values, layout.axis, 0)

    def classes(self, values: Array, size: Size) -> Classes:
        """Classes at a size (height, width) from `values`. ModelError for values that are not classes."""
        try:
            if self.count is not None:
                # Of the highest score, interpolated to the size first; -1 where all are NaN.
                highest, winner = np.full(size, -np.inf, np.float32), np.full(size, -1, np.int16)
                for number, score in enumerate(values):
                    plane = enlarged(score, size)  # cells cover equal parts of it, as in networks that do not align corners
                    better = plane > highest
                    np.copyto(highest, plane, where=better)
                    np.copyto(winner, np.int16(number), where=better)
                if winner.max() < 0:
                    raise ModelError("there is no number in it; float16 may have overflowed, export it as float32")
                return self._table.classes(winner)
            if values.dtype == np.bool_ or not np.isfinite(values).all() or (values != np.rint(values)).any():
                raise ModelError("it has one channel, but holds no class numbers: a network for a single class cannot be used")
            return resized(self._table.classes(values.astype(np.int64)), size)  # some exports give floats
        except ModelError as error:
            raise self._model.error(f"output {self._name}: {error}") from None

    def meaning(self) -> Classes:
        """SemanticClass (count,) of each score."""
        return self._table.classes(np.arange(self.count or 0))


class ClassMapLayout(NamedTuple):
    """Layout of classes in an array: shape without leading ones, axis of the scores (None = class numbers)."""

    shape: tuple[int, ...]
    axis: int | None

    @property
    def classes(self) -> int | None:
        """Number of classes, if known."""
        return None if self.axis is None else self.shape[self.axis]


def layout_of(shape: Sequence[int], size: Size) -> ClassMapLayout | None:
    """Layout of an output for an input of this size (height, width): (H, W), (C, H, W) or (H, W, C) after leading ones.

    H and W may be down to 1/64 of the input's, or up to 4 times as large. None if it is not a map of classes.
    """
    plain = tuple(shape)
    while len(plain) > 2 and plain[0] == 1:
        plain = plain[1:]
    if len(plain) == 3 and plain[2] == 1 and _is_part(plain[:2], size):
        plain = plain[:2]
    if len(plain) == 2:
        return ClassMapLayout(plain, None) if _is_part(plain, size) else None
    if len(plain) == 3:
        for axis, cells in ((0, plain[1:]), (2, plain[:2])):
            if plain[axis] > 1 and _is_part(cells, size):
                return ClassMapLayout(plain, axis)
    return None


def _is_part(cells: Sequence[int], size: Size) -> bool:
    """Whether rows and columns are those of the input, or of a coarser or finer grid over it."""
    finer = any(n > MAX_UPSAMPLING * own for n, own in zip(cells, size, strict=True))
    if min(cells) < 2 or finer or max(cells) * MAX_STRIDE < max(size):
        return False
    return abs(cells[0] - size[0] * cells[1] / size[1]) <= 1 or abs(cells[1] - size[1] * cells[0] / size[0]) <= 1


def _declared(model: OnnxModel, feeds: Mapping[str, Array]) -> list[tuple[int, ...]] | None:
    """Shapes of the outputs for these inputs, if the file declares them all."""
    taken = [t.shape[1:] if t.shape else (None,) for t in model.inputs if t.name in feeds]
    given = [(1, *t.shape[1:]) if len(t.shape) > 2 and t.shape[0] is None else t.shape or (None,) for t in model.outputs]
    known = [tuple(n for n in shape if n is not None) for shape in given]
    return None if any(None in shape for shape in taken) or known != given else known


def _is_pidnet(model: OnnxModel, maps: Mapping[int, ClassMapLayout], size: Size) -> bool:
    """Whether three outputs are those of PIDNet: two alike, at an eighth of the input unless enlarged, and boundaries."""
    if len(model.outputs) != 3 or not {0, 1} <= set(maps) or maps[0].classes is None or maps[0].shape != maps[1].shape:
        return False
    columns = [n for k, n in enumerate(maps[1].shape) if k != maps[1].axis][1]
    in_eighths = abs(size[1] / columns - 8) < 1
    boundaries = 2 in maps and maps[2].classes is None
    return in_eighths or boundaries or model.sidecar.family.lower() == "pidnet"


def _text(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))
