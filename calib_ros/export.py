"""An extrinsic in the formats of other tools, and written back into their files.

T_camera_lidar maps LiDAR points into the camera's optical frame. In ROS that is the pose of the LiDAR in its parent, the camera:
frame_id = camera, child_frame_id = LiDAR, the same numbers. With the LiDAR as parent the transform is inverted. Lengths are in
metres, angles in radians; roll, pitch, yaw turn about the parent's fixed axes x, y, z in this order:
R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from calib_ros import io, se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.result import Result

POSE_NAMES = ("x", "y", "z", "roll", "pitch", "yaw")  # of Autoware


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of `child` in `parent`: T (4, 4) maps points of the child into the parent."""

    parent: str
    child: str
    T: Transform

    @staticmethod
    def of(result: Result, parent: str = "camera") -> Pose:
        """parent: camera or lidar. BadInputError for another one, or if the frames have no or the same name."""
        camera, lidar = result.camera_frame, result.lidar_frame
        if not camera.strip() or not lidar.strip():
            raise BadInputError("a frame has no name; give --camera-frame and --lidar-frame")
        if camera == lidar:
            raise BadInputError(f"camera and LiDAR frame are both '{camera}'; give --camera-frame or --lidar-frame")
        if parent not in ("camera", "lidar"):
            raise BadInputError(f"parent '{parent}' is not known; choose camera or lidar")
        T = result.T_camera_lidar
        return Pose(camera, lidar, T) if parent == "camera" else Pose(lidar, camera, se3.inverse(T))

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Metres."""
        x, y, z = (float(v) + 0.0 for v in self.T[:3, 3])  # + 0: no "-0.0" in files that people read
        return x, y, z

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw in rad; pitch within +-90 deg."""
        # Yaw is taken off before roll is read: near gimbal lock, where optical frames are, both would be noise otherwise.
        R = self.T[:3, :3]
        yaw = math.atan2(R[1, 0], R[0, 0])
        s, c = math.sin(yaw), math.cos(yaw)
        pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
        roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
        return roll + 0.0, pitch + 0.0, yaw + 0.0


def tf_command(pose: Pose) -> str:
    """The command that publishes the pose on /tf_static."""
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = [*pose.xyz, *(float(v) + 0.0 for v in se3.quaternion_from_rotation(pose.T[:3, :3]))]
    numbers = " ".join(f"{name} {_number(value)}" for name, value in zip(names, values, strict=True))
    frames = f"--frame-id {shlex.quote(pose.parent)} --child-frame-id {shlex.quote(pose.child)}"
    return f"ros2 run tf2_ros static_transform_publisher {numbers} {frames}\n"


def urdf_joint(pose: Pose) -> str:
    """A fixed joint between two links that the robot's description holds already."""
    return (
        f'<joint name={quoteattr(f"{pose.parent}_to_{pose.child}")} type="fixed">\n'
        f"  <parent link={quoteattr(pose.parent)}/>\n"
        f"  <child link={quoteattr(pose.child)}/>\n"
        f'  <origin xyz="{_numbers(pose.xyz)}" rpy="{_numbers(pose.rpy)}"/>\n'
        "</joint>\n"
    )


def autoware_yaml(*poses: Pose) -> str:
    """Entries of Autoware's sensors_calibration.yaml or sensor_kit_calibration.yaml."""
    entries: dict[str, dict[str, dict[str, float]]] = {}
    for pose in poses:
        entry = dict(zip(POSE_NAMES, (*pose.xyz, *pose.rpy), strict=True))
        entries.setdefault(pose.parent, {})[pose.child] = entry
    return str(yaml.safe_dump(entries, sort_keys=False))


KALIBR = {"plumb_bob": "radtan", "equidistant": "equidistant"}  # names of distortion models


def kalibr_camchain(cameras: Mapping[str, tuple[Camera, Transform, str]]) -> str:
    """Kalibr's camera chain, of cameras in this order: intrinsics, T_common_camera (4, 4) in one frame, and topic. BadInputError
    for a lens that Kalibr has no model of."""
    chain: dict[str, dict[str, object]] = {}
    before: Transform | None = None
    for k, (name, (camera, T, topic)) in enumerate(cameras.items()):
        D = [] if camera.is_pinhole else camera.D.tolist()
        if D and (camera.model not in KALIBR or (camera.model == "plumb_bob" and any(D[4:]))):
            raise BadInputError(f"camera {name}: Kalibr has no {camera.model} lens of {len(D)} numbers; write another file")
        K = camera.K
        entry: dict[str, object] = {} if before is None else {"T_cn_cnm1": (se3.inverse(T) @ before).tolist()}
        entry |= {
            "camera_model": "pinhole",
            "intrinsics": [float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": KALIBR[camera.model] if D else "none",
            "distortion_coeffs": D[:4],
            "resolution": [camera.width, camera.height],
            "rostopic": topic,
        }
        chain[f"cam{k}"], before = entry, T
    return str(yaml.safe_dump(chain, sort_keys=False, default_flow_style=None))


def kitti_odometry(result: Result, camera: Camera | None = None) -> str:
    """Lines of calib.txt as in KITTI odometry: `Tr`, LiDAR to rectified camera 0, and P0 = K [I | 0] of a camera without
    distortion, which is taken as camera 0."""
    Tr = f"Tr: {_numbers(result.T_camera_lidar[:3].ravel())}\n"
    if camera is None or not camera.is_pinhole:
        return Tr
    return f"P0: {_numbers(np.c_[camera.K, np.zeros(3)].ravel())}\n{Tr}"


def kitti_raw(result: Result) -> str:
    """calib_velo_to_cam.txt as in KITTI raw: `R` and `T`, LiDAR to a camera 0 with R_rect_00 = I and P_rect_00 = K [I | 0].
    Beside KITTI's own calib_cam_to_cam.txt, of another R_rect_00, these lines are wrong."""
    T = result.T_camera_lidar
    return f"R: {_numbers(T[:3, :3].ravel())}\nT: {_numbers(T[:3, 3])}\n"


_OF_POSE: dict[str, Callable[[Pose], str]] = {"tf": tf_command, "urdf": urdf_joint, "autoware": autoware_yaml}
_OF_RESULT: dict[str, Callable[[Result, Camera | None], str]] = {
    "kitti": kitti_odometry,
    "kitti-raw": lambda result, _: kitti_raw(result),
    "json": lambda result, _: result.dumps(),
    "yaml": lambda result, _: result.dumps(yaml_format=True),
}
FORMATS = (*_OF_POSE, *_OF_RESULT)


def renamed(result: Result, camera_frame: str | None, lidar_frame: str | None) -> Result:
    """A result with other names of its frames; None = as they are."""
    return replace(
        result,
        camera_frame=result.camera_frame if camera_frame is None else camera_frame,
        lidar_frame=result.lidar_frame if lidar_frame is None else lidar_frame,
    )


def export(
    result: Result,
    form: str,
    parent: str = "camera",
    camera: Camera | None = None,
    camera_frame: str | None = None,
    lidar_frame: str | None = None,
) -> str:
    """Text of a result in one of FORMATS, ending in a newline; frames may be renamed.

    parent: camera or lidar. camera: intrinsics if known, for P0 of kitti. BadInputError if the format is unknown or cannot have
    the LiDAR as parent, or if the frames' names will not do.
    """
    if form not in FORMATS:
        raise BadInputError(f"format '{form}' is not known; choose one of {', '.join(FORMATS)}")
    result = renamed(result, camera_frame, lidar_frame)
    if form in _OF_POSE:
        return _OF_POSE[form](Pose.of(result, parent))
    if parent != "camera":
        raise BadInputError(f"{form} files hold the transform from LiDAR to camera by definition; leave out --parent {parent}")
    return _OF_RESULT[form](result, camera)


# ---- files that hold more than the extrinsic ------------------------------------------------------------------------------

# (parent, child) -> T_parent_child (4, 4) by which a tree of frames gives the extrinsic, its other edges being as they are.
Edges = Mapping[tuple[str, str], Transform]
FORMER = ".former"  # appended to the name of a file, for what was in it before
DESCRIPTIONS, AUTOWARE = (".urdf", ".xacro"), (".yaml", ".yml")
WRITABLE = (".json", *DESCRIPTIONS, *AUTOWARE)


def has_changed(result: Result, before: Result) -> bool:
    """Whether an extrinsic is another than the one before: by more than its own standard deviation in one of the six directions,
    or of other frames; also where its covariance is unknown."""
    same_frames = (result.camera_frame, result.lidar_frame) == (before.camera_frame, before.lidar_frame)
    if result.covariance is None or not same_frames:
        return True
    moved = np.abs(se3.log(result.T_camera_lidar @ se3.inverse(before.T_camera_lidar)))
    return bool((moved > np.sqrt(np.diag(result.covariance))).any())


def write_back(path: str, result: Result, edges: Edges, joint: str) -> None:
    """Write an extrinsic to a file of one of the WRITABLE kinds, and keep the former file beside it as NAME.former.

    A result (.json) and a missing YAML file are written as a whole. Of a robot's description the origin of the joint of this name
    changes, of Autoware's YAML the entry between the frames, and every other byte stays. edges: beside those from camera to LiDAR
    and back, from the camera on: the first that a YAML file has is written. Raises BadInputError if the file cannot be read or
    written, or has no such joint or entry; it is as it was then.
    """
    poses = [Pose.of(result, parent) for parent in ("camera", "lidar")]
    edges = {(pose.parent, pose.child): pose.T for pose in poses} | dict(edges)
    kind, before = Path(path).suffix.lower(), content(path)
    if kind in DESCRIPTIONS:
        if before is None:
            raise BadInputError(f"{path} does not exist; name the robot's description")
        data = _with_origin(before, path, joint, edges)
    elif kind in AUTOWARE:
        data = autoware_yaml(poses[0]).encode() if before is None else _with_entry(before, path, edges)
    else:
        data = result.dumps().encode()
    replace_file(path, data, before)


def replace_file(path: str, data: bytes, before: bytes | None) -> None:
    """Write a file that held `before`, None if there was none, which is kept as NAME.former. BadInputError if it cannot be."""
    if data == before:
        return
    if before is not None:
        io.write_atomically(path + FORMER, before)
    io.write_atomically(path, data)


def write_edges(path: str, poses: Sequence[Pose], edges: Edges) -> set[str]:
    """Write several edges to a robot's description or Autoware's YAML: the origins of all joints, or all entries, between frames
    of `edges` change, every other byte stays, and the former file is kept as NAME.former; a missing file is made of the poses.
    Returns the frames that are joined. Raises BadInputError as `write_back`."""
    before = content(path)
    if before is None:
        joints = "".join(map(urdf_joint, poses))
        robot = f'<?xml version="1.0"?>\n<robot name="rig">\n{joints}</robot>\n'
        text = robot if Path(path).suffix.lower() in DESCRIPTIONS else autoware_yaml(*poses)
        io.write_atomically(path, text.encode())
        return {frame for pose in poses for frame in (pose.parent, pose.child)}
    data, ours = with_edges(before, path, edges)
    replace_file(path, data, before)
    return {frame for links in ours for frame in links}


def with_edges(data: bytes, path: str, edges: Edges) -> tuple[bytes, list[tuple[str, str]]]:
    """What `write_edges` writes to a file that exists, and which edges these are. Raises BadInputError."""
    of_joints = Path(path).suffix.lower() in DESCRIPTIONS
    if of_joints:
        joined = {n: _links(joint) for n, (joint, *more) in _joints(data, path).items() if not more and _links(joint) in edges}
        for name in joined:
            data = _with_origin(data, path, name, edges)
        ours = list(joined.values())
    else:
        root = _yaml(data, path)[1]
        ours = [(parent, child) for parent, child in edges if _value_of(_value_of(root, parent), child) is not None]
        for edge in ours:
            data = _with_entry(data, path, {edge: edges[edge]})
    if not ours:
        raise BadInputError(f"{path} has no {'joint' if of_joints else 'entry'} between the sensors; {_no_edge(edges)}")
    return data, ours


def content(path: str) -> bytes | None:
    """Of a file; None if there is none. BadInputError if it cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; name a file") from None


@dataclass
class _Joint:
    """Of a robot's description. links: of parent and child. link_at, origins: where these elements begin, byte offsets."""

    links: dict[str, str] = field(default_factory=dict)
    link_at: int = 0
    origins: list[int] = field(default_factory=list)


def _links(joint: _Joint) -> tuple[str, str]:
    """Names of parent and child."""
    return joint.links.get("parent", ""), joint.links.get("child", "")


def _joints(data: bytes, path: str) -> dict[str, list[_Joint]]:
    """The joints of a robot's description by name. Those of transmissions have no type."""
    found: dict[str, list[_Joint]] = {}
    within: list[_Joint | None] = [None]  # for every element that is open: the joint around its children
    parser = expat.ParserCreate()

    def start(name: str, attributes: dict[str, str]) -> None:
        joint = within[-1]
        if joint is not None and name in ("parent", "child"):
            joint.links[name] = attributes.get("link", "")
            joint.link_at = parser.CurrentByteIndex
        elif joint is not None and name == "origin":
            joint.origins.append(parser.CurrentByteIndex)
        elif name == "joint" and "type" in attributes:
            joint = _Joint()
            found.setdefault(attributes.get("name", ""), []).append(joint)
        within.append(joint)

    def end(name: str) -> None:
        within.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise BadInputError(f"{path} is no valid XML: {error}; correct it") from None
    return found


def _with_origin(data: bytes, path: str, name: str, edges: Edges) -> bytes:
    """A robot's description with the origin of a joint replaced."""
    joints = _joints(data, path)
    if len(joints.get(name, ())) != 1:
        there = ", ".join(sorted(joints)[:8]) + (", ..." if len(joints) > 8 else "")
        count = len(joints[name]) if name in joints else "no"
        raise BadInputError(
            f"{path} has {count} joints named '{name}'; set export.joint to one of: {there or 'none, it has no joint'}"
        )
    (joint,) = joints[name]
    parent, child = _links(joint)
    if (parent, child) not in edges:
        raise BadInputError(f"{path}: joint '{name}' connects '{parent}' and '{child}'; {_no_edge(edges)}, and set export.joint")
    pose = Pose(parent, child, edges[parent, child])
    values = {b"xyz": _numbers(pose.xyz).encode(), b"rpy": _numbers(pose.rpy).encode()}
    at = (joint.origins or [joint.link_at])[0]
    tag = re.compile(rb"""<(?:origin|parent|child)(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, at)
    if len(joint.origins) > 1 or tag is None:
        raise BadInputError(f"{path}: joint '{name}' has several origins, or the file is not in UTF-8; leave one, in UTF-8")
    if not joint.origins:
        space = data[len(data[:at].rstrip()) : at]
        return data[:at] + b'<origin xyz="%s" rpy="%s"/>' % (values[b"xyz"], values[b"rpy"]) + space + data[at:]
    text = tag.group()
    for attribute, value in values.items():
        given = re.search(rb"""\s%s\s*=\s*("[^"]*"|'[^']*')""" % attribute, text)
        if given is not None:
            text = text[: given.start(1)] + b'"%s"' % value + text[given.end(1) :]
        else:
            text = b'<origin %s="%s"' % (attribute, value) + text.removeprefix(b"<origin")
    return data[:at] + text + data[tag.end() :]


def _with_entry(data: bytes, path: str, edges: Edges) -> bytes:
    """Autoware's YAML with the numbers of the first of the edges that it has replaced."""
    text, root = _yaml(data, path)
    for (parent, child), T in edges.items():
        entry = _value_of(_value_of(root, parent), child)
        if entry is None:
            continue
        pose = Pose(parent, child, T)
        values = [(_value_of(entry, name), value) for name, value in zip(POSE_NAMES, (*pose.xyz, *pose.rpy), strict=True)]
        places = [
            (node.start_mark.index, node.end_mark.index, value) for node, value in values if isinstance(node, yaml.ScalarNode)
        ]
        if len(places) < len(values):
            raise BadInputError(f"{path}: the entry of {child} must hold {', '.join(POSE_NAMES)}")
        for begin, end, value in sorted(places, reverse=True):
            text = text[:begin] + _number(value) + text[end:]
        return text.encode()
    raise BadInputError(f"{path} has no entry of the extrinsic; {_no_edge(edges)}")


def _yaml(data: bytes, path: str) -> tuple[str, yaml.Node | None]:
    """Text and root of a YAML file."""
    try:
        text = data.decode()
        return text, io.compose(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is no valid YAML{io.what_is_wrong(error)}; correct it") from None


def _value_of(node: yaml.Node | None, name: str) -> yaml.Node | None:
    """What a mapping holds under a name."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else ()
    return next((value for key, value in pairs if key.value == name), None)


def _no_edge(edges: Edges) -> str:
    """What to do."""
    names = ", ".join(f"{parent} -> {child}" for parent, child in edges)
    return f"name one of {names} (parent -> child), or publish the frames between them on /tf_static"


def _number(value: float) -> str:
    return repr(float(value))  # the shortest text that gives back every bit


def _numbers(values: object) -> str:
    return " ".join(_number(value + 0.0) for value in np.asarray(values, float))
