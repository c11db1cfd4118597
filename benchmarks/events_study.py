"""Replays a drive with events: drift, displaced mount, covered lens, lost clouds, late camera, empty road.

    python -m benchmarks.events_study [SOURCE] [--out DIR] [--seconds 180]

SOURCE: a synthetic drive (by default one at 10 Hz; what its text leaves out is added), or a recording, which is played there
and back until the time is full. Each frame is processed as by `calib-ros replay`, and estimates take no time of the drive. The
start is the truth, turned by 1 deg and moved by 5 cm. Writes moments.png, and prints how soon each event was noticed and dealt
with, and how often a wrong extrinsic was called converged.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from tqdm import tqdm

from benchmarks.events import Event, EventSource, default_events
from benchmarks.events_recorded import ThereAndBack
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.result import CONVERGED
from calib_ros_synthetic.scanners import PERIOD

SYNTHETIC = {"seed": "11", "stride": "1", "width": "828", "height": "250", "rings": "64"}
OF_THE_RIG = ("width", "height", "rings")
START_DEG, START_M = 1.0, 0.05
WRONG_DEG, WRONG_CM = 0.5, 10.0  # a publication farther off must not be called converged
RIGHT_DEG, RIGHT_CM = 0.3, 6.0  # recovered
HOLD_S = 5.0  # and for so long
AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
UNIT = np.r_[np.full(3, np.rad2deg(1.0)), np.full(3, 100.0)]  # rad, m -> deg, cm
COLOURS = {
    "converged": "tab:green", "suspect": "tab:orange", "moved": "tab:red", "blinded": "tab:purple", "initial": "tab:blue",
    "refused": "tab:brown", "insufficient": "tab:gray", "tentative": "tab:cyan",
}  # fmt: skip
SHADES = ("0.93", "0.87")
LEAST = (0.3, 3.0)  # deg, cm; half the height of an axis at least
PERCENTILE = 98  # of the values that an axis must hold: a lost minute at the start would flatten all others


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame. true, published: (6,) deg and cm, left perturbations of the extrinsic at the start of the drive; sigma likewise,
    NaN if unknown. deg, cm: the error as calib-ros counts it. estimate: one was made here. news: that, or another status."""

    time: float
    true: np.ndarray
    published: np.ndarray
    sigma: np.ndarray
    status: str
    deg: float
    cm: float
    estimate: bool
    news: bool

    @property
    def ok(self) -> bool:
        """The published extrinsic claims to be right."""
        return self.status == CONVERGED

    @property
    def wrong(self) -> bool:
        """It claims so and is not."""
        return self.ok and (self.deg > WRONG_DEG or self.cm > WRONG_CM)

    @property
    def right(self) -> bool:
        """It claims so and is."""
        return self.ok and self.deg < RIGHT_DEG and self.cm < RIGHT_CM


def record(source: EventSource, recalibrator: Recalibrator) -> tuple[list[Moment], float]:
    """Every frame in turn, with an estimate at once wherever there is something new -> moments, and CPU s of all that."""
    assert source.reference is not None
    start = se3.inverse(source.reference)
    moments: list[Moment] = []
    used = 0.0
    for i in tqdm(range(len(source)), "replaying", leave=False):
        frame = source[i]
        began = time.process_time()
        with contextlib.suppress(CalibrationError):  # a frame that cannot be used
            recalibrator.ingest(frame)
        if estimate := recalibrator.ready():
            recalibrator.estimate()
        used += time.process_time() - began
        result, truth = recalibrator.current.result, frame.reference
        assert truth is not None
        T, covariance = result.T_camera_lidar, result.covariance
        news = estimate or not moments or result.status != moments[-1].status
        moments.append(
            Moment(
                float(source.times[i]), UNIT * se3.log(truth @ start), UNIT * se3.log(T @ start),
                np.full(6, np.nan) if covariance is None else UNIT * np.sqrt(np.diag(covariance)),
                result.status, se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T), estimate, news,
            )
        )  # fmt: skip
    return moments, used


def alarm(moments: Sequence[Moment], event: Event, until: float) -> str:
    """s from the start of an event to the first status that is not converged."""
    inside = [m for m in moments if event.start <= m.time < until]
    before = [m for m in moments if m.time < event.start]
    if before and not before[-1].ok:
        return f"was {before[-1].status}"
    return next((f"{m.time - event.start:.1f} s, {m.status}" for m in inside if not m.ok), "none")


def recovery(moments: Sequence[Moment], event: Event) -> str:
    """s from the end of an event until the extrinsic was right and stayed so for HOLD_S, or to the end."""
    after = [m for m in moments if m.time >= event.end]
    since: float | None = None
    for m in after:
        since = (m.time if since is None else since) if m.right else None
        if since is not None and m.time - since >= HOLD_S:
            break
    return "-" if not after else "never" if since is None else f"{since - event.end:.1f} s"


def table(moments: Sequence[Moment], events: Sequence[Event]) -> str:
    """One line per event."""
    lines = ["| event | alarm after | right again after its end | worst while converged |", "|---|---|---|---|"]
    for event in events:
        later = [e.start for e in events if e.start > event.start]
        until = max(event.end, min(later, default=np.inf))
        claimed = [m for m in moments if event.start <= m.time < until and m.ok]
        deg, cm = max((m.deg for m in claimed), default=np.nan), max((m.cm for m in claimed), default=np.nan)
        lines.append(
            f"| {event.describe()} | {alarm(moments, event, until)} | {recovery(moments, event)} | {deg:.2f} deg, {cm:.1f} cm |"
        )
    return "\n".join(lines)


def verdict(moments: Sequence[Moment], events: Sequence[Event]) -> str:
    """How often a wrong extrinsic was called converged: publications, and frames during which it was current."""
    lines = []
    for what, chosen in (("publications", [m for m in moments if m.news]), ("frames", list(moments))):
        wrong = [m for m in chosen if m.wrong]
        line = f"{what}: {len(chosen)}, converged {sum(m.ok for m in chosen)}, of these wrong {len(wrong)}"
        if wrong:
            worst = max(wrong, key=lambda m: max(m.deg / WRONG_DEG, m.cm / WRONG_CM))
            begun = [e.describe() for e in events if e.start <= worst.time]
            line += f"; worst at {worst.time:.1f} s: {worst.deg:.2f} deg, {worst.cm:.1f} cm"
            line += f", after {begun[-1]}" if begun else ", before any event"
        lines.append(line)
    first = next((m for m in moments if m.right), None)
    lines.append(f"right for the first time at {first.time:.1f} s" if first else "never right")
    return "\n".join(lines)


def plot(path: Path, title: str, moments: Sequence[Moment], events: Sequence[Event]) -> None:
    """Write a PNG."""
    figure = Figure(figsize=(17, 15), layout="constrained")
    axes = figure.subplots(4, 2, sharex=True)
    time = np.array([m.time for m in moments])
    for k, name in enumerate(AXES):
        _extrinsic(axes[k % 3, k // 3], time, moments, k)
        axes[k % 3, k // 3].set_ylabel(f"{name} {'deg' if k < 3 else 'cm'}")
    for ax, values, limit, unit in zip(
        axes[3], ([m.deg for m in moments], [m.cm for m in moments]), (WRONG_DEG, WRONG_CM), ("deg", "cm"), strict=True
    ):
        _by_status(ax, time, np.array(values), moments)
        ax.axhline(limit, color="k", lw=0.8, ls=":")
        ax.set_ylabel(f"error {unit}")
        ax.set_ylim(0, max(2.2 * limit, 1.1 * np.percentile(values, PERCENTILE)))
        ax.set_xlabel("s")
    for ax in axes.flat:
        _shade(ax, events, float(time[-1]))
        ax.set_xlim(0, time[-1])
    for ax in axes[0]:
        _label(ax, events, float(time[-1]))
    present = {m.status for m in moments}
    handles = [Line2D([], [], color=_colour(s), marker="o", ls="", label=s) for s in [*COLOURS] if s in present]
    handles += [Line2D([], [], color="k", label="true")]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle(title)
    figure.savefig(path, dpi=80)


def _colour(status: str) -> str:
    return COLOURS.get(status, "tab:pink")


def _by_status(ax: Any, time: np.ndarray, values: np.ndarray, moments: Sequence[Moment]) -> None:
    ax.plot(time, values, color="0.6", lw=0.6)
    ax.scatter(time, values, s=5, c=[_colour(m.status) for m in moments], zorder=3)


def _extrinsic(ax: Any, time: np.ndarray, moments: Sequence[Moment], k: int) -> None:
    """One axis of the perturbation, with twice its sigma on either side."""
    true, published, sigma = (np.array([getattr(m, what)[k] for m in moments]) for what in ("true", "published", "sigma"))
    ax.fill_between(time, published - 2 * sigma, published + 2 * sigma, color="tab:blue", alpha=0.25, lw=0)
    _by_status(ax, time, published, moments)
    ax.plot(time, true, color="k", lw=1.5, zorder=4)
    off = 1.3 * np.percentile(np.abs(published - true), PERCENTILE)
    half = max(LEAST[k // 3], off)
    ax.set_ylim(true.min() - half, true.max() + half)


def _shade(ax: Any, events: Sequence[Event], last: float) -> None:
    for number, event in enumerate(e for e in events if e.start <= last):
        if event.end > event.start:
            ax.axvspan(event.start, event.end, color=SHADES[number % 2], zorder=-2)
        else:
            ax.axvline(event.start, color="tab:red", lw=0.8, ls="--", zorder=-1)


def _label(ax: Any, events: Sequence[Event], last: float) -> None:
    for event in events:
        if event.start <= last:
            ax.text(event.start, 1.01, event.label, transform=ax.get_xaxis_transform(), fontsize=8, rotation=25, va="bottom")


def opened(text: str, seconds: float) -> Source:
    """The drive without events, `seconds` long."""
    if text.startswith("synthetic"):
        given = dict(re.findall(r"(\w+)\s*=\s*([^,\s]+)", text))
        # A rig has its own scanner and camera.
        values = {name: value for name, value in SYNTHETIC.items() if "rig" not in given or name not in OF_THE_RIG} | given
        values["frames"] = str(max(round(seconds / (int(values["stride"]) * PERIOD)), 1))
        return open_dataset("synthetic:" + ",".join(f"{k}={v}" for k, v in values.items()))
    return ThereAndBack(open_dataset(text), seconds)


def started(source: Source, seed: int) -> np.ndarray:
    """The extrinsic at the start of the drive, disturbed."""
    assert source.reference is not None
    rng = np.random.default_rng(seed)
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return se3.perturb(source.reference, START_DEG * axis, START_M * direction)


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="synthetic", metavar="SOURCE")
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--out", type=Path, default=Path("events_out"), metavar="DIR")
    parser.add_argument("--config", help="YAML")
    parser.add_argument("--seed", type=int, default=0, help="of the disturbed start")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        events = default_events(args.source.startswith("synthetic"))
        study(EventSource(opened(args.source, args.seconds), events), args)
    except BadInputError as error:
        parser.error(str(error))


def study(source: EventSource, args: argparse.Namespace) -> None:
    """Replay, write, print."""
    events = [e for e in source.events if e.start <= source.times[-1]]
    config = Config.from_yaml(args.config) if args.config else Config()
    start = started(source, args.seed)
    moments, used = record(source, Recalibrator(source.camera, start, config, source.camera_frame, source.lidar_frame))
    args.out.mkdir(parents=True, exist_ok=True)
    title = f"{args.source}, {moments[-1].time:.0f} s, start {START_DEG:g} deg / {100 * START_M:g} cm off (seed {args.seed})"
    plot(args.out / "moments.png", title, moments, events)
    print(table(moments, events))
    print(verdict(moments, events))
    estimates = sum(m.estimate for m in moments)
    print(f"{len(moments)} frames, {estimates} estimates, {used:.0f} s of CPU; {args.out}/moments.png")


if __name__ == "__main__":
    main()
