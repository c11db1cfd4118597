"""Trains the image network: python -m training.train --data FOLDER --out FOLDER. Called again, it resumes.

The data are rendered pictures (training.render).
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset

from training.augment import SHAPES, training_crop
from training.data import NAMES, VOID, Pair, Pictures, class_weights, iou, samples
from training.network import Network, parameters_of
from training.predict import classes_of, run_of

AUXILIARY = 0.3  # weight of the auxiliary head's loss
WEIGHT_DECAY = 0.01
STEEPEST = 5.0  # norm of the gradient above which a step is shortened: one odd batch must not undo an epoch
CHECKED = 5  # epochs from one look at the validation pictures to the next


@dataclass(frozen=True)
class Settings:
    """What a training run depends on, besides the data.

    decay: per step, of the averaged weights: 0.998 is over the last 500 steps; fewer for a shorter run.
    """

    epochs: int = 80
    batch: int = 8
    rate: float = 4e-3
    decay: float = 0.998
    seed: int = 1


class Batches(Dataset[tuple[Tensor, Tensor]]):
    """The batches of an epoch: pictures (n, 3, H, W) and labels (n, H, W), uint8, one shape of SHAPES per batch.

    Each depends on seed, epoch and number only, whichever process makes it.
    """

    def __init__(self, pictures: Sequence[Pair], settings: Settings, epoch: int) -> None:
        self._pictures, self._batch, self._key = pictures, settings.batch, (settings.seed, epoch)
        self._order = np.random.default_rng(self._key).permutation(len(pictures))

    def __len__(self) -> int:
        return len(self._pictures) // self._batch

    def __getitem__(self, number: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng((*self._key, number))
        size = SHAPES[int(rng.integers(len(SHAPES)))]
        chosen = self._order[number * self._batch : (number + 1) * self._batch]
        crops = [training_crop(self._pictures, int(k), size, rng) for k in chosen]
        images = np.stack([image for image, _ in crops]).transpose(0, 3, 1, 2)
        return torch.from_numpy(np.ascontiguousarray(images)), torch.from_numpy(np.stack([labels for _, labels in crops]))


class Run:
    """A training run, its state in last.pt of a folder. ValueError if the folder holds a run with other settings."""

    def __init__(self, pictures: Sequence[Pair], settings: Settings, folder: Path, workers: int = 1) -> None:
        self.settings, self._pictures, self._workers = settings, pictures, workers
        self._file = folder / "last.pt"
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._weights = torch.from_numpy(class_weights(labels for _, labels in pictures)).to(self._device)
        torch.manual_seed(settings.seed)
        self.network = Network().to(self._device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = torch.optim.swa_utils.AveragedModel(
            self.network, avg_fn=partial(_averaged, settings.decay), use_buffers=True
        )
        plain = [p for p in self.network.parameters() if p.ndim == 1]  # biases and norms
        filters = [p for p in self.network.parameters() if p.ndim > 1]
        self._optimizer = torch.optim.AdamW(
            [{"params": filters, "weight_decay": WEIGHT_DECAY}, {"params": plain, "weight_decay": 0.0}], settings.rate
        )
        steps = settings.epochs * (len(pictures) // settings.batch)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(self._optimizer, settings.rate, steps, pct_start=0.15)
        self._parts: dict[str, Any] = {"network": self.network, "average": self.average.module}
        self._parts |= {"optimizer": self._optimizer, "schedule": self._schedule}
        self.epoch = 0
        if self._file.exists():
            self._load()

    def train_epoch(self) -> float:
        """One more epoch; the mean loss of its steps."""
        torch.manual_seed(self.settings.seed + self.epoch)  # of the dropout: the same whether it was stopped in between or not
        batches = Batches(self._pictures, self.settings, self.epoch)
        self.network.train()
        losses = []
        loader = DataLoader(batches, batch_size=None, num_workers=self._workers, worker_init_fn=_one_thread)
        for images, labels in loader:
            loss = self._loss(images.to(self._device), labels.to(self._device).long())
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), STEEPEST)
            self._optimizer.step()
            self._schedule.step()
            self.average.update_parameters(self.network)
            losses.append(float(loss.detach()))
            if not np.isfinite(losses[-1]):
                raise ValueError(f"the loss of epoch {self.epoch + 1} has become {losses[-1]}; take a smaller --rate")
        self.epoch += 1
        return float(np.mean(losses))

    def iou(self, pairs: Sequence[Pair]) -> np.ndarray[Any, np.dtype[np.float64]]:
        """IoU (11,) of the averaged weights."""
        run = run_of(self.average.module.eval())
        return iou(lambda image: classes_of(run, image), pairs)

    def save(self) -> None:
        """Writes last.pt; a stop in between leaves the one before."""
        state = {"settings": asdict(self.settings), "epoch": self.epoch, "averaged": self.average.n_averaged}
        state |= {name: part.state_dict() for name, part in self._parts.items()}
        self._file.parent.mkdir(parents=True, exist_ok=True)
        new = self._file.with_suffix(".new")
        torch.save(state, new)
        os.replace(new, self._file)

    def _load(self) -> None:
        state = torch.load(self._file, map_location=self._device, weights_only=True)
        if state["settings"] != asdict(self.settings):
            raise ValueError(f"{self._file} is of a run with {state['settings']}; use these, or another --out")
        self.epoch = state["epoch"]
        self.average.n_averaged.copy_(state["averaged"])
        for name, part in self._parts.items():
            part.load_state_dict(state[name])

    def _loss(self, images: Tensor, labels: Tensor) -> Tensor:
        images = images.contiguous(memory_format=torch.channels_last)
        scores, auxiliary = self.network(images)
        return self._entropy(scores, labels) + AUXILIARY * self._entropy(auxiliary, labels[:, 4::8, 4::8])

    def _entropy(self, scores: Tensor, labels: Tensor) -> Tensor:
        if scores.shape[2:] != labels.shape[1:]:  # as whoever uses the network enlarges its scores
            scores = functional.interpolate(scores, size=labels.shape[1:], mode="bilinear", align_corners=False)
        return functional.cross_entropy(scores, labels, self._weights, ignore_index=VOID)


def _averaged(decay: float, average: Tensor, new: Tensor, count: Tensor | int) -> Tensor:
    """Exponential mean of the weights, shorter at the start. Counters of batch norms are taken as they are."""
    if not new.is_floating_point():
        return new
    return average + (new - average) * (1 - min(decay, (1 + int(count)) / (10 + int(count))))


def _one_thread(_: int) -> None:
    cv2.setNumThreads(1)


def main() -> None:
    """Trains, one line per epoch."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, type=Path, help="folder of rendered pictures")
    parser.add_argument("--out", required=True, type=Path, help="folder of last.pt")
    for name, default in asdict(Settings()).items():
        parser.add_argument(f"--{name}", type=type(default), default=default)
    parser.add_argument("--threads", type=int, default=2, help="CPU threads")
    parser.add_argument("--workers", type=int, default=1, help="processes that make pictures; 0 = none of their own")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(1)
    settings = Settings(**{name: getattr(args, name) for name in asdict(Settings())})
    try:
        held_out, pictures = (Pictures(samples(args.data, held)) for held in (True, False))
        run = Run(pictures, settings, args.out, args.workers)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    print(f"{parameters_of(run.network)} parameters, {len(pictures)} pictures, from epoch {run.epoch}", flush=True)
    while run.epoch < settings.epochs:
        start = time.monotonic()
        loss = run.train_epoch()
        run.save()
        print(f"epoch {run.epoch}/{settings.epochs} loss {loss:.3f} {time.monotonic() - start:.0f} s", flush=True)
        if run.epoch % CHECKED == 0 or run.epoch == settings.epochs:
            found = run.iou(held_out)
            each = " ".join(f"{name} {value:.2f}" for name, value in zip(NAMES, found, strict=True))
            print(f"  mIoU of held-out pictures {np.nanmean(found):.3f} ({each})", flush=True)


if __name__ == "__main__":
    main()
