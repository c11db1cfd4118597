"""What a page shows of a rig, whoever says it: sensors, edges with what is left of them, loops. No ROS and no web in it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.errors import BadInputError
from calib_ros.result import CONVERGED, INITIAL, MOVED, TENTATIVE
from calib_ros.rig.description import CAMERA, RigDescription
from calib_ros.rig.graph import PRIOR, SURE, RigSolution, at_sensor, root_information, worst_sigmas
from calib_ros.rig.live import UNCHECKED
from calib_ros.rig.report import REFERENCE, load
from calib_ros_view.session.live import BAD, DOUBTFUL, GOOD, NEUTRAL

USED, DOUBTED, REJECTED, FAILED = "used", "doubted", "rejected", "failed"  # what became of an edge
LEVELS = {REFERENCE: GOOD, CONVERGED: GOOD, TENTATIVE: NEUTRAL, INITIAL: NEUTRAL, PRIOR: NEUTRAL, MOVED: BAD, UNCHECKED: BAD}
FATES = {USED: GOOD, DOUBTED: DOUBTFUL, REJECTED: BAD}
EXCESS = 2.0  # standard deviations, in the mean of the six axes, from which on an edge that is used is doubtful
Pair = tuple[str, str]  # camera, LiDAR
NOT_ESTIMATED = "nothing is estimated: these are the priors; give a result of calib-ros rig --json with --initial"


@dataclass(frozen=True, eq=False)
class SensorShown:
    """T: T_reference_sensor (4, 4). sigma: standard deviations of the worst directions, deg and m; None = unknown. moved: deg and
    m of its last displacement, None = not known to have moved."""

    name: str
    kind: str
    T: Transform
    status: str
    reason: str = ""
    usable: bool = False
    sigma: tuple[float, float] | None = None
    moved: tuple[float, float] | None = None

    @property
    def level(self) -> str:
        """How good it is."""
        return LEVELS.get(self.status, DOUBTFUL)


@dataclass(frozen=True, eq=False)
class EdgeShown:
    """What was measured between two sensors. fate: what became of it, or the status of a pair. residual: deg and m of what was
    measured from the solution, None = nothing was; excess: the same in standard deviations of the edge."""

    target: str
    source: str
    kind: str
    fate: str
    level: str
    reason: str = ""
    residual: tuple[float, float] | None = None
    excess: float = 0.0


@dataclass(frozen=True)
class LoopShown:
    """A closed chain of edges, see `calib_ros.rig.graph.Loop`."""

    sensors: tuple[str, ...]
    rotation_deg: float
    translation_m: float
    p_value: float
    closes: bool


@dataclass(frozen=True, eq=False)
class RigShown:
    """text: in a line, what there is to know."""

    reference: str
    sensors: tuple[SensorShown, ...]
    edges: tuple[EdgeShown, ...] = ()
    loops: tuple[LoopShown, ...] = ()
    text: str = ""

    @property
    def poses(self) -> dict[str, Transform]:
        """T_reference_sensor (4, 4) by name."""
        return {own.name: own.T for own in self.sensors}

    @property
    def cameras(self) -> list[str]:
        """Names."""
        return [own.name for own in self.sensors if own.kind == CAMERA]

    @property
    def lidars(self) -> list[str]:
        """Names, the reference first where it is one."""
        found = [own.name for own in self.sensors if own.kind != CAMERA]
        return sorted(found, key=lambda name: name != self.reference)


def compared(edge: EdgeShown, T: Transform, C: Covariance, poses: Mapping[str, Transform]) -> EdgeShown:
    """The edge with what is left of T_target_source (4, 4), measured with a covariance, by the poses. One that is used, but lies
    far from them, is doubtful."""
    if not {edge.target, edge.source} <= poses.keys():
        return edge
    predicted = se3.inverse(poses[edge.target]) @ poses[edge.source]
    excess = float(np.sqrt(np.mean((root_information(C) @ se3.log(T @ se3.inverse(predicted))) ** 2)))
    level = DOUBTFUL if edge.level == GOOD and excess > EXCESS else edge.level
    return replace(edge, level=level, residual=se3.error(predicted, T), excess=excess)


def of_priors(description: RigDescription, solution: RigSolution) -> RigShown:
    """A rig of which only priors are known; solution: by these alone."""
    sensors = tuple(
        SensorShown(
            *(own.name, own.kind, solution.poses[own.name], REFERENCE if own.name == solution.reference else PRIOR),
            sigma=worst_sigmas(at_sensor(solution.poses[own.name], solution.marginal(own.name))),
        )
        for own in description.sensors
    )
    return RigShown(solution.reference, sensors, text=NOT_ESTIMATED)


def of_result(path: str | Path, description: RigDescription) -> RigShown:
    """The result that `calib-ros rig --json` wrote. BadInputError for another file, or one of other sensors."""
    solution = load(path)
    if set(solution.poses) != {sensor.name for sensor in description.sensors} or solution.reference != description.reference:
        raise BadInputError(f"{path} is of {', '.join(solution.poses)}, not of the sensors of --rig; give a result of this rig")
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        likely = [own for own in data.get("changes", ()) if own["posterior"] > SURE and own["kind"] == MOVED]
        moved = {name: (own["rotation_deg"], own["translation_m"]) for own in likely for name in own["sensors"]}
        sensors = tuple(
            SensorShown(
                *(
                    name,
                    description[name].kind,
                    T,
                    str(own["status"]),
                    str(own["reason"]),
                    own["status"] in (CONVERGED, REFERENCE),
                ),
                *(worst_sigmas(at_sensor(T, solution.marginal(name))), moved.get(name)),
            )
            for name, T in solution.poses.items()
            for own in (data["sensors"][name],)
        )
        edges = tuple(_edge(own, solution.poses) for own in data["edges"])
        values = ("sensors", "rotation_deg", "translation_m", "p_value", "closes")
        loops = tuple(LoopShown(tuple(own["sensors"]), *(own[key] for key in values[1:])) for own in data["loops"])
    except (ValueError, TypeError, LookupError, AttributeError):
        raise BadInputError(f"{path} is no whole result of calib-ros rig; give the file that --json wrote") from None
    return RigShown(solution.reference, sensors, edges, loops, data.get("change") or summary(sensors, edges, loops))


def _edge(own: Mapping[str, Any], poses: Mapping[str, Transform]) -> EdgeShown:
    level = FATES.get(own["fate"], NEUTRAL)
    edge = EdgeShown(own["target"], own["source"], own["kind"], own["fate"], level, own["reason"])
    if own["T_target_source"] is None:
        return edge
    T = se3.as_transform(own["T_target_source"], "an edge")
    return compared(edge, T, np.array(own["covariance"], float).reshape(6, 6), poses)


def summary(sensors: Sequence[SensorShown], edges: Sequence[EdgeShown], loops: Sequence[LoopShown]) -> str:
    """How many sensors are usable, and what contradicts what."""
    parts = [f"{sum(own.usable for own in sensors)} of {len(sensors)} sensors usable"]
    parts += [f"{own.target}-{own.source} contradicts the others" for own in edges if own.fate == REJECTED]
    return "; ".join([*parts, *(f"loop {', '.join(own.sensors)} does not close" for own in loops if not own.closes)])
