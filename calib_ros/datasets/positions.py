"""Which frames of a source are used."""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.errors import BadInputError

ADVICE = "give all, a list like 0,4,8 or a range like 0:100:5"


def frame_positions(text: str, count: int) -> list[int]:
    """'all', '0,4,8' or '0:100:5' (0-based, end excluded, as Python slices) -> positions in a source of `count` frames.
    BadInputError for other text, positions out of range or named twice, or an empty selection."""
    selection = selected(text)
    positions: Sequence[int] = range(count)[selection] if isinstance(selection, slice) else selection
    wrong = [i for i in positions if not 0 <= i < count]
    if wrong:
        raise BadInputError(f"--frames {text}: position {wrong[0]} is outside 0..{count - 1} of this source")
    if not positions:
        raise BadInputError(f"--frames {text} selects none of the {count} frames; {ADVICE}")
    return list(positions)


def selected(text: str) -> slice | list[int]:
    """What a text says, whatever the source. BadInputError where it selects frames of none."""
    try:
        if text == "all":
            return slice(None)
        if ":" in text:
            parts = [int(part) if part.strip() else None for part in text.split(":")]
            if len(parts) > 3 or parts[2:] == [0]:
                raise ValueError
            return slice(*parts)
        listed = [int(part) for part in text.split(",")]
    except ValueError:
        raise BadInputError(f"--frames {text}: {ADVICE}") from None
    twice = [k for k in listed if listed.count(k) > 1]
    if twice:  # it would count as independent evidence
        raise BadInputError(f"--frames {text}: position {twice[0]} is named twice; name each frame once")
    return listed


def spread_positions(number: int, count: int) -> list[int]:
    """Positions of about so many frames, evenly spread over a source of `count` frames; all if there are no more."""
    if number >= count:
        return list(range(count))
    return [int((k + 0.5) * count / number) for k in range(number)]
