"""Frames without points, pictures of few bits, and masks compared with known ones."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros_semantics.models.masks import Mask
from calib_ros_semantics.models.onnx_model import Deadline

NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))


def later() -> Deadline:
    return Deadline(60)


def frame_of(image: np.ndarray, name: str = "", cloud: PointCloud = NO_POINTS) -> Frame:
    height, width = image.shape[:2]
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], float)
    return Frame(image=image, cloud=cloud, camera=Camera(K=K, width=width, height=height), name=name)


def box(left: int, top: int, right: int, bottom: int, size: tuple[int, int]) -> np.ndarray:
    """Mask (H, W) of a rectangle."""
    out = np.zeros(size, bool)
    out[top:bottom, left:right] = True
    return out


def png(numbers: np.ndarray, bits: int, palette: bool = False) -> bytes:
    """Numbers (H, W) of so many bits per pixel, as grey levels or with a palette that has nothing to do with them."""
    height, width = numbers.shape
    colours = bytes((37 * k + 11 * c) % 256 for k in range(2**bits) for c in range(3))
    each = np.unpackbits(numbers.astype(np.uint8)[..., None], axis=2)[..., 8 - bits :]
    rows = np.pad(np.packbits(each.reshape(height, -1), axis=1), ((0, 0), (1, 0)))
    header = struct.pack(">IIBBBBB", width, height, bits, 3 if palette else 0, 0, 0, 0)
    meaning = [(b"PLTE", colours), (b"tRNS", b"\0")] if palette else []
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), *meaning, (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")):
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return out


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def picture_of(mask: Mask, size: tuple[int, int]) -> np.ndarray:
    """A mask at the size of its image, (H, W) bool."""
    height, width = mask.inside.shape
    out = np.zeros(size, bool)
    out[mask.top : mask.top + height, mask.left : mask.left + width] = mask.inside
    return out


def compared(masks: list[Mask], truth: list[np.ndarray], enough: float = 0.8) -> tuple[float, int, int]:
    """Recall of true masks, how many masks tell one that another told already, and how many tell none."""
    pictures = [picture_of(mask, truth[0].shape) for mask in masks]
    table = np.array([[iou(picture, true) for true in truth] for picture in pictures]).reshape(len(pictures), len(truth))
    told = [int(row.argmax()) for row in table if row.max() > 0.5]
    recall = float((table.max(axis=0, initial=0) > enough).mean())
    return recall, len(told) - len(set(told)), len(pictures) - len(told)
