"""Density completion by learning (thesis 5.3) in place of eq. 3.11: the network of `thesis.completion` on one frame's maps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ConfigError, MissingDependencyError, ModelError

if TYPE_CHECKING:
    from calib_ros_semantics.models.completion import CompletionModel

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FrameCompletion:
    """The network with the image of a frame. image: (h, w[, 3]) of the maps' camera. It is loaded where it is used, once."""

    choice: str
    semantics: SemanticsConfig
    image: NDArray[np.uint8]

    def __call__(self, pixels: NDArray[np.intp], depth: Floats) -> Floats:
        """Dense depth (h, w) m, 0 = unknown, of the depths (n,) at flat pixels (n,). Those on the ground count too: networks are
        trained on whole scans. Raises ModelError, BudgetError."""
        from calib_ros_semantics.models.onnx_model import Deadline

        shape = self.image.shape[:2]
        sparse = np.zeros(shape[0] * shape[1], np.float32)
        sparse[pixels] = depth
        return _model(self.choice, self.semantics)(sparse.reshape(shape), self.image, Deadline(self.semantics.budget_s))


def check_completion(choice: str, semantics: SemanticsConfig) -> None:
    """ConfigError for a network that cannot be loaded, or is no completion network."""
    try:
        _model(choice, semantics)
    except (ModelError, MissingDependencyError) as error:
        hint = "" if choice == "network" or choice.endswith(".onnx") else " (morphological, network, or an ONNX file)"
        raise ConfigError(f"thesis.completion{hint}: {error}") from None


def _model(choice: str, semantics: SemanticsConfig) -> CompletionModel:
    try:
        from calib_ros_semantics.models.completion import completion_file
    except ImportError:
        raise MissingDependencyError("completion networks need the package calib_ros_semantics; install it") from None
    path = completion_file(choice)
    state = path.stat() if path.is_file() else None
    return _loaded(str(path), semantics, None if state is None else (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=2)
def _loaded(path: str, semantics: SemanticsConfig, state: tuple[int, ...] | None) -> CompletionModel:
    """The model of a file, as long as it does not change."""
    from calib_ros_semantics.models.completion import CompletionModel

    return CompletionModel(path, semantics)
