"""What the recordings of each vehicle tell together: when its extrinsic changed, and by how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import erfcinv
from scipy.stats import chi2

from calib_ros.arrays import Covariance, Matrix
from calib_ros_check.fleet.changes import FALSE_ALARMS, Segments, segments
from calib_ros_check.fleet.rows import Row
from calib_ros_check.fleet.sequence import Extrinsics, extrinsics, scatter

MOST_SIGMAS = 38.0  # where probabilities end


@dataclass(frozen=True, eq=False)
class VehicleChange:
    """The extrinsic of a vehicle changed between two recordings.

    value: (6,), rx, ry, rz (rad) and tx, ty, tz (m): the rotation vector of R_after R_before^T and t_after - t_before, in the
    camera's axes. covariance: (6, 6). confirmed: more than one recording shows it; the last one alone may be an outlier.
    """

    vehicle: str
    before: Row
    after: Row
    value: Matrix
    covariance: Covariance
    confirmed: bool

    @property
    def rotation_deg(self) -> float:
        """Size of the turn."""
        return float(np.rad2deg(np.linalg.norm(self.value[:3])))

    @property
    def translation_m(self) -> float:
        """Size of the shift."""
        return float(np.linalg.norm(self.value[3:]))

    @property
    def sigma(self) -> Matrix:
        """(6,) standard deviations, deg and m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) * np.r_[np.rad2deg([1.0] * 3), [1.0] * 3])


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A vehicle's recordings in the order of time.

    rows: all of them. known: those with an estimate, to which `sequence` belongs, without scatter, and `segments`, with it.
    """

    name: str
    rows: Sequence[Row]
    known: Sequence[Row]
    sequence: Extrinsics
    segments: Segments
    changes: Sequence[VehicleChange]


def vehicles(
    rows: Sequence[Row], results: Mapping[str, Mapping[str, Any]], false_alarms: float = FALSE_ALARMS
) -> tuple[list[Vehicle], Matrix]:
    """Histories of all vehicles, by name, and the variances (6,) by which their recordings scatter, rad^2 and m^2.

    rows: of all recordings; their drift, and whether they changed or are outliers, is set here. results: as of
    `CheckResult.to_dict`, by path. false_alarms: changes reported per recording where there is none.
    """
    names = sorted({row.vehicle for row in rows})
    ordered = {name: sorted((r for r in rows if r.vehicle == name), key=lambda r: (r.time_ns, r.path)) for name in names}
    estimated = {path for path, own in results.items() if own and own["T_estimated"] and own["covariance"]}
    known = {name: [row for row in own if row.path in estimated] for name, own in ordered.items()}
    sequences = {
        name: extrinsics(*([results[row.path][part] for row in own] for part in ("T_estimated", "covariance")))
        for name, own in known.items()
    }
    variances = scatter(list(sequences.values()))
    out = []
    for name in names:
        sequence = sequences[name].with_scatter(variances)
        found = segments(sequence, false_alarms)
        _mark(known[name], sequence, found)
        out.append(Vehicle(name, ordered[name], known[name], sequences[name], found, _changes(name, known[name], found)))
    return out, variances


def _changes(name: str, known: Sequence[Row], found: Segments) -> list[VehicleChange]:
    newest_is_alone = np.count_nonzero(found.labels == len(found.means) - 1) == 1
    return [
        VehicleChange(name, known[own.before], known[own.after], own.value, own.covariance, not (at_end and newest_is_alone))
        for own in found.changes
        for at_end in [own.after == len(known) - 1]
    ]


def _mark(known: Sequence[Row], sequence: Extrinsics, found: Segments) -> None:
    """Set what the others tell of each recording: its drift against those since the last change before it."""
    for k, row in enumerate(known):
        row.outlier = k in found.outliers
        row.changed = any(change.after == k for change in found.changes)
        label = found.labels[k]
        earlier = [i for i in range(k) if i not in found.outliers]
        same = [i for i in earlier if found.labels[i] == label] or [i for i in earlier if found.labels[i] == label - 1]
        if not same:
            continue
        W = np.linalg.inv(sequence.covariances[same])
        C = np.linalg.inv(W.sum(axis=0))
        drift = sequence.values[k] - C @ np.einsum("nij,nj->i", W, sequence.values[same])
        square = float(drift @ np.linalg.solve(C + sequence.covariances[k], drift))
        row.drift_deg = float(np.rad2deg(np.linalg.norm(drift[:3])))
        row.drift_m = float(np.linalg.norm(drift[3:]))
        row.drift_sigma = float(np.minimum(np.sqrt(2) * erfcinv(chi2.sf(square, 6)), MOST_SIGMAS))
