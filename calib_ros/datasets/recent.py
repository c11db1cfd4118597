"""What sensors measured, read when it is asked for, and kept while it is among the newest."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


class Recent:
    """The `count` newest values by key, each made once, whichever thread asks first; 0 keeps none. Thread-safe. What it returns
    is shared: not to be written to."""

    def __init__(self, count: int) -> None:
        self._count, self._lock = count, threading.Lock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def __call__(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of a key, made if it is not kept. Raises what making raises."""
        if not self._count:
            return make()
        with self._lock:  # whoever else asks meanwhile mostly wants the same
            value: T = self._kept[key] if key in self._kept else make()
            self._kept[key] = value
            self._kept.move_to_end(key)
            while len(self._kept) > self._count:
                self._kept.popitem(last=False)
            return value


class Timed(Sequence[tuple[int, Any]]):
    """What a sensor measured, with its stamps, ns (n,): read when asked for."""

    def __init__(self, stamps: NDArray[np.int64], read: Callable[[int], Any]) -> None:
        self.stamps, self._read = stamps, read

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        return int(self.stamps[index]), self._read(index)
