"""A bag as a sequence of synchronised frames."""

from __future__ import annotations

from contextlib import suppress
from copy import copy
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.datasets.bag_file import BagFile
from calib_ros.datasets.bag_index import (
    AUTO,
    CLOCKS,
    MAX_KEPT,
    MAX_LATENCY,
    RECORDING,
    BagListing,
    Span,
    TopicIndex,
    clock_difference,
    difference_in_words,
    located,
)  # fmt: skip
from calib_ros.datasets.bag_topics import COMPRESSED, choose_camera_info, choose_image, choose_points, is_rectified
from calib_ros.datasets.bag_video import KEY_FRAMES, BagVideo
from calib_ros.datasets.recent import Recent
from calib_ros.datasets.source import describe_camera, spread_positions
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.sweep import BLIND_CLOUDS, SweepOffset
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_cloud, decode_compressed_image, decode_image
from calib_ros.messages.compressed_points import COMPRESSED_POINTS
from calib_ros.messages.video import VIDEO, packet_of
from calib_ros.stamps import nearest_index, nearest_pairs, pair_tolerance, usual_period

# Half widths of windows, in periods of the slower sensor: four hold a frame and its neighbours; of late ones, it takes more.
HALF_WIDTHS = (2.0, 6.0)
# Where in its slot a window is looked for: in the middle, and elsewhere if no frame is there, as in an interruption.
PLACES = (0.5, 0.2, 0.8)
ENOUGH = 0.5  # share of the slots that must have a frame
RECTIFIED = ", of rectified images by P of CameraInfo (--no-rectified if they are raw)"
WORTHWHILE = 0.6  # share of the recording above which the whole of it is read instead


class BagSource:
    """Frames of one camera and one LiDAR in a bag: each image with the cloud that swept its view at the nearest time, by the
    node's rules. Topics are found by type if there is one of each. Not thread-safe.

    Parameters
    ----------
    tolerance_s : see online.pair_tolerance_s; 0 = from the periods of images and clouds.
    rectified : whether the images are rectified, so that CameraInfo's P is used; None: if the name of the topic says so.
    motion : how the clouds are stamped, where their points have no times.
    T_camera_lidar : where about the camera looks, (4, 4), to find when scans sweep its view; by default that of the recording's
        static transforms, else along the LiDAR's +x axis.
    clock : "header" pairs by the messages' stamps, "recording" by when they were recorded; "auto" by the stamps, whose clocks are
        set alike where the recording shows that they differ by more than a second, see `remarks`.
    incomplete : use what is left of a bag of which parts are missing, empty or damaged.
    listing : of these topics and others, where it has been read already.
    windows : instead of the whole bag, read only so many short windows of time, evenly spread over it; its frames are then those
        of the windows, and `middles` has the position of one in each, between two others. For a bag that has an index.

    `camera` and `reference` are those of the first frame; `vehicle_frames` are T_camera_F (4, 4) of further frames F, by name;
    `cloud_ahead_ns` is what is taken out of the clouds' stamps, since their clock is ahead of the images'.
    Raises BadInputError for no or several candidates for a topic, no pairs, a damaged bag or message.
    """

    def __init__(
        self,
        path: str | Path,
        image_topic: str | None = None,
        points_topic: str | None = None,
        camera_info_topic: str | None = None,
        tolerance_s: float = 0.0,
        rectified: bool | None = None,
        motion: MotionConfig | None = None,
        T_camera_lidar: Transform | None = None,
        windows: int = 0,
        clock: str = AUTO,
        incomplete: bool = False,
        listing: BagListing | None = None,
    ) -> None:
        if not 0 <= tolerance_s < 1e6:
            raise BadInputError(f"tolerance_s is {tolerance_s}, but must be 0 or more seconds")
        if windows < 0:
            raise BadInputError(f"windows is {windows}, but must be 0 or more")
        if clock not in CLOCKS:
            raise BadInputError(f"clock is '{clock}', but must be one of {', '.join(CLOCKS)}")
        self.path, self._clock = Path(path), clock
        self.name = self.path.resolve().stem if self.path.is_file() else self.path.resolve().name
        self._bag = BagFile(self.path, incomplete)
        self.image_topic = choose_image(self._bag, image_topic)
        self.points_topic = choose_points(self._bag, points_topic)
        self.camera_info_topic = choose_camera_info(self._bag, camera_info_topic, self.image_topic)
        self.rectified = is_rectified(self.image_topic) if rectified is None else rectified
        self.recent = Recent(0)  # clouds that are kept
        self._cameras: dict[bytes, Camera] = {}  # by the message that says it
        self._without_key = 0
        self._tolerance_s, self._motion, self._view = tolerance_s, motion or MotionConfig(), T_camera_lidar
        is_video = self._bag.topics[self.image_topic].type in VIDEO
        self._video = BagVideo(self._bag, self.image_topic) if is_video else None
        found = self._read_windows(windows) if windows and self._bag.indexed else None
        if found is None:
            if listing is None:
                listing = self._new_listing()
                # Of a short bag nearly every message is asked for, some several times.
                listing.read(keep=bool(windows) and self._bag.size <= MAX_KEPT)
            missing = self._arrange(listing, since_key=True)
            if self._without_key and not len(self._images):
                raise BadInputError(
                    f"bag {self.path}: {self.image_topic} has no key frame, with which decoding begins; {KEY_FRAMES}"
                )
            if missing:
                raise BadInputError(
                    f"bag {self.path}: no message on {', '.join(missing)} is readable; copy it again or record it again"
                )
        self.windows = 0 if found is None else len(found)
        if not len(self):
            raise BadInputError(self._no_pairs())
        self.middles = spread_positions(windows, len(self)) if found is None else found
        first = int(self._pairs[0][0])
        self.vehicle_frames = self._tree.others(self.camera_frame, self.lidar_frame)
        self.camera = self._camera_at(int(self._images.stamps[first]))
        self.reference = self._reference_at(int(self._images.recorded[first]))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What there is to know about the recording, for people."""
        ahead, left_out = self._clouds_ahead, self._without_key
        clocks = [difference_in_words(ahead, self.cloud_ahead_ns != 0)] if ahead else []
        begins = [f"{left_out} pictures before the video's first key frame are left out"] if left_out else []
        return (*self._bag.remarks, *begins, *clocks)

    def _no_pairs(self) -> str:
        image, cloud, moments = self._images, self._clouds, self._clouds.stamps + self._sweep_offset
        gap = int(np.abs(moments[nearest_index(moments, image.stamps)] - image.stamps).min())
        if gap <= MAX_LATENCY:
            advice = "synchronise the sensors' clocks or raise tolerance_s"
        elif image.recorded.min() > cloud.recorded.max() or cloud.recorded.min() > image.recorded.max():
            advice = "they were recorded at different times; record them together"
        elif self.cloud_ahead_ns:
            advice = "--clock header pairs them by their stamps as they are"
        else:
            advice = "synchronise the sensors' clocks, or pair by the times of recording: --clock recording"
        return (
            f"bag {self.path}: no message of {self.points_topic} within {self._tolerance / NANOSECONDS:g} s of one of "
            f"{self.image_topic} (the nearest is {gap / NANOSECONDS:.3f} s away); {advice}"
        )

    def _new_listing(self) -> BagListing:
        return BagListing(self._bag, [self.image_topic, self.points_topic], [self.camera_info_topic])

    def _read_windows(self, count: int) -> list[int] | None:
        """Positions of a frame with a neighbour on either side in most of `count` equal parts of the recording; None if too few
        have one, and the whole bag has to be read."""
        start, stop = self._bag.start, self._bag.stop
        slots = list(pairwise(np.linspace(start, stop, count + 1).astype(np.int64).tolist()))
        period = max(self._bag.period(topic) for topic in (self.image_topic, self.points_topic))
        for half in (round(width * period) for width in HALF_WIDTHS):
            if 2 * half * count >= WORTHWHILE * (stop - start):
                continue
            listing = self._new_listing()
            read: list[Span] = []  # none overlaps another
            windows: dict[int, Span] = {}  # the newest of each slot
            frames: dict[int, int] = {}  # slot -> position of its frame
            for place in PLACES:
                if windows and not frames:  # these are too short, elsewhere, too
                    break
                spans: list[Span] = []
                for slot, (begin, end) in enumerate(slots):
                    middle = begin + round(place * (end - begin))
                    span = (middle - half, middle + half)
                    if slot not in frames and not any(span[0] < b and a < span[1] for a, b in (*read, *spans)):
                        spans.append(span)
                        windows[slot] = span
                if spans:
                    read += spans
                    listing.read_spans(spans)
                    if not self._arrange(listing, since_key=False):
                        frames = self._middles(windows)
            if len(frames) >= max(ENOUGH * count, 1):
                return sorted(frames.values())
        return None

    def _middles(self, windows: dict[int, Span]) -> dict[int, int]:
        """The frame nearest to the middle of each window that has one between two others."""
        images, clouds = self._images.recorded[self._pairs[0]], self._clouds.recorded[self._pairs[1]]
        found = {}
        for slot, (start, stop) in windows.items():
            inside = (start <= images) & (images < stop) & (start <= clouds) & (clouds < stop)
            between = np.flatnonzero(inside)[1:-1]
            if len(between):
                found[slot] = int(between[np.argmin(np.abs(images[between] - (start + stop) // 2))])
        return found

    def _arrange(self, listing: BagListing, since_key: bool) -> list[str]:
        """Put in order what was read, and pair it, unless a topic has no message: returns the names of such. since_key: without
        pictures before the first that can be decoded."""
        self._listing, topics = listing, (self.image_topic, self.points_topic, self.camera_info_topic)
        self._images, self._clouds, self._infos = indices = tuple(copy(listing.found[topic]) for topic in topics)
        if since_key and self._video is not None:
            with located(self.path, self.image_topic):
                pictures = self._bag.raw([self.image_topic])
                keys = (time for topic, time, data in pictures if packet_of(self._bag.decode(topic, data)).is_key)
                self._without_key = self._images.leave_out(next(keys, self._bag.stop))
        for data in listing.infos[self.camera_info_topic]:
            if data not in self._cameras:
                with located(self.path, self.camera_info_topic):
                    self._cameras[data] = decode_camera_info(self._bag.decode(self.camera_info_topic, data), self.rectified)
        self.camera_frame, self.lidar_frame = self._images.frame or self._infos.frame, self._clouds.frame
        self._use_headers = self._clock != RECORDING and self._images.has_stamps and self._clouds.has_stamps
        for index in indices:
            index.finish(self._use_headers)
        asked = self._use_headers and self._clock == AUTO
        self._clouds_ahead, of_clocks = clock_difference(self._images, self._clouds) if asked else (0, False)
        self.cloud_ahead_ns = self._clouds_ahead if of_clocks else 0
        self._clouds.stamps = self._clouds.stamps - self.cloud_ahead_ns
        # T_camera_lidar with its recording time, ns, whenever a static transform has changed it.
        self._tree, self._references = StaticTransforms(), list[tuple[int, Transform]]()
        for recorded, message in listing.transforms:
            self._tree.add(message)
            T = self._tree.lookup(self.camera_frame, self.lidar_frame)
            if T is not None and not (self._references and np.array_equal(T, self._references[-1][1])):
                self._references.append((recorded, T))
        missing = [index.topic for index in indices if not len(index)]
        if not missing:
            self._sweep_offset = self._learn_sweep()
            periods = usual_period(np.diff(self._images.stamps)), usual_period(np.diff(self._clouds.stamps))
            self._tolerance = pair_tolerance(periods, self._tolerance_s)
            self._pairs = nearest_pairs(self._images.stamps, self._clouds.stamps + self._sweep_offset, self._tolerance)
        return missing

    def _camera_at(self, stamp: int) -> Camera:
        """The camera of the CameraInfo nearest to an image's stamp."""
        nearest = int(self._infos.order[nearest_index(self._infos.stamps, np.array([stamp]))[0]])
        return self._cameras[self._listing.infos[self.camera_info_topic][nearest]]

    def _reference_at(self, recorded: int) -> Transform | None:
        """T_camera_lidar (4, 4) as of a recording time, None if unknown; before the first transform the first one."""
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1] if self._references else None

    def _learn_sweep(self) -> int:
        """From a cloud's stamp to the moment at which it sweeps the camera's view, ns, by the first clouds."""
        sweep, cloud, T = SweepOffset(self._motion), self._clouds, self._view
        for k in range(min(len(cloud), BLIND_CLOUDS)):
            if T is None:
                T = self._reference_at(int(cloud.recorded[k]))
            if T is None:
                T = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
            with suppress(BadInputError):  # reported when its frame is asked for
                sweep.add(self._cloud(k), self._camera_at(int(cloud.stamps[k])), T)
            if sweep.ns is not None:
                return sweep.ns
        return sweep.stamped_ns

    @property
    def stamps(self) -> list[int]:
        """Of the frames' images, ns."""
        return [int(stamp) for stamp in self._images.stamps[self._pairs[0]]]

    def close(self) -> None:
        """Close the bag's files; garbage collection does it too."""
        self._bag.close()

    def __enter__(self) -> BagSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._pairs[0])

    def __getitem__(self, index: int) -> Frame:
        image_at, cloud_at = (int(positions[index]) for positions in self._pairs)
        stamp = int(self._images.stamps[image_at])
        name = f"{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}"
        with located(self.path, f"{self.image_topic} at {name}"):
            image = self._image(image_at)
        with located(self.path, f"{self.points_topic} at {name}"):
            cloud = self._cloud(cloud_at)
        with located(self.path, f"{self.image_topic} and {self.camera_info_topic} at {name}"):
            return Frame(
                image=image,
                cloud=cloud,
                camera=self._camera_at(stamp),
                stamp=stamp,
                cloud_stamp=int(self._clouds.stamps[cloud_at]),
                reference=self._reference_at(int(self._images.recorded[image_at])),
                name=name,
            )

    def _image(self, position: int) -> NDArray[np.uint8]:
        if self._video is not None:
            return self._video.picture(*self._images.key(position)[1:])
        message = self._message(self._images, position)
        compressed = self._bag.topics[self.image_topic].type == COMPRESSED
        return decode_compressed_image(message) if compressed else decode_image(message)

    def _cloud(self, position: int) -> PointCloud:
        index, kind = self._clouds, self._bag.topics[self.points_topic].type
        return self.recent(index.key(position), lambda: cloud_of(self._message(index, position), kind))

    def _message(self, index: TopicIndex, position: int) -> Any:
        """The decoded message at a position of images or clouds."""
        key = index.key(position)
        kept = (self._listing.kept or {}).get(key)
        return self._bag.find(*key) if kept is None else self._bag.decode(index.topic, kept)

    def describe(self) -> dict[str, str]:
        """What the bag holds: label -> text."""
        pairs, images, clouds = len(self), len(self._images), len(self._clouds)
        ahead = self.cloud_ahead_ns / NANOSECONDS
        stamps = "of the headers" + (f", of clouds {-ahead:+.2f} s" if ahead else "")
        if not self._use_headers:
            stamps = "of the recording" + ("" if self._clock == RECORDING else " (headers have none)")
        roles = {self.image_topic: " as image", self.points_topic: " as points", self.camera_info_topic: " as camera_info"}
        return {
            "kind": "ROS 1 bag" if self._bag.storage == "ROS 1" else "ROS 2 bag",
            "path": str(self.path),
            "storage": self._bag.storage,
            "duration": f"{self._bag.duration_s:.1f} s",
            "topics": "; ".join(
                f"{topic.name} ({topic.type.rpartition('/')[2]}, {topic.messages}){roles.get(topic.name, '')}"
                for topic in self._bag.topics.values()
            ),
            "frames": f"{pairs} pairs; without partner: {images - pairs} of {images} images, {clouds - pairs} of {clouds} clouds"
            + (f"; {self.windows} windows of the recording" if self.windows else ""),
            "stamps": stamps,
            "pairing": f"scans sweep the view {self._sweep_offset / 1e6:+.0f} ms from their stamps",
            "camera": describe_camera(self.camera) + (RECTIFIED if self.rectified else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "none" if self.reference is None else "from /tf_static",
        }


def cloud_of(message: Any, kind: str) -> PointCloud:
    """The cloud in a decoded message of a type that `choose_points` finds."""
    if isinstance(message, PointCloud):
        return message
    return decode_compressed_cloud(message) if kind == COMPRESSED_POINTS else decode_cloud(message)
