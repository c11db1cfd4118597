"""Bags of video topics and compressed clouds, as tests record them."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
from bag_recorder import MS, START, Recorder
from ros_messages import Messages

from calib_ros.datasets.bag_file import BagFile
from calib_ros.datasets.bag_messages import zstd
from calib_ros.datasets.bag_topics import IMAGE, POINTS
from calib_ros.messages import decode_image
from calib_ros.messages.video import VIDEO

FOXGLOVE, FFMPEG = VIDEO
# Of each codec, encoder and options by which pictures come out as they go in, and the format in messages of both types.
ENCODERS = {
    "h264": ("libx264", {"tune": "zerolatency", "crf": "10"}),
    "h265": ("libx265", {"tune": "zerolatency", "preset": "ultrafast", "x265-params": "log-level=none:crf=10"}),
    "av1": ("libsvtav1", {"preset": "8", "crf": "10", "svtav1-params": "pred-struct=1:lookahead=0"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0", "crf": "10", "b": "0"}),
}


def encoded(pictures: list[np.ndarray], codec: str = "h264", keys: int = 10, **options: str) -> list[bytes]:
    """(H, W, 3) BGR pictures of even sides -> packets, a key frame each `keys` pictures."""
    import av

    os.environ["SVT_LOG"] = "0"
    name, usual = ENCODERS[codec]
    context = av.CodecContext.create(name, "w")
    context.height, context.width = pictures[0].shape[:2]
    context.pix_fmt, context.time_base, context.framerate, context.gop_size = "yuv420p", Fraction(1, 10), Fraction(10), keys
    context.max_b_frames, context.options = 0, {**usual, **options}
    packets = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24").reformat(format="yuv420p")
        frame.pts = number
        packets += context.encode(frame)
    return [bytes(packet) for packet in (*packets, *context.encode(None))]


def video_message(ros: Messages, kind: str, layout: str, header, packet: bytes):
    if kind == FOXGLOVE:
        return ros.make(kind, timestamp=header.stamp, frame_id=header.frame_id, data=ros.data(packet), format=layout)
    size = {"width": 8, "height": 6, "pts": 0, "flags": 0, "is_bigendian": False}
    return ros.make(kind, header=header, encoding=layout, data=ros.data(packet), **size)


def record_video(record: Recorder, packets: list[bytes], topic: str, kind: str = FOXGLOVE, layout: str = "h264") -> None:
    """A packet each 100 ms from START on, recorded 20 ms later."""
    for k, packet in enumerate(packets):
        stamp = START + 100 * MS * k
        record.write(topic, video_message(record.ros, kind, layout, record.ros.header(stamp, "cam"), packet), stamp + 20 * MS)


def compressed_bag(bag: Path, path: Path) -> Path:
    """A bag of images and clouds -> the same bag, of H.264 and of clouds by zstd."""
    source = BagFile(bag)
    images = next(topic for topic, kept in source.topics.items() if kept.type == IMAGE)
    messages = [(topic, time, source.decode(topic, data)) for topic, time, data in source.raw(source.topics)]
    packets = iter(encoded([decode_image(message) for topic, _, message in messages if topic == images]))
    with Recorder(path) as record:
        for topic, time, message in messages:
            if topic == images:
                message = video_message(record.ros, FOXGLOVE, "h264", message.header, next(packets))
            elif source.topics[topic].type == POINTS:
                message = record.ros.compressed_of(message, "zstd", zstd.compress(message.data.tobytes()))
            record.write(topic, message, time)
    return path
