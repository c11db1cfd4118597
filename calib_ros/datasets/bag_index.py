"""Where the messages of a bag are, by topic and time, with its cameras and static transforms."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.datasets.bag_file import TF, BagFile, StaticTransforms, peek_header
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
# Where static transforms are repeated more often than this, those at the bag's beginning and before the windows are enough.
FEW_TRANSFORMS, BEGINNING = 100, 5 * NANOSECONDS


class BagIndex:
    """What is needed to pair the messages of a bag and to fetch them one by one, with its cameras and static transforms. Nothing
    is read before `read` or `read_spans`; the messages of the latter are kept, up to MAX_KEPT."""

    def __init__(
        self, bag: BagFile, image_topic: str, points_topic: str, info_topic: str, rectified: bool, clock: str = "auto"
    ) -> None:
        self._bag, self._rectified, self._clock = bag, rectified, clock
        self.image, self.cloud, self.info = (TopicIndex(topic) for topic in (image_topic, points_topic, info_topic))
        self._by_topic = {index.topic: index for index in (self.image, self.cloud, self.info)}
        self._statics = [t.name for t in bag.topics.values() if t.type == TF and t.name.endswith("/tf_static")]
        self._decoded: dict[bytes, Camera] = {}
        self._found_cameras: list[Camera] = []
        self._cameras: list[Camera] = []
        self._transforms: list[tuple[int, Any]] = []
        self._kept: dict[tuple[str, int, int], bytes] | None = None
        self.without_key = 0  # pictures of a video before its first key frame, which are left out
        self._kept_bytes = 0

    def read(self, keep: bool = False) -> None:
        """Read the whole bag once. keep: hold messages in memory, as `read_spans` does."""
        if keep:
            self._kept = {}
        topics, begin = [*self._by_topic, *self._statics], self._first_key()
        for topic, recorded, data in (
            self._bag.raw(topics) if keep else self._bag.heads(topics, [self.info.topic, *self._statics])
        ):
            if topic in self._statics:
                self._transforms.append((recorded, self._bag.decode(topic, data)))
            elif topic == self.image.topic and recorded < begin:
                self.without_key += 1
            else:
                self._add(topic, recorded, data)
        self._transforms.sort(key=lambda one: one[0])
        self._finish()

    def _first_key(self) -> int:
        """Recording time of the first picture that can be decoded, ns."""
        if self._bag.topics[self.image.topic].type not in VIDEO:
            return self._bag.start
        for topic, recorded, data in self._bag.raw([self.image.topic]):
            with located(self._bag.path, topic):
                if packet_of(self._bag.decode(topic, data)).is_key:
                    return recorded
        return self._bag.stop

    def read_spans(self, spans: list[Span]) -> None:
        """Read only what was recorded in these spans, which neither overlap nor have been read; CameraInfo and static transforms
        also around them, where they are rarer."""
        if self._kept is None:
            self._kept = {}
        info_period = self._bag.period(self.info.topic)
        for start, stop in spans:
            rare = info_period > (stop - start) / 2
            topics = [self.image.topic, self.cloud.topic] + ([] if rare else [self.info.topic])
            for message in self._bag.raw(topics, start, stop):
                self._add(*message)
            for message in self._bag.raw([self.info.topic], start - info_period, stop + info_period) if rare else ():
                self._add(*message)
        self._finish(self._read_transforms(spans))

    def _add(self, topic: str, recorded: int, data: bytes) -> None:
        with located(self._bag.path, topic):
            header = self._by_topic[topic].add(recorded, data)
            if topic == self.info.topic:
                content = bytes(data[12:])  # all but the stamp: nearly always the same, so decoded once
                if content not in self._decoded:
                    self._decoded[content] = decode_camera_info(self._bag.decode(topic, data), self._rectified)
                self._found_cameras.append(self._decoded[content])
            elif self._kept is not None and self._kept_bytes + len(data) <= MAX_KEPT:
                self._kept[topic, recorded, header] = data
                self._kept_bytes += len(data)

    def _read_transforms(self, spans: list[Span]) -> bool:
        """Whether there may be more of them than those read."""
        count = sum(self._bag.topics[topic].messages for topic in self._statics)
        if count <= FEW_TRANSFORMS:
            if not self._transforms:
                self._transforms = self._transforms_within()
            return False
        if not self._transforms:
            self._transforms += self._transforms_within(self._bag.start, self._bag.start + BEGINNING)
        before = 2 * max(self._bag.period(topic) for topic in self._statics)
        for start, stop in spans:
            self._transforms += self._transforms_within(start - before, stop)
        self._transforms.sort(key=lambda one: one[0])
        return True

    def _transforms_within(self, start: int | None = None, stop: int | None = None) -> list[tuple[int, Any]]:
        found = self._bag.raw(self._statics, start, stop)
        return [(recorded, self._bag.decode(topic, data)) for topic, recorded, data in found]

    def _finish(self, more_transforms: bool = False) -> None:
        """Put in order what was read. more_transforms: look for others if those read do not connect camera and LiDAR."""
        self.camera_frame = self.image.frame or self.info.frame
        self.lidar_frame = self.cloud.frame
        self.use_headers = self._clock != RECORDING and self.image.has_stamps and self.cloud.has_stamps
        for index in self._by_topic.values():
            index.finish(self.use_headers)
        asked = self.use_headers and self._clock == AUTO
        self.clouds_ahead, of_clocks = clock_difference(self.image, self.cloud) if asked else (0, False)
        self.clock_difference = self.clouds_ahead if of_clocks else 0  # that is taken out
        self.cloud.stamps = self.cloud.stamps - self.clock_difference
        self._cameras = [self._found_cameras[i] for i in self.info.order]
        self._references = _references(self._transforms, self.camera_frame, self.lidar_frame)
        if more_transforms and not self._references:
            self._transforms = self._transforms_within()
            self._references = _references(self._transforms, self.camera_frame, self.lidar_frame)

    @property
    def missing(self) -> list[str]:
        """Topics without any message."""
        return [topic for topic, index in self._by_topic.items() if not len(index)]

    def kept(self, topic: str, recorded: int, header: int) -> bytes | None:
        """A message that is in memory."""
        return None if self._kept is None else self._kept.get((topic, recorded, header))

    def vehicle_frames(self) -> dict[str, Matrix]:
        """T_camera_F (4, 4) of all frames F but camera and LiDAR that the static transforms connect to the camera, by name."""
        tree = StaticTransforms()
        for _, message in self._transforms:
            tree.add(message)
        own = (self.camera_frame, self.lidar_frame)
        return {name: T for name, T in tree.frames(self.camera_frame).items() if name not in own}

    def camera_at(self, stamp: int) -> Camera:
        """The camera of the CameraInfo nearest to an image's stamp."""
        return self._cameras[int(nearest_index(self.info.stamps, np.array([stamp]))[0])]

    def reference_at(self, recorded: int) -> Matrix | None:
        """T_camera_lidar (4, 4) as of a recording time, None if unknown; before the first transform the first one."""
        if not self._references:
            return None
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1]


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


def _references(transforms: list[tuple[int, Any]], camera_frame: str, lidar_frame: str) -> list[tuple[int, Matrix]]:
    """T_camera_lidar after each static transform that changed it, with the recording time, ns."""
    tree = StaticTransforms()
    known: list[tuple[int, Matrix]] = []
    for recorded, message in transforms:
        tree.add(message)
        T = tree.lookup(camera_frame, lidar_frame)
        if T is not None and not (known and np.array_equal(T, known[-1][1])):
            known.append((recorded, T))
    return known


@contextmanager
def located(path: Path, where: str) -> Iterator[None]:
    """Prefix BadInputError with the bag and the place of an unusable message."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(f"{path}, {where}: {error}") from error
