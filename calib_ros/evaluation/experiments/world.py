"""What a worker keeps between jobs: open sources, frames, and the features that methods made of them."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets import Source
from calib_ros.datasets.with_motion import WithMotion
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.evaluation.experiments.setup import Setup
from calib_ros.evaluation.methods.method import Method
from calib_ros.evaluation.methods.registry import methods
from calib_ros.frame import Frame

Matrix = NDArray[np.float64]
FRAMES, FEATURES = 12, 24  # kept: 4 MB for a KITTI frame, and up to 20 MB for its features
T = TypeVar("T")


class SourceGoneError(BadInputError):
    """A frame that was there cannot be read."""


# Errors that say nothing of a method: an evaluation stops, and goes on when they are mended.
NOT_THE_METHODS = (SourceGoneError, MissingDependencyError)


class World:
    """Opens and computes what jobs ask for, each once while it is remembered. tell: called with lines for a person."""

    def __init__(self, setup: Setup, tell: Callable[[str], None] | None = None) -> None:
        self.setup, self.config, self._tell = setup, setup.config, tell
        self.methods: dict[str, Method] = methods(setup.config)
        self._warm: set[str] = set()
        self._sources: dict[str, Source] = {}
        self._frames: OrderedDict[Hashable, Frame] = OrderedDict()
        self._features: OrderedDict[Hashable, tuple[Any, float]] = OrderedDict()

    def source(self, label: str) -> Source:
        """The source of a scene."""
        if label not in self._sources:
            self._sources[label] = WithMotion(self.setup.scene(label).open(), self.config.motion, self._tell)
        return self._sources[label]

    def frame(self, label: str, position: int) -> Frame:
        """A frame of a scene. SourceGoneError if it cannot be read."""

        def read() -> Frame:
            try:
                return self.source(label)[position]
            except CalibrationError as error:
                raise SourceGoneError(str(error)) from error

        return _remembered(self._frames, (label, position), FRAMES, read)

    def reference(self, label: str, position: int) -> Matrix:
        """T_camera_lidar (4, 4) that counts as true for a frame. BadInputError if there is none."""
        own = self.setup.scene(label).reference
        if own:
            return np.array(own)
        stated = self.frame(label, position).reference
        stated = self.source(label).reference if stated is None else stated
        if stated is None:
            raise BadInputError(f"{label} states no reference extrinsic to compare with; give one by --reference FILE")
        return stated

    def features(self, method: str, label: str, position: int) -> tuple[Any, float]:
        """A method's features of a frame, and the CPU seconds that they took when they were made."""

        def make() -> tuple[Any, float]:
            frame = self.frame(label, position)
            if method not in self._warm:  # the first frame would pay for imports and look-up tables
                self._warm.add(method)
                self.methods[method].features(frame)
            started = time.process_time()
            made = self.methods[method].features(frame)
            return made, time.process_time() - started

        return _remembered(self._features, (method, label, position), FEATURES, make)


def _remembered(memory: OrderedDict[Hashable, T], key: Hashable, limit: int, make: Callable[[], T]) -> T:
    if key not in memory:
        memory[key] = make()
        while len(memory) > limit:
            memory.popitem(last=False)
    memory.move_to_end(key)
    return memory[key]


@lru_cache(maxsize=1)
def world(setup: Setup) -> World:
    """The world of this process; that of another setup is forgotten."""
    return World(setup)
