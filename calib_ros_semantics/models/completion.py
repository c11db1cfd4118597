"""Dense depth by learning (thesis 5.3): an ONNX network from sparse depth and image, of this package or of a user."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros_semantics.models.image_classes import GREY_IMAGENET, IMAGENET, fitted
from calib_ros_semantics.models.onnx_model import Array, Deadline, Normalisation, OnnxModel, Tensor
from calib_ros_semantics.models.weight_sets import of_package

MORPHOLOGICAL, NETWORK = "morphological", "network"  # values of thesis.completion; others are files
CONVENTION = (
    "a completion network takes sparse depth 1x1xHxW, 0 where nothing was measured, and an image 1x1xHxW or 1x3xHxW of the same "
    "size, named so (depth, image), and gives dense depth 1x1xHxW or 1xHxW of that size"
)
NAMES = {
    "depth": re.compile("depth|sparse|lidar|velo", re.IGNORECASE),
    "image": re.compile("image|img|rgb|bgr|gr[ae]y", re.IGNORECASE),
}
MULTIPLE = 32  # px; sizes that a network of any size gets: its levels have to fit together
EXAMPLE = (64, 128)  # px; height and width to try it at
Depths = NDArray[np.float32]


def completion_file(choice: str) -> Path:
    """The ONNX file that a value of thesis.completion names."""
    return of_package("completion") if choice == NETWORK else Path(choice)


class CompletionModel:
    """A loaded completion network. ModelError if it fits no convention, or the YAML beside it does not say the unit of depth."""

    def __init__(self, path: str | Path, config: SemanticsConfig) -> None:
        self.model = model = OnnxModel(path, config)
        self.fallback = model.fallback
        if model.sidecar.depth_scale is None:
            raise model.error(
                f"a YAML beside it, {model.yaml.name}, must say 'depth_scale:', the units of its depths per metre: 1 for metres, "
                "256 for those of KITTI's files"
            )
        self._scale = np.float32(model.sidecar.depth_scale)
        self._depth, self._image = self._roles()
        channels = self._image.shape[1] or 3
        sizes = list(zip(model.size_of(self._depth, 1), model.size_of(self._image, 1), strict=True))
        if any(None not in (a, b) and a != b for a, b in sizes):
            raise model.error(f"its inputs differ in size; {CONVENTION}")
        self._size = sizes[0][0] or sizes[0][1], sizes[1][0] or sizes[1][1]
        as_it_is = np.issubdtype(self._image.dtype, np.integer)
        usual = Normalisation(1.0) if as_it_is else IMAGENET if channels == 3 else GREY_IMAGENET
        self._channels, self._normalised = channels, Normalisation.of(model, usual, channels)
        self._output = self._output_name()
        height, width = (own or n for own, n in zip(self._size, EXAMPLE, strict=True))
        self(np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8), Deadline(config.budget_s))

    def __call__(self, depth: Depths, image: NDArray[np.uint8], deadline: Deadline) -> Depths:
        """Dense depth (H, W) m, 0 = unknown, of sparse depth (H, W) m, 0 = not measured, and the image (H, W[, 3]) BGR.

        A network of a fixed size gets both stretched to it; others get them as they are, with a border below and to the right.
        """
        height, width = depth.shape
        stretched = self._size != (None, None)
        rows, columns = (own or -(-n // MULTIPLE) * MULTIPLE for own, n in zip(self._size, (height, width), strict=True))
        sparse = np.zeros((rows, columns), np.float32)
        v, u = np.nonzero(depth)
        far_first = np.argsort(-depth[v, u], kind="stable")
        v, u = v[far_first], u[far_first]
        sy, sx = (rows / height, columns / width) if stretched else (1.0, 1.0)
        sparse[(v * sy).astype(int), (u * sx).astype(int)] = depth[v, u] * self._scale
        dense = self._run(sparse, self._picture(image, (rows, columns), stretched), deadline)
        if stretched:
            dense = np.asarray(cv2.resize(dense, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        known: Depths = np.maximum(np.nan_to_num(dense[:height, :width] / self._scale, nan=0.0, posinf=0.0, neginf=0.0), 0)
        return known

    def describe(self) -> str:
        """Inputs and outputs, as text."""
        height, width = ("?" if n is None else n for n in self._size)
        order = "grey" if self._channels == 1 else "BGR" if self.model.sidecar.channels == "bgr" else "RGB"
        inputs = f"{width}x{height}, depth in 1/{self._scale:g} m, image {order}, fed as {self._normalised.text}"
        return f"completion network: {inputs} -> {self._output}, on {self.model.provider}"

    def _run(self, sparse: Depths, picture: Array, deadline: Deadline) -> Depths:
        feeds = {self._depth.name: sparse[None, None], self._image.name: picture}
        dense = self.model.run(feeds, deadline, [self._output])[0]
        if dense.shape not in ((1, 1, *sparse.shape), (1, *sparse.shape)):
            sizes = "x".join(map(str, dense.shape))
            raise self.model.error(f"for inputs of {sparse.shape[0]}x{sparse.shape[1]} it gives {sizes}; {CONVENTION}")
        return np.asarray(dense.reshape(sparse.shape), np.float32)

    def _picture(self, image: NDArray[np.uint8], size: tuple[int, int], stretched: bool) -> Array:
        """The image input (1, channels, rows, columns)."""
        is_bgr = self.model.sidecar.channels == "bgr"
        if image.ndim == 3 and not (self._channels == 3 and is_bgr):
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if self._channels == 1 else cv2.COLOR_BGR2RGB), np.uint8)
        elif image.ndim == 2 and self._channels == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if stretched:
            image = fitted(image, size)
        else:
            below, right = (n - have for n, have in zip(size, image.shape, strict=False))
            image = np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE), np.uint8)
        values = self._normalised(image.reshape(*size, self._channels).astype(np.float32))
        return np.ascontiguousarray(np.moveaxis(values, -1, 0)[None])

    def _roles(self) -> tuple[Tensor, Tensor]:
        """The inputs of depth and image, by their names, else by their channels."""
        inputs = [t for t in self.model.inputs if len(t.shape) == 4 and t.shape[0] in (None, 1) and t.shape[1] in (1, 3)]
        if len(inputs) != 2 or len(self.model.inputs) != 2:
            raise self.model.error(CONVENTION)
        named = [[t for t in inputs if NAMES[role].search(t.name)] for role in ("depth", "image")]
        if any(len(found) != 1 for found in named) or named[0] == named[1]:
            named = [[t for t in inputs if t.shape[1] == n] for n in (1, 3)]
        if any(len(found) != 1 for found in named) or named[0][0].shape[1] != 1:
            raise self.model.error(f"which input is the depth and which the image cannot be told; {CONVENTION}")
        return named[0][0], named[1][0]

    def _output_name(self) -> str:
        """The output that holds the depth: the only one, or that which the YAML names."""
        names, own = [t.name for t in self.model.outputs], self.model.sidecar.output
        if own and own not in names:
            raise self.model.error(f"it has no output '{own}', which 'output:' of {self.model.yaml.name} names")
        if not own and len(names) != 1:
            raise self.model.error(f"which output is the dense depth? Name it by 'output:' in {self.model.yaml.name}")
        return own or names[0]
