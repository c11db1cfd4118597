"""Classes that are given: by label images, by .label files of scans, or by the source."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.messages.pictures import PNG, decode_picture
from calib_ros_semantics.models.labels import CITYSCAPES_RAW, SEMANTIC_KITTI_RAW, Classes, Names, resized, table_of_folder

SAME_SHAPE = 0.01  # tolerance of the aspect ratio: labels are often made on reduced images
PALETTE_TYPE, GREY_TYPE = 3, 0  # colour types of PNG
BYTES_OF_LABEL = 4


class SourceClasses:
    """Classes of "pixels" or "points" that the dataset provides."""

    def __init__(self, of: str) -> None:
        self._of = of
        self.text = f"classes of {of} of the source"

    def __call__(self, frame: Frame) -> Classes:
        """Classes of a frame; ModelError without them."""
        option, found, instead = (
            ("image_classes", frame.classes, "name a network or a folder of label pictures")
            if self._of == "pixels"
            else ("cloud_classes", frame.cloud.label, "use geometric, a network or a folder of .label files")
        )
        if found is None:
            raise ModelError(f"{option} = source, but this source has no classes of {self._of}; {instead}")
        return found


class LabelFolder:
    """A folder with a file NAME + suffix per frame; its labels.yaml may declare the class names. ModelError if unusable."""

    def __init__(self, folder: str | Path, suffix: str, default: Names, kind: str) -> None:
        self.folder, self._suffix, self._kind = Path(folder), suffix, kind
        try:
            count = sum(1 for path in self.folder.iterdir() if path.suffix == suffix)
        except OSError as error:
            raise ModelError(f"folder {folder} cannot be read ({error.strerror}); check its permissions") from None
        if not count:
            raise ModelError(f"folder {folder} holds no {kind} *{suffix}, one for each frame; correct the path")
        self._table = table_of_folder(self.folder, default)
        self.text = f"folder of {count} {kind} *{suffix}"

    def _read(self, name: str) -> tuple[Path, NDArray[np.uint8]]:
        path = self.folder / f"{name}{self._suffix}"
        if not name or Path(name).name != name:
            raise ModelError(f"frame name '{name}' is no plain file name: {self._kind} in {self.folder} are found by it")
        try:
            return path, np.fromfile(path, np.uint8)
        except OSError as error:
            raise ModelError(f"{self._kind[:-1]} {path} cannot be read ({error.strerror}); each frame needs one") from None

    def _classes(self, path: Path, numbers: NDArray[Any]) -> Classes:
        try:
            return self._table.classes(numbers)
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from None


class LabelPictures(LabelFolder):
    """NAME.png with a class number for each pixel: grey or with a palette; labelIds of Cityscapes without a labels.yaml."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder, ".png", CITYSCAPES_RAW, "label pictures")

    def __call__(self, frame: Frame) -> Classes:
        """Classes (H, W) at the size of the image. Raises ModelError without a label image that fits the frame."""
        path, data = self._read(frame.name)
        numbers = _numbers(data)
        if numbers is None:
            raise ModelError(f"label picture {path} is not a complete PNG; make it again")
        if numbers.ndim != 2:
            raise ModelError(f"label picture {path} has colours; it must hold class numbers, as grey levels or with a palette")
        height, width = frame.image.shape[:2]
        if abs(numbers.shape[1] * height / (numbers.shape[0] * width) - 1) > SAME_SHAPE:
            found = f"{numbers.shape[1]}x{numbers.shape[0]}"
            raise ModelError(f"label picture {path} is {found}, but the image {width}x{height}; it must show the same")
        return resized(self._classes(path, numbers.astype(np.int32)), (height, width))


class LabelScans(LabelFolder):
    """NAME.label with a uint32 for each point, class in the lower 16 bits; those of SemanticKITTI without a labels.yaml."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder, ".label", SEMANTIC_KITTI_RAW, "label files")

    def __call__(self, frame: Frame) -> Classes:
        """Classes (n,) of the points of the frame's cloud. Raises ModelError without a file that fits the frame."""
        path, data = self._read(frame.name)
        if len(data) != BYTES_OF_LABEL * len(frame.cloud):
            raise ModelError(
                f"label file {path} has {len(data)} bytes, but the cloud {len(frame.cloud)} points of {BYTES_OF_LABEL} bytes "
                "each; use the file of this scan"
            )
        return self._classes(path, (data.view("<u4") & 0xFFFF).astype(np.int32))


def _numbers(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """The numbers stored in a PNG of grey levels or with a palette, the pixels of others; None if it is not complete."""
    # OpenCV returns the colours of a palette, and stretches grey levels of fewer than 8 bits to 0..255.
    file = data.tobytes()
    if file[:8] != PNG or len(file) < 33 or file[25] not in (PALETTE_TYPE, GREY_TYPE):
        return decode_picture(data)
    pixels, bits = decode_picture(_without_palette(file) if file[25] == PALETTE_TYPE else data), file[24]
    return pixels if pixels is None or bits not in (1, 2, 4) else pixels // (255 // (2**bits - 1))


def _without_palette(file: bytes) -> NDArray[np.uint8]:
    """A PNG with a palette rewritten as one whose grey levels are the indices of the palette."""
    header = b"IHDR" + file[16:25] + bytes([GREY_TYPE]) + file[26:29]
    kept, at = [PNG, file[8:12], header, struct.pack(">I", zlib.crc32(header))], 33
    while at + 12 <= len(file):
        end = at + 12 + struct.unpack_from(">I", file, at)[0]
        if file[at + 4 : at + 8] not in (b"PLTE", b"tRNS"):
            kept.append(file[at:end])
        at = end
    return np.frombuffer(b"".join(kept), np.uint8)
