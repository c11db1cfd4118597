"""Choices of the command line: which frames, which initial extrinsic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros import result
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.registration.initial_guess import SEMANTIC, nominal


def frame_positions(text: str, count: int) -> list[int]:
    """'all', '0,4,8' or '0:100:5' (0-based, end excluded, as Python slices) -> positions in a source of `count` frames.

    BadInputError for text that is neither, positions out of range, or an empty choice.
    """
    advice = "give all, a list like 0,4,8 or a range like 0:100:5"
    try:
        if text == "all":
            chosen: Sequence[int] = range(count)
        elif ":" in text:
            parts = [int(part) if part.strip() else None for part in text.split(":")]
            if len(parts) > 3:
                raise ValueError
            chosen = range(count)[slice(*parts)]
        else:
            chosen = [int(part) for part in text.split(",")]
    except ValueError:
        raise BadInputError(f"--frames {text}: {advice}") from None
    wrong = [i for i in chosen if not 0 <= i < count]
    if wrong:
        raise BadInputError(f"--frames {text}: position {wrong[0]} is outside 0..{count - 1} of this source")
    if not chosen:
        raise BadInputError(f"--frames {text} chooses none of the {count} frames; {advice}")
    return list(chosen)


def initial_extrinsic(text: str, source: Source, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    """'nominal', 'reference' or a result file -> T_camera_lidar (4, 4). BadInputError if it is not to be had.

    'semantic', where nothing is known, counts as nominal until the classes of the scenes have told.
    """
    if text in ("nominal", SEMANTIC):
        return nominal(yaw_deg)
    if text == "reference":
        if source.reference is None:
            raise BadInputError(f"{source.name} states no reference extrinsic; use --initial nominal or a result file")
        return source.reference
    return result.load(text).T_camera_lidar
