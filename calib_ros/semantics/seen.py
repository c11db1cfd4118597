"""What semantics make of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OF_MASKS, OF_CLASSES = "masks", "classes"  # what edges may be of


@dataclass(frozen=True, eq=False)
class Seen:
    """Semantics of one frame, in the size of the image as recorded; None = not known.

    edges: (2, H, W) float32 in 0..1, boundaries of masks with horizontal [0] and vertical [1] gradients (their sum is the
    strength), or borders of classes; edges_of tells which. classes: (H, W) uint8 SemanticClass of pixels. labels: (n,) uint8
    SemanticClass per point of the frame's cloud. problems: one line for each model that failed. seconds: time taken, by kind
    of model.
    """

    edges: NDArray[np.float32] | None = None
    classes: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None
    problems: tuple[str, ...] = ()
    seconds: tuple[tuple[str, float], ...] = ()
    edges_of: str = OF_MASKS
