"""Pictures with their classes in colours, for inspection: python -m training.pictures FILE --out FOLDER PICTURE..."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from training.camvid import Image, Labels
from training.predict import LONGEST, Predictor

# RGB, those of CamVid's publishers, but for a lighter sky and red cars.
COLOURS = np.array(
    [
        (128, 200, 255),
        (128, 64, 0),
        (255, 255, 0),
        (128, 64, 128),
        (0, 0, 192),
        (128, 128, 0),
        (192, 0, 128),
        (64, 64, 128),
        (255, 0, 0),
        (0, 255, 64),
        (0, 128, 192),
    ],
    np.uint8,
)


def coloured(image: Image, labels: Labels) -> NDArray[np.uint8]:
    """The picture (H, W, 3) above the same under its classes, (2H, W, 3)."""
    mixed = cv2.addWeighted(image, 0.35, COLOURS[labels], 0.65, 0)
    return np.vstack([image, np.asarray(mixed, np.uint8)])


def main() -> None:
    """Writes one PNG per picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", help="checkpoint .pt or exported .onnx")
    parser.add_argument("pictures", nargs="+", type=Path)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--longest", type=int, default=LONGEST, help="px; larger pictures are reduced to it")
    args = parser.parse_args()
    predict = Predictor(args.file, args.longest)
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.pictures:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            parser.error(f"{path} is no picture")
        image = np.ascontiguousarray(image[..., ::-1])
        cv2.imwrite(str(args.out / f"{path.stem}.png"), coloured(image, predict(image))[..., ::-1])


if __name__ == "__main__":
    main()
