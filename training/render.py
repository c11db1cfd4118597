"""Renders training pictures of random worlds: python -m training.render --out FOLDER. Called again, it goes on.

Writes FOLDER/images/NUMBER.jpg and FOLDER/labels/NUMBER.png. A picture depends on the seed and its number only.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from training.world.picture import picture_of

DIGITS = 6  # of a picture's name
PICTURES = 3600  # what the free weights were trained on
QUALITY = (60, 96)  # of JPEG, each picture its own


def write(folder: Path, seed: int, number: int, scale: float = 1.0) -> bool:
    """Renders a picture, unless both of its files exist -> whether it did. A stop in between leaves no half-written file."""
    targets = folder / "images" / f"{number:0{DIGITS}}.jpg", folder / "labels" / f"{number:0{DIGITS}}.png"
    if all(target.exists() for target in targets):
        return False
    image, labels = picture_of(seed, number, scale)
    quality = int(np.random.default_rng([seed, number, 78]).integers(*QUALITY))
    for target, data, options in zip(targets, (image, labels), ([cv2.IMWRITE_JPEG_QUALITY, quality], []), strict=True):
        new = target.with_suffix(f".new{target.suffix}")
        if not cv2.imwrite(str(new), data, options):
            raise OSError(f"{new} cannot be written")
        os.replace(new, target)
    return True


def render(folder: Path, seed: int, numbers: Iterable[int], processes: int, scale: float = 1.0) -> None:
    """Renders the pictures with these numbers; scale: factor on their sizes. ValueError if the folder holds others."""
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    note, mine = folder / "seed.txt", f"seed {seed} scale {scale:g}\n"
    if note.exists() and note.read_text() != mine:
        raise ValueError(f"{folder} holds pictures of {note.read_text().strip()}; use that, or another --out")
    note.write_text(mine)
    todo, one = list(numbers), partial(write, folder, seed, scale=scale)
    if processes == 1:
        cv2.setNumThreads(1)
        for number in tqdm(todo, unit="picture"):
            one(number)
        return
    with ProcessPoolExecutor(processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for _ in tqdm(pool.map(one, todo, chunksize=4), total=len(todo), unit="picture"):
            pass


def main() -> None:
    """Renders what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True, type=Path, help="folder of images/ and labels/")
    parser.add_argument("--pictures", type=int, default=PICTURES)
    parser.add_argument("--seed", type=int, default=1, help="0 or more")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    if args.pictures < 1 or args.processes < 1 or args.seed < 0:
        parser.error("--pictures and --processes must be 1 or more, --seed 0 or more")
    if args.out.exists() and not args.out.is_dir():
        parser.error(f"--out {args.out} is a file; name a folder")
    try:
        render(args.out, args.seed, range(args.pictures), args.processes)
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
