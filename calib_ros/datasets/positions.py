"""Which frames of a source are used."""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.errors import BadInputError


def frame_positions(text: str, count: int) -> list[int]:
    """'all', '0,4,8' or '0:100:5' (0-based, end excluded, as Python slices) -> positions in a source of `count` frames.

    BadInputError for other text, positions out of range, or an empty selection.
    """
    advice = "give all, a list like 0,4,8 or a range like 0:100:5"
    try:
        if text == "all":
            positions: Sequence[int] = range(count)
        elif ":" in text:
            parts = [int(part) if part.strip() else None for part in text.split(":")]
            if len(parts) > 3:
                raise ValueError
            positions = range(count)[slice(*parts)]
        else:
            positions = [int(part) for part in text.split(",")]
    except ValueError:
        raise BadInputError(f"--frames {text}: {advice}") from None
    wrong = [i for i in positions if not 0 <= i < count]
    if wrong:
        raise BadInputError(f"--frames {text}: position {wrong[0]} is outside 0..{count - 1} of this source")
    if not positions:
        raise BadInputError(f"--frames {text} selects none of the {count} frames; {advice}")
    return list(positions)


def spread_positions(number: int, count: int) -> list[int]:
    """Positions of about so many frames, evenly spread over a source of `count` frames; all if there are no more."""
    if number >= count:
        return list(range(count))
    return [int((k + 0.5) * count / number) for k in range(number)]
