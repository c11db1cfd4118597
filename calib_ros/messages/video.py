"""Video packets, one picture a message, -> pictures, by PyAV: H.264, H.265, AV1 and VP9."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.messages.wire import payload, shown

# Both begin with a stamp and a frame, as a std_msgs/Header does.
VIDEO = {
    "foxglove_msgs/msg/CompressedVideo": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\n"
        "uint8[] data\n"
    ),
}
# FFMPEGPacket as in ROS 1, with its own name here.
FORMER_PACKET = "ffmpeg_image_transport_msgs/msg/FormerFFMPEGPacket"
FORMER_DEFINITION = (
    "std_msgs/Header header\nuint8[] data\nint32 img_width\nint32 img_height\nstring encoding\nuint64 pts\nuint8 flags\n"
)
# What the format, or the encoder's name as in "libx264;yuv420p;bgr8;bgr8" or "hevc_nvenc", contains -> FFmpeg's decoder.
CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc", "av1": "libdav1d", "vp9": "vp9"}
INSTALL = "python3 -m pip install av"
NALS = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
SEQUENCE_HEADER = 1  # an OBU of AV1
LOW_DELAY = 1 << 19  # AV_CODEC_FLAG_LOW_DELAY
MAX_PIXELS = 2**25  # of 8K, the most that levels of these codecs know


class Packet(NamedTuple):
    """What a message holds. is_key: whether decoding can begin with it."""

    codec: str
    is_key: bool
    data: bytes


def packet_of(msg: Any) -> Packet:
    """A message of one of the types VIDEO -> its packet. Raises BadInputError for other codecs."""
    name = str(msg.format if hasattr(msg, "format") else msg.encoding)
    codec = next((decoder for part, decoder in CODECS.items() if part in name.partition(";")[0].lower()), None)
    if codec is None:
        raise BadInputError(f"video of format '{shown(name)}' is not read; republish it as h264, h265, av1 or vp9, or as images")
    data = payload(msg.data).tobytes()
    return Packet(codec, _is_key(codec, data), data)


def _is_key(codec: str, data: bytes) -> bool:
    if codec == "h264":
        return next((kind for kind in (nal[1][0] & 31 for nal in NALS.finditer(data)) if 1 <= kind <= 5), 0) == 5
    if codec == "hevc":
        return 16 <= next((kind for kind in (nal[1][0] >> 1 & 63 for nal in NALS.finditer(data)) if kind < 32), 0) < 24
    if codec == "libdav1d":
        return SEQUENCE_HEADER in _obus(data)
    if not data or data[0] >> 6 != 2:
        return False
    # Of VP9's first byte: two bits marker, two of the profile and one more for the last profile, then whether an earlier picture
    # is shown again, and whether this one refers to others.
    return (data[0] >> (1 if data[0] >> 4 & 3 == 3 else 2)) & 3 == 0


def _obus(data: bytes) -> Iterator[int]:
    """Types of the open bitstream units of AV1 in a packet, up to the first without a size."""
    at = 0
    while at < len(data):
        head = data[at]
        yield head >> 3 & 15
        at += 2 if head & 4 else 1
        size = 0
        for shift in range(0, 56, 7):
            if not head & 2 or at >= len(data):
                return
            byte = data[at]
            size, at = size | (byte & 127) << shift, at + 1
            if byte < 128:
                break
        at += size


class VideoDecoder:
    """Packets in order, from one that is a key on, -> pictures. Raises MissingDependencyError without PyAV."""

    def __init__(self, codec: str) -> None:
        self._av = pyav()
        try:
            self._context = self._av.CodecContext.create(codec, "r")
        except ValueError:
            raise MissingDependencyError(f"this PyAV has no decoder {codec}; install its wheel: {INSTALL}") from None
        self._context.thread_count = 1  # several delay pictures, and lose errors of damaged slices
        self._context.flags |= LOW_DELAY
        # Instead of grey or smeared areas, edges that no camera saw, an error; and no memory for what no camera has.
        self._context.options = {"err_detect": "explode", "max_pixels": str(MAX_PIXELS)}
        self._names: dict[int, Any] = {}  # of the packets whose pictures have not come out, by number
        self._count = 0

    def decode(self, data: bytes | None, name: Any = None) -> list[tuple[Any, Any]]:
        """The next packet with a name of its own, or the end (None) -> the pictures that come out, with the names of their
        packets. Raises BadInputError for what cannot be decoded."""
        packet = None
        if data is not None:
            packet = self._av.Packet(data)
            packet.pts = self._count
            self._names[self._count] = name
            self._count += 1
        try:
            frames = self._context.decode(packet)
        except (self._av.FFmpegError, MemoryError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise BadInputError(
                f"a video packet since the last key frame is damaged or lost ({shown(reason)}); choose other frames"
            ) from None
        return [(self._names.pop(frame.pts), frame) for frame in frames if frame.pts in self._names]


def picture_of(frame: Any) -> NDArray[np.uint8]:
    """A decoded picture -> uint8 (H, W) grey or (H, W, 3) BGR."""
    if frame.is_corrupt:
        raise BadInputError("a video packet since the last key frame is lost; choose other frames")
    return np.asarray(frame.to_ndarray(format="gray" if frame.format.name.startswith("gray") else "bgr24"), np.uint8)


def pyav() -> Any:
    """The module `av`. Raises MissingDependencyError."""
    try:
        import av
    except ImportError:
        raise MissingDependencyError(f"video is decoded by PyAV, which is missing: {INSTALL}") from None
    return av
