"""Pictures with classes: CamVid (Brostow, Fauqueur, Cipolla 2009) in 480x360 with its fixed split, and rendered ones.

A folder of rendered pictures (training.render) has images/NUMBER.jpg itself, one of CamVid has folders of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import cv2
import numpy as np
from numpy.typing import NDArray

NAMES = ("sky", "building", "pole", "road", "pavement", "tree", "sign", "fence", "car", "pedestrian", "cyclist")
VOID = len(NAMES)  # pixels without a label
SKY, BUILDING = NAMES.index("sky"), NAMES.index("building")

# From this frame (30 per second) on, a drive is validated: its last part, so that no place of it is trained on. The three drives
# are of dusk (0001TP), of open streets (0006R0) and of a town (0016E5); all classes are in these parts.
VALIDATED = {"0001TP": 8130, "0006R0": 3540, "0016E5": 7590}
GAP = 90  # frames, 3 s: pictures closer to the validated part are left out, since they show the same things
# 101 pictures of one place at 15 Hz, published as validation set; a tenth of them weighs it like the rest of the drive.
CLIP, CLIP_DRIVE, CLIP_STEP = range(7959, 8160), "0016E5", 20
SPLITS = ("train", "val", "clip")
RENDERED_STEP = 40  # every 40th rendered picture is validated: worlds have nothing in common, so that none in between is lost

Image = NDArray[np.uint8]
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Sample:
    """A picture and its labels, by their files."""

    name: str
    image: Path
    labels: Path

    def read(self) -> tuple[Image, Labels]:
        """RGB (H, W, 3) and class numbers (H, W), VOID where unknown. ValueError names a file that is no such thing."""
        image, labels = cv2.imread(str(self.image), cv2.IMREAD_COLOR), cv2.imread(str(self.labels), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"{self.image} is no picture; copy it again")
        if labels is None or labels.shape != image.shape[:2] or labels.dtype != np.uint8 or labels.max() > VOID:
            raise ValueError(f"{self.labels} must be a grey PNG of the picture's size with numbers up to {VOID}")
        return np.ascontiguousarray(image[..., ::-1]), labels


def splits_of(name: str) -> tuple[str, ...]:
    """Which of SPLITS a picture is part of by its name, such as 0016E5_07961 or 0006R0_f00930; empty in the gaps.

    "clip" is the published validation set, one place in 101 pictures; "val" has a tenth of it. ValueError for other names.
    """
    parts = re.fullmatch(r"([0-9A-Z]{6})_f?(\d+)", name)
    if parts is None or parts[1] not in VALIDATED:
        raise ValueError(f"'{name}' is no picture of CamVid's drives {', '.join(VALIDATED)}; remove it from the folder")
    drive, frame = parts[1], int(parts[2])
    if drive == CLIP_DRIVE and frame in CLIP:
        return ("val", "clip") if (frame - CLIP.start) % CLIP_STEP == 0 else ("clip",)
    if frame >= VALIDATED[drive]:
        return ("val",)
    return ("train",) if frame < VALIDATED[drive] - GAP else ()


class Pictures(Sequence[tuple[Image, Labels]]):
    """Samples as pictures and labels, read whenever they are asked for: thousands do not fit the memory."""

    def __init__(self, samples: Sequence[Sample]) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    @overload
    def __getitem__(self, number: int) -> tuple[Image, Labels]: ...
    @overload
    def __getitem__(self, number: slice) -> Pictures: ...
    def __getitem__(self, number: int | slice) -> tuple[Image, Labels] | Pictures:
        return Pictures(self._samples[number]) if isinstance(number, slice) else self._samples[number].read()


def is_rendered(root: str | Path) -> bool:
    """Whether a folder is one of rendered pictures."""
    return (Path(root) / "images").is_dir()


def samples(root: str | Path, split: str) -> list[Sample]:
    """Those of a split, by name. root: folder with */images/NAME.jpg (or .png) and */labels/NAME.png, all folders are read; or
    one of rendered pictures, which has no "clip". FileNotFoundError if there are none.
    """
    if is_rendered(root):
        return _rendered(Path(root), split)
    found = {path.stem: path for path in Path(root).glob("*/images/*") if path.suffix in (".jpg", ".png")}
    chosen = [Sample(n, p, p.parents[1] / "labels" / f"{n}.png") for n, p in sorted(found.items()) if split in splits_of(n)]
    if not chosen:
        raise FileNotFoundError(f"{root} holds no pictures for '{split}' as */images/NAME.jpg with */labels/NAME.png")
    return chosen


def _rendered(root: Path, split: str) -> list[Sample]:
    chosen = []
    for image in sorted((root / "images").glob("*[0-9].jpg")):
        sample = Sample(image.stem, image, root / "labels" / f"{image.stem}.png")
        held = int(image.stem) % RENDERED_STEP == 0
        # A picture without labels is one that is being written.
        if split in ("train", "val") and held == (split == "val") and sample.labels.exists():
            chosen.append(sample)
    if not chosen:
        raise FileNotFoundError(f"{root} holds no rendered pictures for '{split}'; render more of them")
    return chosen


def class_weights(labels: Iterable[Labels]) -> NDArray[np.float32]:
    """Weights (11,) of the classes in the loss, 1 / log(1.05 + share of pixels) (ENet, Paszke et al. 2016, with c = 1.05)."""
    counts = sum(np.bincount(picture.ravel(), minlength=VOID + 1)[:VOID] for picture in labels)
    return np.asarray(1 / np.log(1.05 + counts / np.sum(counts)), np.float32)
