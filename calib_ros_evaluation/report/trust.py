"""How well the share of worse neighbours tells wrong calibrations (Levinson and Thrun 2013)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros_evaluation.methods.levinson import Distribution, fitted, probability_right
from calib_ros_evaluation.report.tables import Cell, Rows, Table, number, percent, table
from calib_ros_evaluation.results import Trust

Matrix = NDArray[np.float64]
FALSE_ALARMS = 0.05
TOGETHER = 5  # frames whose shares are averaged
DRAWS = 200  # sets of as many frames
TRUST = (
    "Levinson and Thrun judge an extrinsic by the share F_C of its 728 neighbours, one step away along any of the axes, that "
    "score less: 1 at the peak of a good score, one half where nothing fits. From how F_C is distributed where the extrinsic is "
    "known to be right, and where it is known to be wrong, follows the probability that it is right. How this project tells, by "
    "other means, stands in docs/online.md."
)


def detection(trusts: Sequence[Trust]) -> Table:
    """For each size of error: how well F_C of one frame, and its mean over some, tell it from no error."""
    right = np.array([t.right for t in trusts])
    sizes = list(dict.fromkeys((deg, m) for t in trusts for deg, m, _ in t.wrong))
    rows: Rows = []
    for deg, m in sizes:
        wrong = np.array([[share for d, x, share in t.wrong if (d, x) == (deg, m)] for t in trusts])
        one = area(right, wrong.ravel()), hits(right, wrong.ravel())
        rng = np.random.default_rng(0)
        sets = [rng.choice(len(trusts), min(TOGETHER, len(trusts)), replace=False) for _ in range(DRAWS)]
        ways = rng.integers(wrong.shape[1], size=DRAWS)
        of_right = np.array([right[s].mean() for s in sets])
        of_wrong = np.array([wrong[s, way].mean() for s, way in zip(sets, ways, strict=True)])
        several = area(of_right, of_wrong), hits(of_right, of_wrong)
        size = f"{deg:g} deg" if deg else f"{100 * m:g} cm"
        cells: list[Cell | str] = [size, number(float(wrong.mean()), 3)]
        cells += [f(x) for x, f in zip((*one, *several), (_area, percent, _area, percent), strict=True)]
        rows.append([*cells, percent(called_right(trusts, (deg, m)))])
    never = percent(called_right(trusts, None))
    rows.insert(0, ["none", number(float(right.mean()), 3), *["–"] * 4, never])
    title = f"What the share of worse neighbours tells, {len(trusts)} frames"
    header = ["error", "mean F_C", "AUC, 1 frame", "hits", f"AUC, {TOGETHER} frames", "hits", "called right"]
    notes = [
        "AUC: area under the ROC curve of F_C against no error; 0.5 is chance. Hits: share of wrong ones found at 5 % false "
        "alarms.",
        f"With {TOGETHER} frames: mean of F_C, {DRAWS} sets of frames of any scene, all off by the same error.",
        "Called right: share of frames whose probability to be right exceeds one half, both distributions learned from all other "
        "frames and all errors together.",
    ]
    return table(title, header, rows, notes=notes)


def _area(value: float) -> Cell:
    return number(value, 2)


def area(right: ArrayLike, wrong: ArrayLike) -> float:
    """Probability that a wrong one has the lower share, ties counted half."""
    R, W = np.asarray(right, float), np.asarray(wrong, float)
    return float(np.mean((R[:, None] > W) + 0.5 * (R[:, None] == W)))


def hits(right: ArrayLike, wrong: ArrayLike) -> float:
    """Share of wrong ones below the threshold that FALSE_ALARMS of the right ones are below."""
    R, W = np.asarray(right, float), np.asarray(wrong, float)
    alarms = int(np.floor(FALSE_ALARMS * len(R)))
    return float(np.mean(np.sort(R)[alarms] > W))


def called_right(trusts: Sequence[Trust], size: tuple[float, float] | None) -> float:
    """Share of frames, at an error of this size (None = at none), that are taken for right; each by what the others teach. NaN
    for fewer than three frames."""
    if len(trusts) < 3:
        return float("nan")
    said: list[bool] = []
    for k, own in enumerate(trusts):
        R, W = _learned([t for n, t in enumerate(trusts) if n != k])
        shares = [own.right] if size is None else [share for deg, m, share in own.wrong if (deg, m) == size]
        said += [probability_right([share], R, W) > 0.5 for share in shares]
    return float(np.mean(said))


def _learned(trusts: Sequence[Trust]) -> tuple[Distribution, Distribution]:
    return fitted([t.right for t in trusts]), fitted([share for t in trusts for _, _, share in t.wrong])
