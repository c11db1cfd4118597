"""Masks that were made beforehand: a folder of pictures for each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.messages.pictures import decode_picture
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.segment_anything.masks import Mask, Masks
from calib_ros.semantics.segment_anything.proposals import CELLS, clean


class MaskFolder:
    """Masks `folder/NAME/*.png` of the frame NAME: grey pictures of the size of its image, bright inside and dark outside.

    Callable as a Segmenter. ModelError if there is no such folder.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise ModelError(f"masks {folder}: there is no such folder; correct semantics.segment_anything")

    def describe(self) -> str:
        """Where the masks are looked for."""
        return f"ready masks {self.folder}/NAME/*.png"

    def __call__(self, frame: Frame, deadline: Deadline) -> Masks:
        """All masks of the frame in the order of their names, without specks, and pictures that are dark all over.

        ModelError names the folder that was looked for, or the picture that is unreadable or of another size. BudgetError.
        """
        if not frame.name:
            raise ModelError(f"masks {self.folder}: this frame has no name that a folder could have; use a model instead")
        own = self.folder / frame.name
        paths = sorted(own.glob("*.png"))
        if not paths:
            raise ModelError(
                f"masks: {own}/*.png was looked for, and there is none; its folder has the frame's name, as "
                "calib-ros replay prints it (a KITTI frame's number, 000042)"
            )
        masks = []
        for path in paths:
            deadline.check()
            masks.append(_read(path, frame.image.shape[:2]))
        return Masks.of(frame.image.shape[:2], masks)


def _read(path: Path, size: tuple[int, ...]) -> Mask | None:
    try:
        picture = decode_picture(np.fromfile(path, np.uint8))
    except OSError as error:
        raise ModelError(f"mask {path} cannot be read: {error.strerror}") from None
    if picture is None:
        raise ModelError(f"mask {path} is no whole PNG; write it again")
    if picture.ndim == 3:
        picture = picture[:, :, :3].max(axis=2)
    if picture.shape != size:
        raise ModelError(
            f"mask {path} is {picture.shape[1]}x{picture.shape[0]}, but the image is {size[1]}x{size[0]}; "
            "make the masks of the image as recorded"
        )
    mask = Mask.of(picture > picture.max() // 2)  # masks of 0 and 1 are as good as masks of 0 and 255
    return None if mask is None else Mask.of(clean(mask.inside, max(size) / CELLS), (mask.left, mask.top))
