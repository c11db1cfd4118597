"""What the node says of a rig, as messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from calib_ros_msgs.msg import Rig, RigEdge, RigLoop, RigSensor
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from calib_ros import se3
from calib_ros.rig.live import KIND, PairState, RigState
from calib_ros.ros.conversions import covariance_for_ros, time_message, transform_message
from calib_ros.ros.diagnostics import ERROR, OK, WARN, Health


def rig_message(
    state: RigState, frame: Callable[[str], str], stamp: Callable[[str], int], times: tuple[int, int], usable: bool = True
) -> Rig:
    """~/rig. frame: TF frame of a sensor. stamp: of its newest data, ns. times: now, and until when it is valid, ns. usable: if
    not, nothing of it is."""
    reference = state.solution.reference
    msg = Rig(reference=reference, moved=list(state.moved), text=str(state))
    msg.header.frame_id, msg.header.stamp, msg.valid_until = frame(reference), *map(time_message, times)
    for own in state.sensors:
        said = RigSensor(name=own.name, status=own.status, reason=own.reason, usable=own.usable and usable)
        said.transform = transform_message(own.T, frame(reference), frame(own.name), stamp(own.name))
        said.covariance, (said.moved_deg, said.moved_m) = covariance_for_ros(own.covariance), own.moved
        msg.sensors.append(said)
    for loop in state.solution.loops:
        deg, m = loop.size
        msg.loops.append(
            RigLoop(sensors=list(loop.sensors), rotation_deg=deg, translation_m=m, p_value=loop.p_value, closes=loop.closes)
        )
    msg.edges = [_edge(own, state) for own in state.pairs]
    for told, edges in ((msg.rejected, state.solution.rejected), (msg.doubted, state.solution.doubted)):
        told.extend(RigEdge(target=e.target, source=e.source, kind=e.kind) for e in edges)
    return msg


def _edge(own: PairState, state: RigState) -> RigEdge:
    edge, poses = own.edge(), state.solution.poses
    said = RigEdge(target=own.target, source=own.source, kind=own.kind, status=own.status, usable=own.usable)
    said.reason = "" if own.usable else own.reason
    said.covariance = covariance_for_ros(None if edge is None else edge.covariance)
    if edge is not None and {*own.pair} <= poses.keys():
        said.transform = transform_message(edge.T, "", "", 0).transform
        said.rotation_deg, said.translation_m = se3.error(se3.inverse(poses[own.target]) @ poses[own.source], edge.T)
    return said


def rig_status(name: str, state: RigState | None, missing: Mapping[str, str], health: Health) -> DiagnosticStatus:
    """Of /diagnostics. missing: sensors whose place nobody knows, and what to do."""
    status, values = DiagnosticStatus(level=OK, name=name), dict(missing)
    if state is not None:
        status.message = str(state)
        good = all(s.usable for s in state.sensors) and not missing and not state.solution.rejected
        status.level = ERROR if state.moved else OK if good else WARN
        values |= {s.name: ": ".join(filter(None, [s.status, s.reason])) for s in state.sensors}
        of_lidars = [own for own in state.pairs if own.kind != KIND]
        values |= {" with ".join(own.pair): own.status if own.usable else f"{own.status}: {own.reason}" for own in of_lidars}
    values |= {"errors": str(health.errors), "last error": health.last_error[0]}
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    return status
