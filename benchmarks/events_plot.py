"""Draws a replayed drive: the true and the published extrinsic over time, their difference, and what was said about it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from benchmarks.events import Event
from benchmarks.events_record import AXES, WRONG_CM, WRONG_DEG, Moment

COLOURS = {
    "converged": "tab:green", "suspect": "tab:orange", "moved": "tab:red", "blinded": "tab:purple", "initial": "tab:blue",
    "refused": "tab:brown", "insufficient": "tab:gray",
}  # fmt: skip
SHADES = ("0.93", "0.87")
LEAST = (0.3, 3.0)  # deg, cm; half the height of an axis at least
PERCENTILE = 98  # of the values that an axis must hold: a lost minute at the start would flatten all others


def plot(path: Path, title: str, moments: Sequence[Moment], events: Sequence[Event]) -> None:
    """Write a PNG."""
    figure, axes = plt.subplots(5, 2, figsize=(17, 18), sharex=True, constrained_layout=True)
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
    _judgement(axes[4], time, moments)
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
    plt.close(figure)


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


def _judgement(axes: Any, time: np.ndarray, moments: Sequence[Moment]) -> None:
    """The p-value, and the status as a band with the keyframes and estimates below it."""
    p = np.array([m.p_value for m in moments])
    axes[0].scatter(time, np.maximum(p, 1e-12), s=5, c=[_colour(m.status) for m in moments])
    axes[0].set_yscale("log")
    axes[0].set_ylim(1e-12, 2)
    axes[0].set_ylabel("p-value")
    statuses = [*COLOURS, *sorted({m.status for m in moments} - COLOURS.keys())]
    axes[1].scatter(time, [statuses.index(m.status) for m in moments], s=8, c=[_colour(m.status) for m in moments])
    for row, name in ((-1, "keyframe"), (-2, "estimate")):
        at = [m.time for m in moments if getattr(m, name)]
        axes[1].scatter(at, [row] * len(at), s=8, c="k", marker="|")
    axes[1].set_yticks(range(-2, len(statuses)), ["estimate", "keyframe", *statuses])
    for ax in axes:
        ax.set_xlabel("s")


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
