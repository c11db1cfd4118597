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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
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

FORMATS = ("tf", "urdf", "autoware", "kitti", "kitti-raw", "json", "yaml")
DESCRIPTIONS, AUTOWARE = (".urdf", ".xacro"), (".yaml", ".yml")
WRITABLE = (".json", *DESCRIPTIONS, *AUTOWARE)
CAMCHAIN = "camchain"  # begins the names of Kalibr's files
FORMER = ".former"  # appended to the name of a file, for what was in it before
POSE_NAMES = ("x", "y", "z", "roll", "pitch", "yaw")  # of Autoware
KALIBR = {"plumb_bob": "radtan", "equidistant": "equidistant"}  # names of distortion models
# (parent, child) -> T_parent_child (4, 4) by which a tree of frames gives the extrinsic, its other edges being as they are.
Edges = Mapping[tuple[str, str], Transform]
# A joint of a robot's description: links of its parent and child; where its parent, child and origins begin, in bytes.
Joint = tuple[dict[str, str], dict[str, list[int]]]


def export(
    result: Result,
    form: str,
    parent: str = "camera",
    camera: Camera | None = None,
    camera_frame: str | None = None,
    lidar_frame: str | None = None,
) -> str:
    """Text of a result in one of FORMATS, ending in a newline; frames may be renamed.

    tf: the command that publishes it on /tf_static. urdf: a fixed joint between links that a robot's description holds already.
    autoware: an entry of sensor_kit_calibration.yaml. kitti: lines of an odometry calib.txt, `Tr`, LiDAR to rectified camera 0,
    and P0 = K [I | 0] of a camera without distortion, which is taken as camera 0. kitti-raw: calib_velo_to_cam.txt, `R` and `T`
    to a camera 0 with R_rect_00 = I; beside KITTI's own calib_cam_to_cam.txt, of another R_rect_00, these lines are wrong.

    parent: camera or lidar. camera: intrinsics if known, for P0 of kitti. BadInputError if the format is unknown or cannot have
    the LiDAR as parent, or if the frames' names will not do.
    """
    if form not in FORMATS:
        raise BadInputError(f"format '{form}' is not known; choose one of {', '.join(FORMATS)}")
    result, T = renamed(result, camera_frame, lidar_frame), result.T_camera_lidar
    of_pose: dict[str, Callable[[Edges], str]] = {"tf": tf_command, "urdf": _urdf_joints, "autoware": _autoware}
    if form in of_pose:
        return of_pose[form](poses_of(result, parent))
    if parent != "camera":
        raise BadInputError(f"{form} files hold the transform from LiDAR to camera by definition; leave out --parent {parent}")
    if form == "kitti-raw":
        return f"R: {_numbers(T[:3, :3].ravel())}\nT: {_numbers(T[:3, 3])}\n"
    if form == "kitti":
        P0 = "" if camera is None or not camera.is_pinhole else f"P0: {_numbers(np.c_[camera.K, np.zeros(3)].ravel())}\n"
        return f"{P0}Tr: {_numbers(T[:3].ravel())}\n"
    return result.dumps(yaml_format=form == "yaml")


def renamed(result: Result, camera_frame: str | None, lidar_frame: str | None) -> Result:
    """A result with other names of its frames; None = as they are."""
    camera = result.camera_frame if camera_frame is None else camera_frame
    return replace(result, camera_frame=camera, lidar_frame=result.lidar_frame if lidar_frame is None else lidar_frame)


def poses_of(result: Result, *parents: str) -> dict[tuple[str, str], Transform]:
    """The poses of the LiDAR in the camera, and of the camera in the LiDAR, by the names of the frames, for the parents "camera"
    and "lidar". BadInputError for another one, or if the frames have no or the same name."""
    camera, lidar = result.camera_frame, result.lidar_frame
    if not camera.strip() or not lidar.strip():
        raise BadInputError("a frame has no name; give --camera-frame and --lidar-frame")
    if camera == lidar:
        raise BadInputError(f"camera and LiDAR frame are both '{camera}'; give --camera-frame or --lidar-frame")
    poses: dict[tuple[str, str], Transform] = {}
    for parent in parents:
        if parent not in ("camera", "lidar"):
            raise BadInputError(f"parent '{parent}' is not known; choose camera or lidar")
        T = result.T_camera_lidar
        poses |= {(camera, lidar): T} if parent == "camera" else {(lidar, camera): se3.inverse(T)}
    return poses


def xyz_rpy(T: Transform) -> list[float]:
    """x, y, z, m, and roll, pitch, yaw, rad, of a pose (4, 4); pitch within +-90 deg."""
    # Yaw is taken off before roll is read: near gimbal lock, where optical frames are, both would be noise otherwise.
    R = T[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return [float(v) + 0.0 for v in (*T[:3, 3], roll, pitch, yaw)]  # + 0: no "-0.0" in files that people read


def tf_command(poses: Edges, text: Callable[[float], str] = repr) -> str:
    """The line that publishes a pose. text: of a number, by default with every bit."""
    (((parent, child), T),) = poses.items()
    values = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*T[:3, 3], *se3.quaternion_from_rotation(T[:3, :3])), strict=True)
    numbers = " ".join(f"--{name} {text(float(value) + 0.0)}" for name, value in values)
    frames = f"--frame-id {shlex.quote(parent)} --child-frame-id {shlex.quote(child)}"
    return f"ros2 run tf2_ros static_transform_publisher {numbers} {frames}\n"


def _urdf_joints(poses: Edges) -> str:
    return "".join(
        f'<joint name={quoteattr(f"{parent}_to_{child}")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n"
        f"  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{_numbers(xyz_rpy(T)[:3])}" rpy="{_numbers(xyz_rpy(T)[3:])}"/>\n'
        "</joint>\n"
        for (parent, child), T in poses.items()
    )


def _autoware(poses: Edges) -> str:
    entries: dict[str, dict[str, dict[str, float]]] = {}
    for (parent, child), T in poses.items():
        entries.setdefault(parent, {})[child] = dict(zip(POSE_NAMES, xyz_rpy(T), strict=True))
    return str(yaml.safe_dump(entries, sort_keys=False))


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


def moves(T: Transform, before: Transform, covariance: Transform) -> bool:
    """Whether a pose (4, 4) differs by more than its standard deviation in one of the six directions of a left twist."""
    return bool((np.abs(se3.log(T @ se3.inverse(before))) > np.sqrt(np.diag(covariance))).any())


def has_changed(result: Result, before: Result) -> bool:
    """Whether an extrinsic is another than the one before: by more than its own standard deviation in one of the six directions,
    or of other frames; also where its covariance is unknown."""
    same_frames = (result.camera_frame, result.lidar_frame) == (before.camera_frame, before.lidar_frame)
    C = result.covariance
    return C is None or not same_frames or moves(result.T_camera_lidar, before.T_camera_lidar, C)


def write_back(path: str, result: Result, edges: Edges, joint: str) -> None:
    """Write an extrinsic to a file of one of the WRITABLE kinds, and keep the former file beside it as NAME.former.

    A result (.json) is written as a whole. edges: beside those from camera to LiDAR and back, from the camera on. Otherwise as
    `write_edges`, but of a robot's description, which must exist, the joint of this name, and of Autoware's YAML the first entry.
    """
    if Path(path).suffix.lower() in (*DESCRIPTIONS, *AUTOWARE):
        write_edges(path, poses_of(result, "camera", "lidar") | dict(edges), poses_of(result, "camera"), joint)
    else:
        replace_file(path, result.dumps().encode())


def write_edges(path: str, edges: Edges, new: Edges, joint: str | None = None) -> set[str]:
    """Write several edges to a robot's description or Autoware's YAML: the origins of all joints, or all entries, between frames
    of `edges` change, every other byte stays, and the former file is kept as NAME.former; a missing file is made of those of
    `new`. Returns the frames that are joined. joint: see `write_back`.

    Raises BadInputError if the file cannot be read or written, or has no such joint or entry; it is as it was then.
    """
    before, of_robot = content(path), Path(path).suffix.lower() in DESCRIPTIONS
    ours = list(new)
    if before is not None:
        data, ours = with_edges(before, path, edges, joint)
    elif of_robot and joint is not None:
        raise BadInputError(f"{path} does not exist; name the robot's description")
    elif of_robot:
        data = f'<?xml version="1.0"?>\n<robot name="rig">\n{_urdf_joints(new)}</robot>\n'.encode()
    else:
        data = _autoware(new).encode()
    replace_file(path, data)
    return {frame for links in ours for frame in links}


def with_edges(data: bytes, path: str, edges: Edges, joint: str | None = None) -> tuple[bytes, list[tuple[str, str]]]:
    """What `write_edges` writes to a file that exists, and which edges these are. Raises BadInputError."""
    if of_robot := Path(path).suffix.lower() in DESCRIPTIONS:
        between = {name: _links(found[0]) for name, found in _joints(data, path).items() if len(found) == 1}
        names = [name for name in between if between[name] in edges] if joint is None else [joint]
        for name in names:
            data = _with_origin(data, path, name, edges)
        ours = [between[name] for name in names]
    else:
        try:
            text = data.decode()
            root = io.compose(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise BadInputError(f"{path} is no valid YAML{io.what_is_wrong(error)}; correct it") from None
        ours = [(parent, child) for parent, child in edges if _value_of(_value_of(root, parent), child) is not None]
        ours = ours if joint is None else ours[:1]
        places: list[tuple[int, int, float]] = []
        for parent, child in ours:
            entry = _value_of(_value_of(root, parent), child)
            for name, value in zip(POSE_NAMES, xyz_rpy(edges[parent, child]), strict=True):
                node = _value_of(entry, name)
                if not isinstance(node, yaml.ScalarNode):
                    raise BadInputError(f"{path}: the entry of {child} must hold {', '.join(POSE_NAMES)}")
                places.append((node.start_mark.index, node.end_mark.index, value))
        for begin, end, value in sorted(places, reverse=True):
            text = text[:begin] + _number(value) + text[end:]
        data = text.encode()
    if not ours:
        what = "entry of the extrinsic" if joint is not None else f"{'joint' if of_robot else 'entry'} between the sensors"
        raise BadInputError(f"{path} has no {what}; {_no_edge(edges)}")
    return data, ours


def replace_file(path: str, data: bytes) -> None:
    """Write a file, and keep what was there as NAME.former; nothing where it is the same. BadInputError if it cannot be."""
    before = content(path)
    if data != before:
        if before is not None:
            io.write_atomically(path + FORMER, before)
        io.write_atomically(path, data)


def content(path: str) -> bytes | None:
    """Of a file; None if there is none. BadInputError if it cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; name a file") from None


def _joints(data: bytes, path: str) -> dict[str, list[Joint]]:
    """The joints of a robot's description by name. Those of transmissions have no type."""
    found: dict[str, list[Joint]] = {}
    within: list[Joint | None] = [None]  # for every element that is open: the joint around its children
    parser = expat.ParserCreate()

    def start(name: str, attributes: dict[str, str]) -> None:
        joint = within[-1]
        if joint is not None and name in ("parent", "child", "origin"):
            joint[0][name] = attributes.get("link", "")
            joint[1].setdefault(name, []).append(parser.CurrentByteIndex)
        elif name == "joint" and "type" in attributes:
            joint = ({}, {})
            found.setdefault(attributes.get("name", ""), []).append(joint)
        within.append(joint)

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: within.pop()
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise BadInputError(f"{path} is no valid XML: {error}; correct it") from None
    return found


def _links(joint: Joint) -> tuple[str, str]:
    return joint[0].get("parent", ""), joint[0].get("child", "")


def _with_origin(data: bytes, path: str, name: str, edges: Edges) -> bytes:
    """A robot's description with the origin of a joint replaced."""
    joints = _joints(data, path)
    if len(joints.get(name, ())) != 1:
        there = ", ".join(sorted(joints)[:8]) + (", ..." if len(joints) > 8 else "")
        count = len(joints[name]) if name in joints else "no"
        raise BadInputError(
            f"{path} has {count} joints named '{name}'; set export.joint to one of: {there or 'none, it has no joint'}"
        )
    (parent, child), places = _links(joints[name][0]), joints[name][0][1]
    origins = places.get("origin", [])
    if (parent, child) not in edges:
        raise BadInputError(f"{path}: joint '{name}' connects '{parent}' and '{child}'; {_no_edge(edges)}, and set export.joint")
    numbers = xyz_rpy(edges[parent, child])
    values = {b"xyz": _numbers(numbers[:3]).encode(), b"rpy": _numbers(numbers[3:]).encode()}
    at = origins[0] if origins else max(places[end][-1] for end in ("parent", "child"))
    tag = re.compile(rb"""<(?:origin|parent|child)(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, at)
    if len(origins) > 1 or tag is None:
        raise BadInputError(f"{path}: joint '{name}' has several origins, or the file is not in UTF-8; leave one, in UTF-8")
    if not origins:
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


def _value_of(node: yaml.Node | None, name: str) -> yaml.Node | None:
    """What a mapping holds under a name."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else ()
    return next((value for key, value in pairs if key.value == name), None)


def _no_edge(edges: Edges) -> str:
    """What to do."""
    names = ", ".join(f"{parent} -> {child}" for parent, child in edges)
    return f"name one of {names} (parent -> child), or publish the frames between them on /tf_static"


def _number(value: float) -> str:
    return repr(float(value) + 0.0)  # the shortest text that gives back every bit


def _numbers(values: Iterable[float]) -> str:
    return " ".join(map(_number, values))
