"""What is asked of a fleet, and what comes of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError
from calib_ros_check.fleet.certificates import Certificate
from calib_ros_check.fleet.changes import FALSE_ALARMS
from calib_ros_check.fleet.history import ERROR, VERDICTS, Row, Vehicle, VehicleChange
from calib_ros_check.outcome import CheckVerdict
from calib_ros_check.recording import CheckOptions


@dataclass(frozen=True)
class FleetOptions:
    """How a fleet is checked.

    sources: recordings, and folders of them. out: folder for tables, page and journal. options: of each check.
    vehicle_pattern: see `find_recordings`. false_alarms: changes reported per recording where there is none. workers:
    processes; None = one per core. scheduler: address of a Dask cluster instead. fresh: forget earlier answers. certified: frames
    of each calibration in a recording, where calibrations are certified, as vehicles; None = they are not.

    BadInputError for a number out of range.
    """

    sources: Sequence[str]
    out: Path
    options: CheckOptions = field(default_factory=CheckOptions)
    vehicle_pattern: str | None = None
    false_alarms: float = FALSE_ALARMS
    workers: int | None = None
    scheduler: str = ""
    fresh: bool = False
    certified: int | None = None

    def __post_init__(self) -> None:
        for option, value in (("--workers", self.workers), ("--frames", self.certified)):
            if value is not None and value < 1:
                raise BadInputError(f"{option} {value}: give at least 1")
        if not 0 < self.false_alarms < 0.5:
            raise BadInputError(f"--false-alarms {self.false_alarms:g} is out of range (0, 0.5) per recording")


@dataclass(frozen=True, eq=False)
class Fleet:
    """vehicles: in the order of the tables. variances: (6,) between recordings beyond those of the checks, rad^2 and m^2.
    certificates: of the vehicles, if these are calibrations. files: what was written. notes: for people."""

    vehicles: Sequence[Vehicle]
    variances: Matrix
    certificates: Sequence[Certificate] = ()
    files: Sequence[Path] = ()
    notes: Sequence[str] = ()

    @property
    def rows(self) -> list[Row]:
        """All recordings, by vehicle and time."""
        return [row for own in self.vehicles for row in own.rows]

    @property
    def changes(self) -> list[VehicleChange]:
        """Of all vehicles, by time."""
        return sorted((one for own in self.vehicles for one in own.changes), key=lambda one: one.after.time_ns)

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of certificates, or recordings, by verdict, what wants attention first."""
        counted = Counter(own.verdict for own in self.certificates or self.rows)
        return {verdict: counted[verdict] for verdict in VERDICTS}

    @property
    def exit_code(self) -> int:
        """0 all pass, 1 any fails, 3 none fails and any is inconclusive or could not be checked, 2 none could be checked."""
        found = {verdict for verdict, count in self.counts.items() if count}
        if found <= {ERROR}:
            return 2
        if CheckVerdict.FAIL.value in found:
            return 1
        return 0 if found == {CheckVerdict.PASS.value} else 3
