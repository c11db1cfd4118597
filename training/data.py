"""Rendered pictures (training.render) with their classes: images/NUMBER.jpg and labels/NUMBER.png in one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

# The classes and their order are CamVid's (Brostow, Fauqueur, Cipolla 2009).
NAMES = ("sky", "building", "pole", "road", "pavement", "tree", "sign", "fence", "car", "pedestrian", "cyclist")
VOID = len(NAMES)  # pixels without a label
SKY, BUILDING = NAMES.index("sky"), NAMES.index("building")
HELD_OUT = 40  # every 40th picture is validated: worlds have nothing in common, so that none in between is lost

Image = NDArray[np.uint8]
Labels = NDArray[np.uint8]
Pair = tuple[Image, Labels]


@dataclass(frozen=True)
class Sample:
    """A picture and its labels, by their files."""

    name: str
    image: Path
    labels: Path

    def read(self) -> Pair:
        """RGB (H, W, 3) and class numbers (H, W), VOID where unknown. ValueError names a file that is no such thing."""
        image, labels = cv2.imread(str(self.image), cv2.IMREAD_COLOR), cv2.imread(str(self.labels), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"{self.image} is no picture; render it again")
        if labels is None or labels.shape != image.shape[:2] or labels.dtype != np.uint8 or labels.max() > VOID:
            raise ValueError(f"{self.labels} must be a grey PNG of the picture's size with numbers up to {VOID}")
        return np.ascontiguousarray(image[..., ::-1]), labels


class Pictures(Sequence[Pair]):
    """Samples as pictures and labels, read whenever they are asked for: thousands do not fit the memory."""

    def __init__(self, samples: Sequence[Sample]) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, number: int) -> Pair:  # type: ignore[override]
        return self._samples[number].read()


def samples(root: Path, held_out: bool) -> list[Sample]:
    """Those to validate with, or those to train on, by name. FileNotFoundError if there are none."""
    chosen = []
    for image in sorted((root / "images").glob("*[0-9].jpg")):
        sample = Sample(image.stem, image, root / "labels" / f"{image.stem}.png")
        # A picture without labels is one that is being written.
        if (int(image.stem) % HELD_OUT == 0) == held_out and sample.labels.exists():
            chosen.append(sample)
    if not chosen:
        raise FileNotFoundError(f"{root} holds no rendered pictures {'held out' if held_out else 'to train on'}; render more")
    return chosen


def class_weights(labels: Iterable[Labels]) -> NDArray[np.float32]:
    """Weights (11,) of the classes in the loss, 1 / log(1.05 + share of pixels) (ENet, Paszke et al. 2016, with c = 1.05)."""
    counts = sum(np.bincount(picture.ravel(), minlength=VOID + 1)[:VOID] for picture in labels)
    return np.asarray(1 / np.log(1.05 + counts / np.sum(counts)), np.float32)


def iou(predict: Callable[[Image], Labels], pairs: Iterable[Pair]) -> NDArray[np.float64]:
    """Intersection over union (11,) of each class, without VOID; NaN for one that is neither there nor predicted."""
    count = len(NAMES)
    confusion = np.zeros((count, count), np.int64)
    for image, labels in pairs:
        known = labels != VOID
        pair = labels[known].astype(np.int64) * count + predict(image)[known]
        confusion += np.bincount(pair, minlength=count * count).reshape(count, count)
    hits = np.diag(confusion)
    union = confusion.sum(0) + confusion.sum(1) - hits
    return np.where(union > 0, hits / np.maximum(union, 1), np.nan)
