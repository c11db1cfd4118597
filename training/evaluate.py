"""IoU per class on CamVid's fixed split, with colours and without: python -m training.evaluate FILE --data CAMVID."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from training.augment import GREY_WEIGHTS
from training.camvid import NAMES, SPLITS, VOID, Image, Labels, samples

Pair = tuple[Image, Labels]


def without_colour(image: Image) -> Image:
    """A picture as a grey camera would give it, (H, W, 3)."""
    grey = np.rint(image.astype(np.float32) @ GREY_WEIGHTS).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def confusion_of(predict: Callable[[Image], Labels], pairs: Iterable[Pair]) -> NDArray[np.int64]:
    """Pixels (11, 11) by true and predicted class, without VOID."""
    count = len(NAMES)
    total = np.zeros((count, count), np.int64)
    for image, labels in pairs:
        known = labels != VOID
        pair = labels[known].astype(np.int64) * count + predict(image)[known]
        total += np.bincount(pair, minlength=count * count).reshape(count, count)
    return total


def iou_of(confusion: NDArray[np.int64]) -> NDArray[np.float64]:
    """Intersection over union (11,) of each class; NaN for one that is neither there nor predicted."""
    hits = np.diag(confusion)
    union = confusion.sum(0) + confusion.sum(1) - hits
    return np.where(union > 0, hits / np.maximum(union, 1), np.nan)


def table_of(columns: dict[str, NDArray[np.float64]]) -> str:
    """A Markdown table of IoU per class and their mean."""
    lines = ["| class | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for number, name in enumerate(NAMES):
        lines.append(f"| {name} | " + " | ".join(f"{iou[number]:.3f}" for iou in columns.values()) + " |")
    lines.append("| **mean** | " + " | ".join(f"**{np.nanmean(iou):.3f}**" for iou in columns.values()) + " |")
    return "\n".join(lines)


def main() -> None:
    """Prints the table."""
    from training.predict import LONGEST, Predictor

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", help="checkpoint .pt or exported .onnx")
    parser.add_argument("--data", required=True, help="folder of CamVid, or of rendered pictures")
    parser.add_argument("--split", choices=SPLITS, default="val")
    parser.add_argument("--longest", type=int, default=LONGEST, help="px; larger pictures are reduced to it")
    args = parser.parse_args()
    try:
        predict = Predictor(args.file, args.longest)
        pairs = [sample.read() for sample in samples(args.data, args.split)]
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    grey = [(without_colour(image), labels) for image, labels in pairs]
    print(f"{len(pairs)} pictures of '{args.split}'\n")
    print(table_of({"colour": iou_of(confusion_of(predict, pairs)), "grey": iou_of(confusion_of(predict, grey))}))


if __name__ == "__main__":
    main()
