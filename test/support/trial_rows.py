"""Rows of the table of trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from calib_ros_evaluation.results import END, SCORES, START, trials_table


def row(end: Sequence[float] = (0, 0, 0, 0, 0, 0), **changes: Any) -> dict[str, Any]:
    """A trial that ended at `end`, deg and m, with errors to match."""
    known = {"experiment": "single", "method": "ours", "scene": "drive", "frames": "0"}
    known |= {"start_deg": 2.0, "start_m": 0.2, "seed": 0}
    known |= {"status": "done", "reason": "", "start_rotation_deg": 2.0, "start_translation_m": 0.2}
    known |= {"rotation_deg": float(np.linalg.norm(end[:3])), "translation_m": float(np.linalg.norm(end[3:]))}
    known |= dict(zip((*END, *START, *SCORES), (*map(float, end), 2.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.1, 0.2, np.nan), strict=True))
    return known | {"evaluations": 100, "cpu_s": 1.0, "features_cpu_s": 0.5} | changes


def table(*rows: dict[str, Any], **limits: float) -> pd.DataFrame:
    return trials_table(rows, **limits)
