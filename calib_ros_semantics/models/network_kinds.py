"""What kind of network a graph is, by the shapes of its tensors: for messages about a file that is named in the wrong place."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from calib_ros_semantics.models.labels import OF_IMAGES
from calib_ros_semantics.models.onnx_model import OnnxModel, Tensor

EMBEDDING = 256  # channels of the embedding, in all families of Segment Anything
# Numbers per cell or box for COCO's 80 classes, with and without confidence, and of three boxes; and of boxes after NMS.
OF_BOXES, OF_NMS = (84, 85, 255), 6
BOX = 4
MIN_BOXES = 100  # candidates per picture
MIN_SIDE = 8  # of a map


class NetworkKind(Enum):
    """Kinds of networks; the value is what a message calls them."""

    CLASSES = "a network for classes of pixels, for semantics.image_classes"
    ENCODER = "the encoder of Segment Anything, for semantics.segment_anything"
    FAST_SAM = "FastSAM, for semantics.segment_anything"
    DETECTOR = "a detector of boxes, which is of no use here"
    CLASSIFIER = "a classifier of whole pictures, which is of no use here"
    OTHER = "another network"


def kind_of(model: OnnxModel) -> NetworkKind:
    """Kind of a graph that takes one picture; OTHER where its outputs do not tell."""
    floats = [t for t in model.outputs if not np.issubdtype(t.dtype, np.integer)]
    maps = [t for t in floats if len(t.shape) == 4 and t.shape[2:] != (1, 1)]
    tables = [t for t in floats if len(t.shape) == 3]
    if any(map(_holds_scores, maps)) or any(map(_holds_numbers, model.outputs)):
        return NetworkKind.CLASSES
    if any(t.shape[1] == EMBEDDING for t in maps):
        return NetworkKind.ENCODER
    if _are_heads(maps) or any(map(_is_of_boxes, floats)):
        return NetworkKind.DETECTOR
    if maps and any(_lists(t, MIN_BOXES) for t in tables):
        return NetworkKind.FAST_SAM
    return NetworkKind.CLASSIFIER if all(map(_is_of_whole, model.outputs)) else NetworkKind.OTHER


def _holds_scores(tensor: Tensor) -> bool:
    """Whether a map (1, c, h, w) or (1, h, w, c) has as many channels as a dataset of streets has classes."""
    _, first, width, last = tensor.shape
    return first in OF_IMAGES or (last in OF_IMAGES and (width is None or width > (last or 0)))


def _holds_numbers(tensor: Tensor) -> bool:
    """Whether an output holds a class number for each pixel: integers over rows and columns."""
    whole = np.issubdtype(tensor.dtype, np.integer) and len(tensor.shape) >= 2
    return whole and all(n is None or n >= MIN_SIDE for n in tensor.shape[-2:])


def _is_of_whole(tensor: Tensor) -> bool:
    """Whether an output holds one score per class for the whole picture: (n, c), or (n, c, 1, 1)."""
    return len(tensor.shape) in (2, 4) and tensor.shape[0] in (1, None) and all(n == 1 for n in tensor.shape[2:])


def _are_heads(maps: Sequence[Tensor]) -> bool:
    """Whether maps are the heads of a detector: as many channels at several strides, or those of COCO's boxes."""
    if not maps or any(t.shape[1] is None for t in maps):
        return False
    sizes = {t.shape[2:] for t in maps}
    alike = len({t.shape[1] for t in maps}) == 1 and len(sizes) == len(maps) > 1
    return alike or all(t.shape[1] in OF_BOXES for t in maps)


def _is_of_boxes(tensor: Tensor) -> bool:
    """Whether an output holds boxes: heads apart by anchor, corners alone, or a table of candidates without coefficients."""
    if len(tensor.shape) == 5:
        return True
    if len(tensor.shape) in (2, 3) and tensor.shape[-1] == BOX:
        return True
    return _lists(tensor, MIN_BOXES) and any(n in (*OF_BOXES, OF_NMS) for n in tensor.shape[1:])


def _lists(tensor: Tensor, least: int) -> bool:
    """Whether an output (1, a, b) lists at least so many candidates with their numbers, in either order."""
    sizes = [n for n in tensor.shape[1:] if n is not None]
    return len(tensor.shape) == 3 and len(sizes) == 2 and max(sizes) >= max(least, 2 * min(sizes))
