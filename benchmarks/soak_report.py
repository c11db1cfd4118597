"""Result of a soak test: CSV, plot, table and verdict."""

from __future__ import annotations

import csv
import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MAX_GROWTH = 0.05  # of the memory, from the end of the warm-up to the end of the run
MAX_P99_MS = 10.0  # of the callbacks while the worker is busy
BUSY = 0.3  # worker load above which a sample counts as busy
WARM_UP, WARM_UP_KEYFRAMES = 0.1, 60  # share of the run, and keyframes: until the buffer has been full for a while


@dataclass(frozen=True)
class Sample:
    """The node at one moment. rss_mb: resident memory; shared_mb: the part of it shared with other processes."""

    wall_s: float
    data_min: float
    rss_mb: float
    shared_mb: float
    rate: float
    pairs: int
    left_out: int
    keyframes: int
    accepted: int
    load: float
    callback_p99_ms: float
    errors: int


@dataclass
class Run:
    """All samples, and what came at the end. sent, received: messages per topic. asked, answered: calls of ~/calibrate."""

    source: str
    samples: list[Sample] = field(default_factory=list)
    sent: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)
    asked: int = 0
    answered: int = 0
    accepted: int = 0
    refused: int = 0
    error_deg: float = float("nan")
    error_m: float = float("nan")
    answer: str = ""
    last_error: str = ""
    tracebacks: int = 0

    def warm_up_min(self) -> float:
        """Minutes of data after which the memory should stay as it is; half of a run that is too short to tell."""
        end = self.samples[-1].data_min
        full = next((s.data_min for s in self.samples if s.keyframes >= WARM_UP_KEYFRAMES), end)
        return min(max(WARM_UP * end, full), 0.5 * end)

    def memory(self) -> tuple[float, float]:
        """MB after the warm-up and at the end: medians over a tenth of the run each."""
        at = np.array([s.data_min for s in self.samples])
        rss = np.array([s.rss_mb for s in self.samples])
        start, tenth = self.warm_up_min(), at[-1] / 10
        after, end = (at >= start) & (at <= start + tenth), at >= at[-1] - tenth
        return float(np.median(rss[after])) if after.any() else float(rss[0]), float(np.median(rss[end]))

    def growth(self) -> float:
        """Share by which the memory grew after the warm-up."""
        start, end = self.memory()
        return end / start - 1

    def callback_p99_ms(self) -> tuple[float, float]:
        """Of the node's own figures (99th percentile of its last 2000 callbacks) under load: the median and the worst."""
        busy = [s.callback_p99_ms for s in self.samples if s.load > BUSY and s.data_min >= self.warm_up_min()]
        return (float(np.median(busy)), max(busy)) if busy else (float("nan"), float("nan"))

    def problems(self) -> list[str]:
        """What must not be."""
        found = []
        if self.growth() > MAX_GROWTH:
            found.append(f"memory grew by {100 * self.growth():.1f} %")
        if self.answered < self.asked:
            found.append(f"{self.asked - self.answered} of {self.asked} estimates were never answered")
        if not self.accepted:
            found.append("no estimate was accepted")
        if self.callback_p99_ms()[0] > MAX_P99_MS:
            found.append(f"callbacks take {self.callback_p99_ms()[0]:.1f} ms (99th percentile) while the worker is busy")
        if self.tracebacks:
            found.append(f"the node printed {self.tracebacks} tracebacks")
        return found

    def table(self) -> str:
        """As Markdown."""
        last, (start, end) = self.samples[-1], self.memory()
        median, worst = self.callback_p99_ms()
        rows = [
            ("pairs, data time", f"{last.pairs}, {last.data_min:.1f} min"),
            ("wall time, pairs per s", f"{last.wall_s / 60:.1f} min, {last.pairs / max(last.wall_s, 1e-9):.1f}"),
            *((f"{topic}: sent, received", f"{n}, {self.received.get(topic, 0)}") for topic, n in self.sent.items()),
            ("pairs left out by a busy worker", f"{last.left_out} ({100 * last.left_out / max(last.pairs, 1):.1f} %)"),
            ("keyframes", str(last.keyframes)),
            ("estimates accepted, refused", f"{self.accepted}, {self.refused}"),
            ("~/calibrate asked, answered", f"{self.asked}, {self.answered}"),
            (
                f"memory after the warm-up ({self.warm_up_min():.1f} min), at the end",
                f"{start:.1f} MB, {end:.1f} MB ({100 * self.growth():+.1f} %), {last.shared_mb:.0f} MB of it shared",
            ),
            ("callbacks under load, 99th percentile", f"{median:.2f} ms, worst of 2000 callbacks {worst:.2f} ms"),
            ("worker load, mean", f"{np.mean([s.load for s in self.samples]):.2f}"),
            ("errors reported, the last", f"{last.errors}, {self.last_error or 'none'}"),
            ("answer at the end", self.answer),
            ("against the reference", f"{self.error_deg:.3f} deg, {100 * self.error_m:.2f} cm"),
        ]
        return "\n".join([f"| {self.source} | |", "|---|---|", *(f"| {a} | {b} |" for a, b in rows)])

    def write(self, folder: Path) -> None:
        """soak.csv and soak.png."""
        with (folder / "soak.csv").open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow([f.name for f in dataclasses.fields(Sample)])
            writer.writerows(dataclasses.astuple(s) for s in self.samples)
        self._plot(folder / "soak.png")

    def _plot(self, path: Path) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8, 6), dpi=140, layout="constrained")
        at = [s.data_min for s in self.samples]
        rows = {
            "memory, MB": [s.rss_mb for s in self.samples],
            "pairs per s": [s.rate for s in self.samples],
            "worker load": [s.load for s in self.samples],
            "callbacks p99, ms": [s.callback_p99_ms for s in self.samples],
        }
        for axes, (name, values) in zip(figure.subplots(len(rows), 1, sharex=True), rows.items(), strict=True):
            axes.plot(at, values, lw=1.2)
            axes.set_ylim(0, None)
            axes.set_ylabel(name, fontsize=8)
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("data time, min")
        figure.suptitle(self.source, fontsize=9)
        figure.savefig(path)
