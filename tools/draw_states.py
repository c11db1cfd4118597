"""Draw the tracker's table of transitions as docs/tracker_states.svg; --check only says whether it is as the code has it."""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path

from calib_ros.online.tracker_states import TRANSITIONS, TrackerEvent, TrackerState

DRAWING = Path(__file__).parent.parent / "docs" / "tracker_states.svg"
LANE, TOP, ROW = 30, 20, 110  # px: between arrows that pass each other, above the first box, from box to box
BOX_WIDTH, BOX_HEIGHT, LINE = 240, 56, 22
STYLE = """<style>text{font:13px sans-serif;fill:#222;text-anchor:middle}.name{font-weight:bold}.box{fill:#e8eef4;stroke:#345}
.words{text-anchor:start}.move{fill:none;stroke:#345;marker-end:url(#head)}circle{fill:#fff;stroke:#345}</style>
<marker id="head" markerWidth="9" markerHeight="8" refX="8" refY="4" orient="auto">
<path d="M0 0L9 4L0 8z" fill="#345"/></marker>"""


def drawing() -> str:
    """The SVG: a box for each state; arrows that go down are on the right, the others on the left; a list of the events."""
    states, events = list(TrackerState), list(TrackerEvent)
    moves = [(states.index(before), states.index(after), events.index(event)) for (before, event), after in TRANSITIONS.items()]
    # Short arrows are nearest to the boxes.
    moves.sort(key=lambda move: (abs(move[1] - move[0]), move))
    sides = [[m for m in moves if m[1] <= m[0]], [m for m in moves if m[1] > m[0]]]
    left, bottom = LANE * (len(sides[0]) + 1), TOP + len(states) * ROW
    width, height = left + BOX_WIDTH + LANE * (len(sides[1]) + 1), bottom + LINE * len(events)
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">', STYLE]
    parts.append(f'<rect width="{width}" height="{height}" fill="#fff"/>')
    for i, state in enumerate(states):
        y, middle = TOP + i * ROW, left + BOX_WIDTH // 2
        parts.append(f'<rect class="box" x="{left}" y="{y}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="8"/>')
        parts.append(f'<text class="name" x="{middle}" y="{y + 24}">{state.name}</text>')
        parts.append(f'<text x="{middle}" y="{y + 43}">{escape(state.value)}</text>')
    for edge, direction, side in ((left, -1, sides[0]), (left + BOX_WIDTH, 1, sides[1])):
        ends = sorted((row, lane, k) for lane, move in enumerate(side) for k, row in enumerate(move[:2]))
        for lane, (start, end, event) in enumerate(side):
            heights = []
            for k, row in enumerate((start, end)):  # the ends of arrows share a box evenly
                here = [other for other in ends if other[0] == row]
                heights.append(TOP + row * ROW + BOX_HEIGHT * (here.index((row, lane, k)) + 1) // (len(here) + 1))
            x = edge + direction * LANE * (lane + 1)
            parts.append(f'<path class="move" d="M{edge} {heights[0]}H{x}V{heights[1]}H{edge}"/>')
            parts += _number(x, sum(heights) // 2, event)
    for k, words in enumerate(escape(event.value) for event in events):
        parts += _number(LANE, bottom + LINE * k, k)
        parts.append(f'<text class="words" x="{LANE + 18}" y="{bottom + LINE * k + 5}">{words}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _number(x: int, y: int, event: int) -> list[str]:
    return [f'<circle cx="{x}" cy="{y}" r="9"/>', f'<text x="{x}" y="{y + 5}">{event + 1}</text>']


def main() -> None:
    """Write the drawing, or with --check exit with 1 where it is another."""
    text = drawing()
    if "--check" in sys.argv[1:]:
        sys.exit(0 if DRAWING.read_text(encoding="utf-8") == text else f"{DRAWING.name} is out of date: run {__file__}")
    DRAWING.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
