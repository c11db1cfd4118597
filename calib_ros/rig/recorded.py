"""A rig without a description: the sensors of its recording, where that states them to be, and which one is the reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.datasets.open import open_rig, sensors_of
from calib_ros.datasets.rig import CAMERA, LIDAR, RigDescription, RigSource, Sensor
from calib_ros.errors import BadInputError
from calib_ros.rig.edges import SEEN, seen_share


def recorded_rig(text: str) -> tuple[RigDescription, RigSource, list[str]]:
    """What a recording states of its sensors, the rig, and what there is to say of the choice.

    Priors are the poses that the recording states, relative to the LiDAR that most cameras share a view with; None where it
    states none. Raises BadInputError where there is no camera or no LiDAR.
    """
    sensors, remarks = sensors_of(text)
    kinds = {kind: [own.name for own in sensors if own.kind == kind] for kind in (CAMERA, LIDAR)}
    for kind, names in kinds.items():
        if not names:
            raise BadInputError(f"{text} has no {kind} that can be read; {'; '.join([*remarks, 'give --rig a description'])}")
    rig = open_rig(text, RigDescription(tuple(sensors), kinds[LIDAR][0]))
    several = len(kinds[LIDAR]) > 1
    poses = {lidar: _poses(rig, sensors, lidar) for lidar in kinds[LIDAR]}
    reference = max(kinds[LIDAR], key=lambda lidar: _cameras_with(rig, lidar, poses[lidar]) if several else 0)
    rig.reference_sensor = reference
    named = [replace(own, prior=None if own.name == reference else poses[reference][own.name]) for own in sensors]
    why = ", with which most cameras share a view" if several else ""
    cameras, lidars = map(", ".join, kinds.values())
    remarks.append(f"as recorded: cameras {cameras}; LiDARs {lidars}; poses are relative to {reference}{why}")
    return RigDescription(tuple(named), reference), rig, remarks


def joined(description: RigDescription, text: str, remarks: list[str]) -> RigDescription:
    """The sensors whose poses are known; of the others a remark is added. BadInputError where there is no camera among them."""
    known = tuple(own for own in description.sensors if own.prior is not None or own.name == description.reference)
    lost = [own.name for own in description.sensors if own not in known]
    cure = "record /tf_static, or set their prior in the file that --write-rig writes and give it with --rig"
    if not any(own.kind == CAMERA for own in known):
        unknown = f"{text} does not state where {', '.join(lost)} are relative to {description.reference}; {cure}"
        raise BadInputError("; ".join([unknown, *remarks]))
    remarks += [f"left out, since the recording does not state where they are: {', '.join(lost)}; {cure}"] if lost else []
    return replace(description, sensors=known)


def _poses(rig: RigSource, sensors: Sequence[Sensor], reference: str) -> dict[str, Transform | None]:
    """T_reference_sensor (4, 4) of all sensors by what is believed of them, else as recorded; None where that is not said."""
    rig.reference_sensor = reference
    base = next((own.prior for own in sensors if own.name == reference), None)
    if base is None:
        return {own.name: rig.reference(own.name) for own in sensors}
    return {own.name: None if own.prior is None else se3.inverse(base) @ own.prior for own in sensors}


def _cameras_with(rig: RigSource, lidar: str, poses: dict[str, Transform | None]) -> int:
    """How many cameras share a view with a LiDAR, by its middle scan. poses: (4, 4) relative to it."""
    scans = rig.scans(lidar)
    xyz = scans[len(scans) // 2][1].xyz if len(scans) else np.zeros((0, 3))
    points = xyz[np.isfinite(xyz).all(axis=1)].astype(float)
    at = {name: T for name in rig.cameras if (T := poses[name]) is not None}
    return sum(seen_share(rig.camera(name), se3.inverse(T), points) >= SEEN for name, T in at.items())
