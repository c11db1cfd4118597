"""The page of a fleet: verdicts and changed vehicles first, then all recordings, then each vehicle over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from calib_ros.io import write_atomically
from calib_ros_check.fleet.history import Vehicle, VehicleChange
from calib_ros_check.fleet.page_template import TEMPLATE
from calib_ros_check.fleet.plot import HEIGHT, LEFT, RIGHT, TOP, WIDTH, plots
from calib_ros_check.fleet.rows import VERDICTS, Row
from calib_ros_check.page import page_template
from calib_ros_check.recording import CheckOptions
from calib_ros_check.tolerance import AXES
from calib_ros_check.words import amount

Matrix = NDArray[np.float64]
# A browser sorts a few thousand rows at once, and draws some hundred plots; the rest is in the CSV file.
MOST_ROWS, MOST_VEHICLES = 3000, 60
TOLD = 3.0  # standard deviations from which an axis of a change is named


def write_page(
    path: Path,
    rows: Sequence[Row],
    vehicles: Sequence[Vehicle],
    scatter: Matrix,
    options: CheckOptions,
    facts: Mapping[str, str],
    false_alarms: float,
) -> None:
    """Write the page, atomically. scatter: (6,) standard deviations between recordings, rad and m. facts: further ones for its
    head. MissingDependencyError without Jinja2."""
    counted = Counter(row.verdict for row in rows)
    shown = sorted(vehicles, key=lambda own: (not own.changes, not any(row.outlier for row in own.rows), own.name))
    changes = sorted((one for own in vehicles for one in own.changes), key=lambda one: one.after.time_ns)
    order = {verdict: k for k, verdict in enumerate(VERDICTS)}
    first = sorted(rows, key=lambda row: order[row.verdict])[:MOST_ROWS]
    count = len({row.vehicle for row in rows if row.verdict != "error"})  # a folder without anything readable is none
    listed = set(map(id, first))
    page = _template().render(
        command="check",
        title=f"Check of {len(rows)} recordings of {count} vehicle{'s' if count != 1 else ''}",
        facts={"Tolerance": f"{options.tolerance.deg:g} deg, {100 * options.tolerance.m:g} cm", "Extrinsic": options.extrinsic},
        details={**_details(rows, scatter, false_alarms), **facts},
        configuration=yaml.safe_dump(options.config.to_dict(), sort_keys=False),
        counts=[(verdict, counted[verdict]) for verdict in ("pass", "fail", "inconclusive", "error")],
        changes=changes,
        outliers=[row for row in rows if row.outlier],
        rows=[row for row in rows if id(row) in listed],
        left_out=len(rows) - len(listed),
        vehicles=[(own, plots(own, scatter**2)) for own in shown[:MOST_VEHICLES]],
        vehicles_left_out=len(shown[MOST_VEHICLES:]),
        plot={"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT, "top": TOP},
    )
    write_atomically(path, page.encode("utf-8", "backslashreplace"))


def check_page() -> None:
    """MissingDependencyError, which `write_page` would find out too late."""
    _template()


def _template() -> Any:
    return page_template(TEMPLATE, size=change_size, row=_cells, when=_when)


def _when(time: str) -> str:
    return time.replace("T", " ").rstrip("Z")


def change_size(change: VehicleChange) -> str:
    """How large a change is, and along which axes."""
    scaled = np.r_[np.rad2deg(change.value[:3]), change.value[3:]]
    clear = [k for k in range(6) if abs(scaled[k]) > TOLD * change.sigma[k]]
    axes = [
        f"{AXES[k]} {'-' if scaled[k] < 0 else '+'}{amount(scaled[k], k < 3)} ± {amount(change.sigma[k], k < 3)}" for k in clear
    ]
    sizes = f"{amount(change.rotation_deg, True)}, {amount(change.translation_m, False)}"
    return f"{sizes}: {', '.join(axes)}" if axes else sizes


def _details(rows: Sequence[Row], scatter: Matrix, false_alarms: float) -> dict[str, str]:
    turn, shift = np.rad2deg(scatter[:3]), 100 * scatter[3:]
    used = [row for row in rows if row.cpu_s]
    costs = "not measured"
    if used:
        cpu, read, peak = (
            np.array([getattr(row, name) for row in used], float) for name in ("cpu_s", "bytes_read", "peak_bytes")
        )
        costs = (
            f"{cpu.sum() / 60:.1f} min of CPU in all; per recording, median: {np.median(cpu):.1f} s of CPU, "
            f"{np.median(read) / 1e6:.0f} MB read, {np.median(peak) / 1e6:.0f} MB of memory (at most {peak.max() / 1e6:.0f})"
        )
    return {
        "Changes": f"{false_alarms:g} false alarms per recording; recordings scatter by {_three(turn)} deg and "
        f"{_three(shift)} cm (1 sigma) beyond what the checks tell",
        "Cost": costs,
    }


def _three(values: Matrix) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _cells(row: Row) -> list[tuple[str, object, str]]:
    """Text, value to sort by, and class of the cells of a row."""

    def number(value: float | None, form: str, scale: float = 1.0) -> tuple[str, object, str]:
        return ("-", "", "number") if value is None else (form.format(scale * value), scale * value, "number")

    def interval(name: str, unit: str, scale: float, digits: int) -> tuple[str, object, str]:
        known = [scale * own for end in (unit, "low", "high") if (own := row.errors[f"{name}_{end}"]) is not None]
        if not known:
            return ("-", "", "number")
        error, low, high = known
        return (f"{error:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})", error, "number")

    drift = (
        "-" if row.drift_deg is None else f"{row.drift_deg:.2f} deg, {100 * (row.drift_m or 0):.1f} cm ({row.drift_sigma:.1f} σ)"
    )
    notes = " changed" if row.changed else " outlier" if row.outlier else ""
    return [
        (row.recording, row.recording, "name"),
        (row.verdict, VERDICTS.index(row.verdict), f"verdict-{row.verdict}"),
        (row.vehicle, row.vehicle, ""),
        (_when(row.time), row.time_ns, "number"),
        ((row.cause or "-").replace("_", " "), row.cause or "", ""),
        interval("rotation", "deg", 1.0, 2),
        interval("translation", "m", 100.0, 1),
        *(number(row.errors[f"{axis}_deg"], "{:+.2f}") for axis in AXES[:3]),
        *(number(row.errors[f"{axis}_m"], "{:+.1f}", 100.0) for axis in AXES[3:]),
        number(row.time_offset_s, "{:+.1f}", 1000.0),
        (drift + notes, row.drift_sigma or 0, "number"),
        (str(row.frames), row.frames, "number"),
        number(row.cpu_s, "{:.1f}"),
        number(row.bytes_read, "{:.0f}", 1e-6),
        number(row.peak_bytes, "{:.0f}", 1e-6),
        (row.message, row.message, "words"),
    ]
