"""Classes and masks that are ready: from the source, or from a folder with a file, or a folder of masks, for each frame."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.config.semantics import SOURCE
from calib_ros.errors import ModelError
from calib_ros.frame import UNLABELLED, Frame
from calib_ros.messages.pictures import PNG, decode_picture
from calib_ros.registration.classes import CLOUD, IMAGE
from calib_ros_semantics.models.class_borders import PixelClasses, borders_of_classes
from calib_ros_semantics.models.labels import CITYSCAPES_RAW, SEMANTIC_KITTI_RAW, Classes, Names, resized, table_of_folder
from calib_ros_semantics.models.masks import Mask, MaskModel, found_mask
from calib_ros_semantics.models.onnx_model import Deadline, SegmentationModel

SAME_SHAPE = 0.01  # tolerance of the aspect ratio: labels are often made on reduced images
PALETTE_TYPE, GREY_TYPE = 3, 0  # colour types of PNG
BYTES_OF_LABEL = 4
# Label files: suffix, what they are called, and their classes where no labels.yaml beside them says otherwise. A PNG has a class
# number for each pixel, grey or with a palette; a .label file a uint32 for each point, with the class in its lower 16 bits.
FILES: dict[str, tuple[str, str, Names]] = {
    IMAGE: (".png", "label pictures", CITYSCAPES_RAW),
    CLOUD: (".label", "label files", SEMANTIC_KITTI_RAW),
}
OF_SOURCE = {
    IMAGE: ("pixels", "name a network or a folder of label pictures"),
    CLOUD: ("points", "use geometric, a network or a folder of .label files"),
}


class ReadyClasses(SegmentationModel):
    """Classes of pixels (IMAGE) or points (CLOUD) of the source, or of a folder's files NAME + suffix. ModelError if unusable."""

    def __init__(self, kind: str, path: str) -> None:
        self._kind, self._folder = kind, None if path == SOURCE else Path(path)
        self._suffix, self._files, usual = FILES[kind]
        self._text = f"classes of {OF_SOURCE[kind][0]} of the source"
        if self._folder is None:
            return
        try:
            count = sum(1 for file in self._folder.iterdir() if file.suffix == self._suffix)
        except OSError as error:
            raise ModelError(f"folder {path} cannot be read ({error.strerror}); check its permissions") from None
        self._text = f"folder of {count} {self._files} *{self._suffix}"
        if not count:
            raise ModelError(f"folder {path} holds no {self._files} *{self._suffix}, one for each frame; correct the path")
        self._table = table_of_folder(self._folder, usual)

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Any:
        deadline.check()
        classes = self._of_source(frame) if self._folder is None else self._read(self._folder, frame)
        if self._kind == CLOUD:
            return np.where(frame.cloud.finite_mask(), classes, np.uint8(UNLABELLED))
        return PixelClasses(classes, borders_of_classes(classes) if borders else None)

    def describe(self) -> str:
        return self._text

    def _of_source(self, frame: Frame) -> Classes:
        found = frame.classes if self._kind == IMAGE else frame.cloud.label
        if found is None:
            of, instead = OF_SOURCE[self._kind]
            raise ModelError(f"{self._kind} = source, but this source has no classes of {of}; {instead}")
        return found

    def _read(self, folder: Path, frame: Frame) -> Classes:
        path = folder / f"{frame.name}{self._suffix}"
        if not frame.name or Path(frame.name).name != frame.name:
            raise ModelError(f"frame name '{frame.name}' is no plain file name: {self._files} in {folder} are found by it")
        data, (height, width) = _data(path, self._files[:-1]), frame.image.shape[:2]
        if self._kind == CLOUD:
            if len(data) != BYTES_OF_LABEL * len(frame.cloud):
                raise ModelError(
                    f"label file {path} has {len(data)} bytes, but the cloud {len(frame.cloud)} points of {BYTES_OF_LABEL} bytes "
                    "each; use the file of this scan"
                )
            numbers: NDArray[Any] = data.view("<u4") & 0xFFFF
        else:
            numbers = _pixels(path, _numbers(data), "label picture")
            if numbers.ndim != 2:
                raise ModelError(
                    f"label picture {path} has colours; it must hold class numbers, as grey levels or with a palette"
                )
            if abs(numbers.shape[1] * height / (numbers.shape[0] * width) - 1) > SAME_SHAPE:
                found = f"{numbers.shape[1]}x{numbers.shape[0]}"
                raise ModelError(f"label picture {path} is {found}, but the image {width}x{height}; it must show the same")
        try:
            classes = self._table.classes(numbers.astype(np.int32))
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from None
        return classes if self._kind == CLOUD else resized(classes, (height, width))


def _data(path: Path, what: str) -> NDArray[np.uint8]:
    try:
        return np.fromfile(path, np.uint8)
    except OSError as error:
        raise ModelError(f"{what} {path} cannot be read ({error.strerror}); each frame needs one") from None


def _pixels(path: Path, decoded: NDArray[Any] | None, what: str) -> NDArray[Any]:
    if decoded is None:
        raise ModelError(f"{what} {path} is not a complete PNG; make it again")
    return decoded


def _numbers(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """The numbers stored in a PNG of grey levels or with a palette, the pixels of others; None if it is not complete."""
    # OpenCV returns the colours of a palette, and stretches grey levels of fewer than 8 bits to 0..255.
    file = data.tobytes()
    if file[:8] != PNG or len(file) < 33 or file[25] not in (PALETTE_TYPE, GREY_TYPE):
        return decode_picture(data)
    if file[25] == PALETTE_TYPE:  # rewritten as one whose grey levels are the indices of the palette
        header = b"IHDR" + file[16:25] + bytes([GREY_TYPE]) + file[26:29]
        kept, at = [PNG, file[8:12], header, struct.pack(">I", zlib.crc32(header))], 33
        while at + 12 <= len(file):
            end = at + 12 + struct.unpack_from(">I", file, at)[0]
            if file[at + 4 : at + 8] not in (b"PLTE", b"tRNS"):
                kept.append(file[at:end])
            at = end
        data = np.frombuffer(b"".join(kept), np.uint8)
    pixels, bits = decode_picture(data), file[24]
    return pixels if pixels is None or bits not in (1, 2, 4) else pixels // (255 // (2**bits - 1))


class MaskFolder(MaskModel):
    """Masks made beforehand: `folder/NAME/*.png` of frame NAME, grey at the size of its image, bright inside."""

    needed = "a file in the folder"

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def describe(self) -> str:
        return f"ready masks {self.folder}/NAME/*.png"

    def masks(self, frame: Frame, deadline: Deadline) -> list[Mask]:
        """In the order of the file names, without specks and dark pictures."""
        if not frame.name:
            raise ModelError(f"masks {self.folder}: this frame has no name to find its folder by; use a model instead")
        own = self.folder / frame.name
        paths = sorted(own.glob("*.png"))
        if not paths:
            found_by = "as calib-ros replay prints it (the number of a KITTI frame, 000042)"
            raise ModelError(f"masks: there is no {own}/*.png; a frame's folder has its name, {found_by}")
        size, masks = (frame.image.shape[0], frame.image.shape[1]), []
        for path in paths:
            deadline.check()
            picture = _pixels(path, decode_picture(_data(path, "mask")), "mask")
            picture = picture[:, :, :3].max(axis=2) if picture.ndim == 3 else picture
            if picture.shape != size:
                sizes = f"{picture.shape[1]}x{picture.shape[0]}, but the image is {size[1]}x{size[0]}"
                raise ModelError(f"mask {path} is {sizes}; make the masks of the image as recorded")
            mask = Mask.of(picture > picture.max() // 2)  # masks may be of 0 and 1 or of 0 and 255
            masks += [] if mask is None else found_mask(mask.inside, size, (mask.left, mask.top))
        return masks
