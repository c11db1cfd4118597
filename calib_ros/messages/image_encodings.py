"""sensor_msgs/Image and CompressedImage -> 8-bit grey or BGR pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.messages.pictures import decode_picture
from calib_ros.messages.wire import payload, shown


class Encoding(NamedTuple):
    """How pixels are stored: channels per pixel, bytes per channel, OpenCV's conversion to BGR (None: none needed)."""

    channels: int
    bytes: int = 1
    to_bgr: int | None = None
    planar_420: bool = False  # a full plane of luma, then a half-height plane of interleaved chroma


# ROS names a Bayer pattern by its first two rows, OpenCV by the second and third pixel of the second row: RGGB is "BG" there.
BAYER = {
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding(1),
    "8UC1": Encoding(1),
    "mono16": Encoding(1, 2),
    "16UC1": Encoding(1, 2),
    "bgr8": Encoding(3),
    "8UC3": Encoding(3),
    "rgb8": Encoding(3, 1, cv2.COLOR_RGB2BGR),
    "bgra8": Encoding(4, 1, cv2.COLOR_BGRA2BGR),
    "8UC4": Encoding(4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": Encoding(4, 1, cv2.COLOR_RGBA2BGR),
    "bgr16": Encoding(3, 2),
    "rgb16": Encoding(3, 2, cv2.COLOR_RGB2BGR),
    "yuv422": Encoding(2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": Encoding(2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": Encoding(2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": Encoding(2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "nv12": Encoding(1, 1, cv2.COLOR_YUV2BGR_NV12, planar_420=True),
    "nv21": Encoding(1, 1, cv2.COLOR_YUV2BGR_NV21, planar_420=True),
    **{f"{name}8": Encoding(1, 1, code) for name, code in BAYER.items()},
    **{f"{name}16": Encoding(1, 2, code) for name, code in BAYER.items()},
}
_BY_LOWER_NAME = {name.lower(): encoding for name, encoding in ENCODINGS.items()}


def decode_image(msg: Any) -> NDArray[np.uint8]:
    """sensor_msgs/Image -> uint8 (H, W) grey or (H, W, 3) BGR.

    Pixels that need no conversion share the message's memory. 16-bit images are stretched to 8 bit (`stretch_to_8bit`). Raises
    BadInputError for an unknown encoding, an empty image, or fewer bytes than its size needs.
    """
    name = str(msg.encoding)
    encoding = _BY_LOWER_NAME.get(name.strip().lower())
    if encoding is None:
        raise BadInputError(f"Image: encoding '{shown(name)}' is not supported; republish it as one of {', '.join(ENCODINGS)}")
    width, height = int(msg.width), int(msg.height)
    if width <= 0 or height <= 0:
        raise BadInputError(f"Image: size {width}x{height} has no pixels; check the camera driver")
    rows = height * 3 // 2 if encoding.planar_420 else height
    row_bytes = width * encoding.channels * encoding.bytes
    step = int(msg.step) or row_bytes  # some drivers leave step at 0 for rows without padding
    data = payload(msg.data)
    if step < row_bytes:
        raise BadInputError(f"Image: step {step} is shorter than a row of {name} ({row_bytes} bytes); check the camera driver")
    if len(data) < rows * step:
        raise BadInputError(
            f"Image: {len(data)} bytes of data, but {width}x{height} {name} with step {step} needs "
            f"{rows * step}; the message is truncated, check the camera driver or the recording"
        )
    dtype = np.dtype("u1" if encoding.bytes == 1 else (">u2" if msg.is_bigendian else "<u2"))
    padded: NDArray[Any] = np.ndarray(
        (rows, width, encoding.channels), dtype, data, strides=(step, encoding.channels * encoding.bytes, encoding.bytes)
    )
    pixels = np.ascontiguousarray(padded[:, :, 0] if encoding.channels == 1 else padded)
    return _to_bgr(_as_8bit(pixels), encoding.to_bgr, name)


def decode_compressed_image(msg: Any) -> NDArray[np.uint8]:
    """sensor_msgs/CompressedImage of JPEG, PNG or BMP -> uint8 (H, W) grey or (H, W, 3) BGR. Raises BadInputError for depth
    images, truncated or damaged data, and other formats."""
    layout = str(msg.format)
    if "compresseddepth" in layout.lower():
        raise BadInputError("CompressedImage: this is a depth image (compressedDepth); choose the topic of a camera picture")
    data = payload(msg.data)
    picture = decode_picture(data)
    if picture is None:
        raise BadInputError(
            f"CompressedImage: {len(data)} bytes of format '{shown(layout)}' are not a complete JPEG, PNG or BMP; "
            "check the recording or republish the image as raw"
        )
    # compressed_image_transport stores a raw Bayer mosaic as a grey PNG and names its pattern in the format's first word.
    original = layout.partition(";")[0].strip().lower()
    mosaic = BAYER.get(original.rstrip("0123456789"))
    return _to_bgr(picture_to_bgr(picture), mosaic if picture.ndim == 2 else None, layout)


def picture_to_bgr(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels as `decode_picture` returns them -> uint8 (H, W) grey or (H, W, 3) BGR, without transparency, 16 bits stretched."""
    pixels = _as_8bit(picture)
    return _to_bgr(pixels, cv2.COLOR_BGRA2BGR if pixels.ndim == 3 and pixels.shape[2] == 4 else None, "picture")


def stretch_to_8bit(image: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """uint16 (H, W[, channels]) -> uint8, mapping the 0.5 and 99.5 percentiles to 0 and 255, whichever bits a camera uses."""
    stride = int(np.sqrt(image.size / 2**16)) | 1  # odd, so that all colours of a Bayer mosaic are sampled
    low, high = np.percentile(image[::stride, ::stride], (0.5, 99.5))
    if high <= low:
        return (image >> 8).astype(np.uint8)
    levels = np.clip((np.arange(2**16) - low) * (255 / (high - low)) + 0.5, 0, 255).astype(np.uint8)
    return np.asarray(levels[image])


def _as_8bit(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return pixels
    return stretch_to_8bit(pixels.astype(np.uint16, copy=False))


def _to_bgr(pixels: NDArray[np.uint8], code: int | None, name: str) -> NDArray[np.uint8]:
    if code is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, code), np.uint8)
    except cv2.error:
        height, width = pixels.shape[:2]
        raise BadInputError(
            f"Image: {width}x{height} is impossible in {shown(name)} (it needs even sides); republish it as bgr8"
        ) from None
