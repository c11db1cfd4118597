"""The ring buffer of keyframes, and what estimates rest on which of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from calib_ros.registration.features import Features


class KeyframeBuffer:
    """Features of the newest keyframes. Not thread-safe: its owner holds a lock.

    features: oldest first. seen: keyframes so far. new: those since the last estimate. fresh: those that no estimate rests on
    that was taken in. generation: rises when the keyframes are of a new beginning, so that what was made of the old ones is
    void. gone: keyframes that the extrinsic in force rests on have left.
    """

    def __init__(self, size: int) -> None:
        self.features: deque[Features] = deque(maxlen=size)
        self.seen = self.new = self.fresh = self.generation = 0
        self.gone = False

    def __len__(self) -> int:
        return len(self.features)

    def add(self, features: Features, keep: Callable[[Features], bool] = lambda features: False) -> None:
        """A new keyframe; if there is no room the oldest leaves, or the oldest that is not to be kept if there is one."""
        if len(self.features) == self.features.maxlen:
            self.gone = True
            given_up = next((k for k, f in enumerate(self.features) if not keep(f)), 0)
            del self.features[given_up]
        self.features.append(features)
        self.new += 1
        self.fresh += 1
        self.seen += 1

    def exchange(self, before: Features, after: Features) -> None:
        """Other features of the same keyframe, if it has not left meanwhile."""
        self.features = deque((after if f is before else f for f in self.features), self.features.maxlen)

    def keep_newest(self, count: int) -> None:
        """The extrinsic has changed: only the newest keyframes are of the one that holds now."""
        self.generation += 1
        self.features = deque(list(self.features)[-count:], self.features.maxlen)
        self.new = self.fresh = len(self.features)
        self.gone = False

    def cut_out(self, since: int, count: int) -> None:
        """Take `count` keyframes out, of which the first is the since-th newest."""
        kept = list(self.features)
        del kept[len(kept) - since : len(kept) - since + count]
        self.features = deque(kept, self.features.maxlen)

    def resize(self, size: int) -> None:
        """Room for so many; the oldest leave if there are more."""
        self.features = deque(self.features, size)

    def forget(self) -> None:
        """All of them, and what was estimated from them."""
        self.generation += 1
        self.features.clear()
        self.new = self.fresh = 0
        self.gone = True
