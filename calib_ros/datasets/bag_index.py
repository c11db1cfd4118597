"""Where the messages of a bag are, by topic and time, with what its cameras and static transforms say."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS
from calib_ros.stamps import LONGEST_QUEUE_S, Stamps, cause_of_difference, time_scales

Span = tuple[int, int]  # [start, stop) of recording times, ns
MAX_KEPT = 256 * 2**20  # bytes of messages held in memory: thirty frames of 2 Mpx in colour with their clouds
AUTO, HEADER, RECORDING = CLOCKS = "auto", "header", "recording"
MAX_LATENCY = NANOSECONDS  # usually, from a sensor to the recorder
QUICKEST = 0.9


class BagListing:
    """When the messages of some topics were stamped and recorded, with what CameraInfo says, and static transforms. Nothing is
    read before `read` or `read_spans`; the messages of the latter are kept, up to MAX_KEPT.

    found: by topic, before `TopicIndex.finish`. infos: of the topics of CameraInfo, a message for each, the same where they say
    the same. transforms: messages with their time of recording, ns. kept: by topic, time of recording and stamp.
    """

    def __init__(self, bag: BagFile, topics: Iterable[str], infos: Iterable[str]) -> None:
        self.bag = bag
        self.infos: dict[str, list[bytes]] = {topic: [] for topic in infos}
        self.found = {topic: TopicIndex(topic) for topic in (*topics, *self.infos)}
        self.transforms: list[tuple[int, Any]] = []
        self.kept: dict[tuple[str, int, int], bytes] | None = None
        self._contents: dict[bytes, bytes] = {}
        self._kept_bytes = 0

    def read(self, keep: bool = False) -> None:
        """Read the whole bag once. keep: hold messages in memory, as `read_spans` does."""
        if keep:
            self.kept = {}
        statics = self.bag.statics
        topics, whole = [*self.found, *statics], [*self.infos, *statics]
        for topic, recorded, data in self.bag.raw(topics) if keep else self.bag.heads(topics, whole):
            if topic in statics:
                self.transforms.append((recorded, self.bag.decode(topic, data)))
            else:
                self._add(topic, recorded, data)
        self.transforms.sort(key=lambda one: one[0])

    def read_spans(self, spans: list[Span]) -> None:
        """Read only what was recorded in these spans, which neither overlap nor have been read; CameraInfo also around them,
        where it is rarer, and all static transforms."""
        self.kept = self.kept or {}
        periods = {topic: self.bag.period(topic) for topic in self.infos}
        for start, stop in spans:
            rare = [topic for topic, period in periods.items() if period > (stop - start) / 2]
            for message in self.bag.raw([topic for topic in self.found if topic not in rare], start, stop):
                self._add(*message)
            for topic in rare:
                for message in self.bag.raw([topic], start - periods[topic], stop + periods[topic]):
                    self._add(*message)
        self.transforms = self.transforms or self.bag.transforms()

    def _add(self, topic: str, recorded: int, data: bytes) -> None:
        with located(self.bag.path, topic):
            header = self.found[topic].add(recorded, data)
        if topic in self.infos:  # all but the stamp is nearly always the same
            self.infos[topic].append(self._contents.setdefault(bytes(data[12:]), data))
        elif self.kept is not None and self._kept_bytes + len(data) <= MAX_KEPT:
            self.kept[topic, recorded, header] = data
            self._kept_bytes += len(data)


class TopicIndex:
    """Where the messages of one topic are. After `finish`, sorted by stamp, in ns: stamps (n,), headers (n,) of the headers,
    recorded (n,) recording times."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame = ""
        self._found: list[tuple[int, int]] = []  # stamp of the header, recording time

    def add(self, recorded: int, data: bytes) -> int:
        """Add a message by its header; returns its stamp."""
        if len(data) < 16:
            raise BadInputError(f"a message has only {len(data)} bytes; record the bag again")
        header, frame = peek_header(data)
        self.frame = self.frame or frame
        self._found.append((header, recorded))
        return header

    def key(self, position: int) -> tuple[str, int, int]:
        """Topic, time of recording and stamp of a message, ns."""
        return self.topic, int(self.recorded[position]), int(self.headers[position])

    def leave_out(self, until: int) -> int:
        """Leave out what was recorded before a time, ns; returns how many."""
        before = len(self._found)
        self._found = [one for one in self._found if one[1] >= until]
        return before - len(self._found)

    def __len__(self) -> int:
        return len(self._found)

    @property
    def has_stamps(self) -> bool:
        """Whether any header has a stamp; drivers without a clock leave zeros."""
        return any(header for header, _ in self._found)

    def finish(self, use_headers: bool) -> None:
        """Sort by stamp: that of the header, or the recording time."""
        headers, recorded = np.array(self._found, np.int64).reshape(-1, 2).T
        stamps = headers if use_headers else recorded
        self.order = np.argsort(stamps, kind="stable")
        self.stamps: Stamps = stamps[self.order]
        self.headers: Stamps = headers[self.order]
        self.recorded: Stamps = recorded[self.order]


def clock_difference(image: TopicIndex, cloud: TopicIndex) -> tuple[int, bool]:
    """How far clouds are stamped ahead of images that were recorded at the same time, ns, 0 up to MAX_LATENCY; and whether that
    is a difference of the clocks, or may as well be messages that waited. Whole seconds where it is one of time scales."""
    if not len(image) or not len(cloud):
        return 0, False
    start, stop = max(image.recorded.min(), cloud.recorded.min()), min(image.recorded.max(), cloud.recorded.max())
    # Recorded at the same time, since not every recorder keeps to real time.
    ahead_of = [(i.headers - i.recorded)[(start <= i.recorded) & (i.recorded <= stop)] for i in (cloud, image)]
    if not all(map(len, ahead_of)):
        return 0, False
    # Of the quickest messages, but for a few with wrong stamps.
    of_clouds, of_images = (int(np.quantile(own, QUICKEST, method="lower")) for own in ahead_of)
    ahead = of_clouds - of_images
    known = time_scales(ahead / NANOSECONDS)
    if known is not None:
        return int(np.copysign(known[0], ahead)) * NANOSECONDS, True
    if abs(ahead) <= MAX_LATENCY:
        return 0, False
    # Only a clock stamps messages before they come, and no queue is that long.
    return ahead, max(of_clouds, of_images) > abs(ahead) / 2 or abs(ahead) > LONGEST_QUEUE_S * NANOSECONDS


def difference_in_words(ahead: int, of_clocks: bool) -> str:
    """What `clock_difference` found, its likely cause, and what else can be done."""
    seconds = abs(ahead) / NANOSECONDS
    scale = time_scales(seconds)
    size = f"{seconds:.0f} s" if scale or seconds > 1000 else f"{seconds:.2f} s"
    found = f"clouds are stamped {size} {'after' if ahead > 0 else 'before'} images recorded at the same time"
    if not of_clocks:
        return (
            f"{found}: messages waited that long, or clocks differ; paired by the stamps. Pair as recorded by --clock recording, "
            f"or set motion.time_offset_s to {-ahead / NANOSECONDS:.2f}"
        )
    exact = "" if scale else "; it is known as well as messages arrive, to some 0.1 s, see motion.max_time_offset_s"
    return f"{found}: {cause_of_difference(seconds)}; paired as recorded{exact}. --clock header pairs by the stamps as they are"


@contextmanager
def located(path: Path, where: str) -> Iterator[None]:
    """Prefix BadInputError with the bag and the place of an unusable message."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(f"{path}, {where}: {error}") from error
