"""Small plots as SVG, in the colours of the page that shows them: score curves and ellipses."""

from __future__ import annotations

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros_view.session.motion import AXES
from calib_ros_view.session.numbers import PAIRS, Known, Numbers, ellipse

WIDTH, HEIGHT, MARGIN = 200, 96, 16  # px of one plot
BAR_WIDTH, BARS = 300, 46  # px of the bars of all frames
SIDE = 140  # px of an ellipse's plot
LEAST_DEG, LEAST_CM = 0.1, 1.0  # half widths of an ellipse's plot, at least
AROUND = 1.25  # of the ellipse and the cross
FLAT = 1e-12


def curve_plots(numbers: Numbers) -> str:
    """Six curves of the score, each about the present extrinsic in the middle, with a mark at its highest place."""
    low, high = float(numbers.curves.min()), float(numbers.curves.max())
    return "".join(_curve(k, numbers, low, max(high - low, FLAT)) for k in range(6))


def ellipse_plots(known: Known) -> str:
    """Where the scenes put the extrinsic from here, with 95 %, for the pairs of axes that compensate each other."""
    return "".join(_ellipse(known, pair) for pair in PAIRS)


def frame_bars(scores: Matrix, shown: int) -> str:
    """A bar per frame with its score, up from a line at 0 or down from it; a frame without a score has none."""
    values = np.nan_to_num(np.asarray(scores, float), nan=0.0)
    low, high = min(float(values.min(initial=0.0)), 0.0), max(float(values.max(initial=0.0)), 0.0)
    per_score, step = (BARS - 2) / max(high - low, FLAT), BAR_WIDTH / max(len(values), 1)
    zero = 1 + high * per_score
    bars = []
    for k, value in enumerate(values):
        style = "var(--mark)" if k == shown else "var(--accent)"
        top, height = zero - max(value, 0) * per_score, abs(value) * per_score
        bars.append(
            f'<rect x="{k * step + 1:.1f}" y="{top:.1f}" width="{max(step - 2, 1):.1f}" height="{height:.1f}" fill="{style}">'
            f"<title>frame {k + 1}: {value:.3f}</title></rect>"
        )
    line = f'<line x1="0" x2="{BAR_WIDTH}" y1="{zero:.1f}" y2="{zero:.1f}" stroke="currentColor" stroke-width=".6"/>'
    label = 'role="img" aria-label="score of each frame"'
    return f'<svg class="plot" viewBox="0 0 {BAR_WIDTH} {BARS}" {label}>{"".join(bars)}{line}</svg>'


def _curve(k: int, numbers: Numbers, low: float, span: float) -> str:
    axis, x, y = AXES[k], numbers.offsets[k], numbers.curves[k]
    u = MARGIN + (x - x[0]) / (x[-1] - x[0]) * (WIDTH - 2 * MARGIN)
    v = HEIGHT - MARGIN - (y - low) / span * (HEIGHT - 2.2 * MARGIN)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(u, v, strict=True))
    peak, middle = int(np.argmax(y)), WIDTH / 2
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="score over {axis.title}, highest at '
        f'{x[peak]:+.2f} {axis.unit}"><line class="now" x1="{middle}" x2="{middle}" y1="{MARGIN}" y2="{HEIGHT - MARGIN}" '
        f'stroke-dasharray="3 3"/><polyline class="curve" points="{points}"/><circle cx="{u[peak]:.1f}" cy="{v[peak]:.1f}" r="3" '
        f'fill="var(--accent)"/><text x="{MARGIN}" y="11">{axis.title}</text><text x="{WIDTH - MARGIN}" y="11" '
        f'text-anchor="end">best {x[peak]:+.2f} {axis.unit}</text><text x="{MARGIN}" y="{HEIGHT - 3}">{x[0]:g}</text>'
        f'<text x="{WIDTH - MARGIN}" y="{HEIGHT - 3}" text-anchor="end">{x[-1]:+g} {axis.unit}</text></svg>'
    )


def _ellipse(known: Known, pair: tuple[int, int]) -> str:
    scale = np.array([180 / np.pi if k < 3 else 100.0 for k in pair])
    centre = known.offset[list(pair)] * scale
    border = ellipse(known.covariance, pair) + centre
    least = np.array([LEAST_DEG if k < 3 else LEAST_CM for k in pair])
    half = np.maximum(AROUND * np.abs(border).max(axis=0), least)
    at = SIDE / 2 + border / half * (SIDE / 2 - MARGIN) * [1, -1]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in at)
    one, other = (AXES[k] for k in pair)
    middle = SIDE / 2
    return (
        f'<svg class="plot" viewBox="0 0 {SIDE} {SIDE}" role="img" aria-label="{one.title} and {other.title} with 95 %">'
        f'<line class="now" x1="{middle}" x2="{middle}" y1="{MARGIN}" y2="{SIDE - MARGIN}" stroke-dasharray="3 3"/>'
        f'<line class="now" y1="{middle}" y2="{middle}" x1="{MARGIN}" x2="{SIDE - MARGIN}" stroke-dasharray="3 3"/>'
        f'<polygon class="curve" points="{points}"/><text x="{middle}" y="{SIDE - 2}" text-anchor="middle">{one.title} '
        f'±{half[0]:.2g} {one.unit}</text><text x="{middle}" y="10" text-anchor="middle">{other.title} ±{half[1]:.2g} '
        f"{other.unit}</text></svg>"
    )
