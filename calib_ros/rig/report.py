"""What is told of a rig: the result as JSON, in words, and in the files of other tools."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import export, io, se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import RefineConfig
from calib_ros.errors import BadInputError
from calib_ros.io import AsJson
from calib_ros.result import CONSUMERS_SIGMAS, CONVERGED, INSUFFICIENT, REFUSED, VERSION, Consumer
from calib_ros.rig.description import RigDescription
from calib_ros.rig.edges import Measurement, RigMeasurer
from calib_ros.rig.graph import PRIOR, Edge, Loop, RigSolution, at_sensor, joined_to, worst_sigmas
from calib_ros.rig.moved import RigHypothesis, hypotheses, verdict

REFERENCE = "reference"
AXES = "xyz"
WRITABLE = (*export.DESCRIPTIONS, *export.AUTOWARE)


@dataclass(frozen=True, eq=False)
class RigReport(AsJson):
    """The result of a rig.

    frames: of TF, by the sensors' names. cameras: intrinsics. truth: T_reference_sensor (4, 4) as the recording states it, as far
    as it does. limits: what every sensor has to be known to. before: an earlier solution, to be compared.
    """

    description: RigDescription
    solution: RigSolution
    measured: Sequence[Measurement]
    frames: Mapping[str, str]
    cameras: Mapping[str, Camera]
    truth: Mapping[str, Transform] = field(default_factory=dict)
    limits: RefineConfig = field(default_factory=RefineConfig)
    source: str = ""
    before: RigSolution | None = None

    @classmethod
    def of(cls, measurer: RigMeasurer, measured: Sequence[Measurement], before: RigSolution | None = None) -> RigReport:
        """The report on what was measured."""
        rig, description = measurer.rig, measurer.description
        known = {s.name: rig.reference(s.name) for s in description.sensors}
        truth = {name: T for name, T in known.items() if T is not None}
        frames = {s.name: s.frame or rig.frame_id(s.name) for s in description.sensors}
        cameras = {name: rig.camera(name) for name in description.cameras}
        return cls(
            *(description, measurer.solution(measured), measured, frames, cameras, truth, measurer.config.refine, rig.name),
            before=before,
        )

    def at_sensor(self, name: str) -> Covariance:
        """Covariance (6, 6) of a sensor's turn and place in the reference's axes, rad and m."""
        return at_sensor(self.solution.poses[name], self.solution.marginal(name))

    def status(self, name: str) -> tuple[str, str]:
        """Status of a sensor and its reason: reference, converged, insufficient (nothing measured, or directions that the prior
        alone tells), refused (its edges contradict others, or are too uncertain)."""
        if name == self.solution.reference:
            return REFERENCE, "the others are stated in its frame"
        if name not in joined_to(self.solution.reference, [(e.target, e.source) for e in self.solution.edges]):
            why = [m.reason for m in self.measured if name in (m.target, m.source) and m.edge is None and m.reason]
            return INSUFFICIENT, "no edge joins it to the reference, its pose is the prior" + "".join(f"; {w}" for w in why[:2])
        doubted = [e.name for e in self.solution.doubted if name in (e.target, e.source)]
        if doubted:
            return REFUSED, f"these contradict each other, and which is wrong cannot be told: {', '.join(doubted)}"
        open_axes = [self._direction(name, v) for v in self.solution.open.get(name, ())]
        if open_axes:
            return INSUFFICIENT, f"rests on the prior, since no edge tells: {', '.join(open_axes)}"
        C = self.at_sensor(name)
        if not Consumer(name, self.limits.tolerance_deg, self.limits.tolerance_m).is_served(C):
            deg, m = worst_sigmas(C)
            return REFUSED, (
                f"too uncertain: 1 sigma {deg:.2f} deg and {100 * m:.1f} cm, and {CONSUMERS_SIGMAS:g} of them must be within "
                f"{self.limits.tolerance_deg:g} deg and {100 * self.limits.tolerance_m:g} cm; give more frames or a better prior"
            )
        return CONVERGED, ""

    def _direction(self, name: str, twist: Matrix) -> str:
        """An unobservable direction at the sensor, in the reference's axes."""
        v = se3.parts_jacobian(self.solution.poses[name]) @ twist
        T, C = self.solution.prior[name]
        sigma = np.sqrt(np.diag(at_sensor(T, C)))
        axis = int(np.argmax(np.abs(v) / sigma))
        own = float(np.sqrt(self.at_sensor(name)[axis, axis]))
        if axis < 3:
            return f"its rotation about {AXES[axis]} ({np.rad2deg(own):.2f} deg)"
        return f"its place along {AXES[axis - 3]} ({100 * own:.0f} cm)"

    @cached_property
    def changes(self) -> tuple[tuple[RigHypothesis, ...], str]:
        """What may have happened since `before`, and a line about it; nothing where that is unknown."""
        if self.before is None:
            return (), ""
        edges = [m.edge for m in self.measured if m.edge is not None and self._fate(m) != "rejected"]
        edges = [e for e in edges if {e.target, e.source} <= self.before.poses.keys()]
        if not edges:
            return (), "nothing was measured that could be compared"
        likely, text = verdict(hypotheses(self.before, edges))
        unseen = [name for name in self.before.poses if all(name not in (e.target, e.source) for e in edges)]
        return likely, text + (f"; nothing is known of {', '.join(unseen)}" if unseen else "")

    @property
    def converged(self) -> bool:
        """Whether all sensors are to be used."""
        return all(self.status(name)[0] in (CONVERGED, REFERENCE) for name in self.solution.poses)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and texts; see docs/rig.md."""
        s = self.solution
        return {
            "reference": s.reference,
            "status": CONVERGED if self.converged else REFUSED,
            "source": self.source,
            "sensors": {name: self._sensor(name) for name in s.poses},
            "covariance_of": list(s.columns),
            "covariance": s.covariance.tolist(),
            "edges": [self._edge(m) for m in self.measured],
            "rejected": [e.name for e in s.rejected],
            "doubted": [e.name for e in s.doubted],
            "loops": [loop_dict(loop) for loop in s.loops],
            **({} if self.before is None else {"changes": list(map(_change, self.changes[0])), "change": self.changes[1]}),
            "version": VERSION,
        }

    def _sensor(self, name: str) -> dict[str, Any]:
        T, (status, reason) = self.solution.poses[name], self.status(name)
        found: dict[str, Any] = {
            "kind": self.description[name].kind,
            "frame": self.frames[name],
            "status": status,
            "reason": reason,
            "T_reference_sensor": T.tolist(),
            "translation_m": T[:3, 3].tolist(),
            "quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3]).tolist(),
            "covariance": self.solution.marginal(name).tolist(),
        }
        for key, other in (("prior_error", self.solution.prior.get(name, (None,))[0]), ("reference_error", self.truth.get(name))):
            found[key] = None if other is None else _amount(se3.error(other, T))
        return found

    def _fate(self, measured: Measurement) -> str:
        def among(edges: Sequence[Edge]) -> bool:
            return any((e.target, e.source, e.kind) == (measured.target, measured.source, measured.kind) for e in edges)

        if measured.edge is None:
            return "failed"
        return "rejected" if among(self.solution.rejected) else ("doubted" if among(self.solution.doubted) else "used")

    def _edge(self, measured: Measurement) -> dict[str, Any]:
        edge = measured.edge
        return {
            **{key: getattr(measured, key) for key in ("target", "source", "kind")},
            **{"fate": self._fate(measured), "reason": measured.reason},
            **{"T_target_source": edge and edge.T.tolist(), "covariance": edge and edge.covariance.tolist()},
            **{"time_offset_s": edge and edge.time_offset_s, "time_offset_sigma_s": edge and edge.time_sigma_s},
            "frames_used": edge.samples if edge else 0,
        }

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Caption, column names and rows: sensors, edges, loops."""
        sensors, edges = [], []
        for name, T in self.solution.poses.items():
            (status, reason), (deg, m) = self.status(name), worst_sigmas(self.at_sensor(name))
            x, y, z = T[:3, 3]
            known = self.truth.get(name)
            error = "" if known is None or name == self.solution.reference else _amounts(*se3.error(known, T))
            sensors.append([name, status, f"{x:.3f} {y:.3f} {z:.3f}", _amounts(deg, m), error, reason])
        for measured in self.measured:
            sigma = "" if measured.edge is None else _amounts(*worst_sigmas(measured.edge.covariance))
            edges.append([measured.target, measured.source, measured.kind, self._fate(measured), sigma, measured.reason])
        priors = [e for e in self.solution.rejected if e.kind == PRIOR]
        edges += [[e.target, e.source, PRIOR, "rejected", "", "the edges contradict it"] for e in priors]
        loops = [
            [", ".join(loop.sensors), _amounts(*loop.size), f"{loop.p_value:.3g}", "yes" if loop.closes else "NO"]
            for loop in self.solution.loops
        ]
        of_sensors = ["sensor", "status", "x y z, m", "1 sigma", "error", "remarks"]
        return [
            (f"Sensors in the frame of {self.solution.reference}", of_sensors, sensors),
            ("Edges", ["target", "source", "kind", "", "1 sigma", "remarks"], edges),
            ("Loops", ["sensors", "residual", "p-value", "closes"], loops),
        ]

    def text(self) -> str:
        """For a terminal."""
        lines = []
        for caption, header, rows in self.tables():
            widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
            aligned = ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in [header, *rows]]
            lines += [caption, *aligned] if rows else []
        return "\n".join([*lines, *([] if self.before is None else [f"Since the former result: {self.changes[1]}"])])

    def has_changed(self, before: RigReport) -> bool:
        """Whether a sensor is elsewhere than before: by more than its standard deviation in one of the six directions."""
        poses, former = self.solution.poses, before.solution.poses
        same = (self.frames, poses.keys()) == (before.frames, former.keys())
        return not same or any(export.moves(T, former[n], self.solution.marginal(n)) for n, T in poses.items())

    def write(self, path: str) -> str:
        """Write to a file by its ending: JSON, or of another tool, the joints of a robot's description (.urdf, .xacro) or the
        entries of Autoware's YAML, which change where the file exists; Kalibr's camera chain where the name begins with camchain.
        Returns which sensors it has no place for, in a line; "" if none."""
        suffix, poses, reference = Path(path).suffix.lower(), self.solution.poses, self.solution.reference
        if suffix == ".json":
            export.replace_file(path, self.dumps().encode())
            return ""
        check_out(path)
        frames = sorted(self.frames.values())
        if len(set(frames)) < len(frames) or "" in frames:
            raise BadInputError(f"{path}: sensors share a TF frame or have none ({', '.join(frames)}); set sensors.NAME.frame")
        if Path(path).name.startswith(export.CAMCHAIN):
            cameras = {n: (c, poses[n], self.description[n].topic) for n, c in self.cameras.items()}
            io.write_atomically(path, export.kalibr_camchain(cameras).encode())
            return ""
        names = [reference, *self.solution.columns]
        edges = {(self.frames[a], self.frames[b]): se3.inverse(poses[a]) @ poses[b] for a in names for b in names if a != b}
        joined = export.write_edges(path, edges, {(a, b): T for (a, b), T in edges.items() if a == self.frames[reference]})
        if missing := [name for name, frame in self.frames.items() if frame not in joined]:
            what = ("joint", "joints") if suffix in export.DESCRIPTIONS else ("entry", "entries")
            return f"{path} has no {what[0]} for {', '.join(missing)}, which are not written; add {what[1]} of their frames"
        return ""


def _change(found: RigHypothesis) -> dict[str, Any]:
    own = {"kind": found.kind, "sensors": list(found.sensors), "posterior": found.posterior, **_amount(found.size)}
    return {**own, "displacement": found.displacement.tolist(), "p_value": found.p_value}


def loop_dict(loop: Loop) -> dict[str, Any]:
    """Plain numbers, lists and texts of a loop."""
    return {"sensors": list(loop.sensors), **_amount(loop.size), "p_value": loop.p_value, "closes": loop.closes}


def _amount(size: tuple[float, float]) -> dict[str, float]:
    return {"rotation_deg": size[0], "translation_m": size[1]}


def load(path: str | Path) -> RigSolution:
    """The solution in a file of `RigReport.save`. BadInputError for another one."""
    text = io.read_text(path, "result", "a JSON result of calib-ros rig")
    try:
        data = json.loads(text)
        poses = {name: se3.as_transform(s["T_reference_sensor"], name) for name, s in data["sensors"].items()}
        covariance = np.array(data["covariance"], float)
        edges = tuple(
            Edge(
                *(e["target"], e["source"], se3.as_transform(e["T_target_source"], "an edge"), np.array(e["covariance"], float)),
                *(e["kind"], e["time_offset_s"], e["time_offset_sigma_s"]),
            )
            for e in data["edges"]
            if e["fate"] in ("used", "doubted")
        )
        solution = RigSolution(data["reference"], poses, covariance, edges)
        if covariance.shape != (6 * len(solution.columns),) * 2 or list(solution.columns) != data["covariance_of"]:
            raise ValueError
        for C in (covariance, *(e.covariance for e in edges)):
            np.linalg.cholesky(C + 1e-18 * np.eye(len(C)))  # raises LinAlgError, a ValueError, for what is none
        if any(e.covariance.shape != (6, 6) for e in edges):
            raise ValueError
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise BadInputError(f"{path} is no result of calib-ros rig; give the file that --json wrote") from None
    return solution


def check_out(path: str) -> None:
    """BadInputError, before the work, for a file that `RigReport.write` has no format for."""
    if Path(path).suffix.lower() not in WRITABLE:
        raise BadInputError(
            f"--out {path}: the ending tells the format; give one of {', '.join(WRITABLE)}, or {export.CAMCHAIN}.yaml"
        )


def _amounts(deg: float, m: float) -> str:
    return f"{deg:.3f} deg {100 * m:.1f} cm"
