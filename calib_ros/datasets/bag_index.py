"""Where the messages of a bag are, by topic and time, with its cameras and static transforms."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS
from calib_ros.messages import decode_camera_info
from calib_ros.messages.video import VIDEO, packet_of
from calib_ros.stamps import LONGEST_QUEUE_S, Stamps, cause_of_difference, nearest_index, time_scales

Span = tuple[int, int]  # [start, stop) of recording times, ns
MAX_KEPT = 256 * 2**20  # bytes of messages held in memory: thirty frames of 2 Mpx in colour with their clouds
AUTO, HEADER, RECORDING = CLOCKS = "auto", "header", "recording"
MAX_LATENCY = NANOSECONDS  # usually, from a sensor to the recorder
QUICKEST = 0.9


class BagIndex:
    """What is needed to pair the messages of a bag and to fetch them one by one, with its cameras and static transforms. Nothing
    is read before `read` or `read_spans`; the messages of the latter are kept, up to MAX_KEPT.

    image, cloud, info: of the topics. without_key: pictures of a video before its first key frame, which are left out.
    clouds_ahead: see `clock_difference`, ns, of which `clock_difference` is taken out of the clouds' stamps.
    """

    def __init__(self, bag: BagFile, topics: tuple[str, str, str], rectified: bool, clock: str) -> None:
        self._bag, self._rectified, self._clock = bag, rectified, clock
        self.image, self.cloud, self.info = indices = tuple(map(TopicIndex, topics))
        self._by_topic = dict(zip(topics, indices, strict=True))
        self._decoded: dict[bytes, Camera] = {}
        self._cameras: list[Camera] = []
        self._transforms: list[tuple[int, Any]] = []
        self._kept: dict[tuple[str, int, int], bytes] | None = None
        self.without_key = self._kept_bytes = 0

    def read(self, keep: bool = False) -> None:
        """Read the whole bag once. keep: hold messages in memory, as `read_spans` does."""
        if keep:
            self._kept = {}
        begin, statics = self._bag.start, self._bag.statics
        if self._bag.topics[self.image.topic].type in VIDEO:  # decoding begins with a key frame
            with located(self._bag.path, self.image.topic):
                packets = (
                    (time, packet_of(self._bag.decode(topic, data))) for topic, time, data in self._bag.raw([self.image.topic])
                )
                begin = next((time for time, packet in packets if packet.is_key), self._bag.stop)
        topics = [*self._by_topic, *statics]
        whole = [self.info.topic, *statics]
        for topic, recorded, data in self._bag.raw(topics) if keep else self._bag.heads(topics, whole):
            if topic in statics:
                self._transforms.append((recorded, self._bag.decode(topic, data)))
            elif topic == self.image.topic and recorded < begin:
                self.without_key += 1
            else:
                self._add(topic, recorded, data)
        self._transforms.sort(key=lambda one: one[0])
        self._finish()

    def read_spans(self, spans: list[Span]) -> None:
        """Read only what was recorded in these spans, which neither overlap nor have been read; CameraInfo also around them,
        where it is rarer, and all static transforms."""
        self._kept = self._kept or {}
        period = self._bag.period(self.info.topic)
        for start, stop in spans:
            rare = period > (stop - start) / 2
            topics = [self.image.topic, self.cloud.topic] + ([] if rare else [self.info.topic])
            for message in self._bag.raw(topics, start, stop):
                self._add(*message)
            for message in self._bag.raw([self.info.topic], start - period, stop + period) if rare else ():
                self._add(*message)
        self._transforms = self._transforms or self._bag.transforms()
        self._finish()

    def _add(self, topic: str, recorded: int, data: bytes) -> None:
        with located(self._bag.path, topic):
            header = self._by_topic[topic].add(recorded, data)
            if topic == self.info.topic:
                content = bytes(data[12:])  # all but the stamp: nearly always the same, so decoded once
                if content not in self._decoded:
                    self._decoded[content] = decode_camera_info(self._bag.decode(topic, data), self._rectified)
                self._cameras.append(self._decoded[content])
            elif self._kept is not None and self._kept_bytes + len(data) <= MAX_KEPT:
                self._kept[topic, recorded, header] = data
                self._kept_bytes += len(data)

    def _finish(self) -> None:
        """Put in order what was read."""
        self.camera_frame, self.lidar_frame = self.image.frame or self.info.frame, self.cloud.frame
        self.use_headers = self._clock != RECORDING and self.image.has_stamps and self.cloud.has_stamps
        for index in self._by_topic.values():
            index.finish(self.use_headers)
        asked = self.use_headers and self._clock == AUTO
        self.clouds_ahead, of_clocks = clock_difference(self.image, self.cloud) if asked else (0, False)
        self.clock_difference = self.clouds_ahead if of_clocks else 0
        self.cloud.stamps = self.cloud.stamps - self.clock_difference
        # T_camera_lidar with its recording time, ns, whenever a static transform has changed it.
        self.tree = StaticTransforms()
        self._references: list[tuple[int, Matrix]] = []
        for recorded, message in self._transforms:
            self.tree.add(message)
            T = self.tree.lookup(self.camera_frame, self.lidar_frame)
            if T is not None and not (self._references and np.array_equal(T, self._references[-1][1])):
                self._references.append((recorded, T))

    @property
    def missing(self) -> list[str]:
        """Topics without any message."""
        return [topic for topic, index in self._by_topic.items() if not len(index)]

    def message(self, index: TopicIndex, position: int) -> Any:
        """The decoded message at a position of image or cloud."""
        recorded, header = int(index.recorded[position]), int(index.headers[position])
        kept = (self._kept or {}).get((index.topic, recorded, header))
        return self._bag.find(index.topic, recorded, header) if kept is None else self._bag.decode(index.topic, kept)

    def camera_at(self, stamp: int) -> Camera:
        """The camera of the CameraInfo nearest to an image's stamp."""
        return self._cameras[int(self.info.order[nearest_index(self.info.stamps, np.array([stamp]))[0]])]

    def reference_at(self, recorded: int) -> Matrix | None:
        """T_camera_lidar (4, 4) as of a recording time, None if unknown; before the first transform the first one."""
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1] if self._references else None


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
