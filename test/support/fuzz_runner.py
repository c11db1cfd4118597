"""The fuzzer's own process: its memory is limited, a hang ends it with a stack, and what it found goes to stdout as JSON.

python -W error fuzz_runner.py messages|pipeline|texts|folders|cli SEED COUNT
"""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from fuzzing import HEIGHT, STAMP, WIDTH, K, MessageFuzzer, damage_folder, scan, text_file
from paths import ROOT

from calib_ros import result, se3
from calib_ros.camera import Camera
from calib_ros.config import Config, SemanticsConfig, load_stages
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_parts import typestore
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image, stamp_ns
from calib_ros.online.events import ExtrinsicUpdated, Inputs, Problem
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.state import load_state
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import INITIAL, Result
from calib_ros_semantics.models.segmentation import SegmentationModels

HANG_S = 120.0  # a hang does not end, while a busy machine takes its time
SPARE = 1500 << 20  # bytes of address space beyond what the process has when it starts to fuzz
CAMERA = Camera(K, WIDTH, HEIGHT)
EDGES_ONLY = Config.from_dict({"semantics": {"segmentation": "none"}})  # models are loaded anew for each recalibrator


class Run:
    """Counts what became of the cases; whatever is neither a success nor a CalibrationError is a failure."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.failures: list[str] = []
        self.most, self.base = (0.0, ""), 0.0

    def start(self) -> None:
        """From here on memory is limited and measured."""
        self.base = memory("VmRSS")
        used = int(memory("VmSize") * 2**20)
        resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, used + SPARE))

    def case(self, kind: str, label: str, work: Callable[[], Any]) -> Any:
        """What `work` returns; None if it refused the input, or failed."""
        faulthandler.dump_traceback_later(HANG_S, exit=True)
        forget_peak()
        before, value = memory("VmRSS"), None
        try:
            value = work()
            outcome = "taken"
        except CalibrationError as error:
            outcome = "refused"
            if "\n" in str(error) or len(str(error)) > 4000:
                self.fail(f"{label}: no single line: {str(error)[:300]!r}")
        except BaseException:
            outcome = "failed"
            self.fail(f"{label}: {traceback.format_exc()[-3000:]}")
        self.most = max(self.most, (memory("VmHWM") - before, label))
        self.outcomes[f"{kind} {outcome}"] += 1
        faulthandler.cancel_dump_traceback_later()
        return value

    def fail(self, text: str) -> None:
        if len(self.failures) < 40:
            self.failures.append(text)

    def report(self) -> dict[str, Any]:
        found = {name: getattr(self, name) for name in ("outcomes", "failures", "most")}
        return {**found, "grown": memory("VmRSS") - self.base}


def memory(name: str) -> float:
    """VmRSS, VmHWM (its highest) or VmSize of this process, MiB."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith(name))


def forget_peak() -> None:
    with open("/proc/self/clear_refs", "w") as clear:
        clear.write("5")


# --- messages -------------------------------------------------------------------------------------------------------------


def families() -> list[str]:
    try:
        import sensor_msgs.msg  # noqa: F401
    except ImportError:
        return ["rosbags"]
    return ["rosbags", "rclpy"]


def decode(image: Any, cloud: Any, camera: Camera) -> Frame:
    pixels = decode_compressed_image(image) if hasattr(image, "format") else decode_image(image)
    return Frame(pixels, decode_cloud(cloud), camera, stamp_ns(image.header.stamp), stamp_ns(cloud.header.stamp))


def good_frame(seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    columns = scan(rng)
    kinds = {"xyz": np.float32, "intensity": np.float32, "ring": np.int32}
    cloud = PointCloud(**{name: columns[name].astype(kind) for name, kind in kinds.items()})
    return Frame(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), cloud, CAMERA, STAMP, STAMP)


def messages(run: Run, seed: int, count: int) -> None:
    """Every message is decoded; of those that can be, every third goes on to the features of a keyframe."""
    fuzzers = [MessageFuzzer(seed + k, family) for k, family in enumerate(families())]
    good = good_frame()
    recalibrator = Recalibrator(CAMERA, nominal(0.0))

    def ingest(frame: Frame) -> None:
        recalibrator.selector.reset()
        recalibrator.ingest(frame)

    for _ in range(3):
        ingest(good)
    run.start()
    for k in range(count):
        fuzzer = fuzzers[k % len(fuzzers)]
        kind = ("cloud", "cloud", "image", "compressed", "camera_info")[k // 2 % 5]
        message = getattr(fuzzer, kind)()
        label = f"{kind} {k} of {fuzzer.make.family}"
        if kind == "camera_info":
            rectified = fuzzer.chance(0.2)
            camera = run.case(kind, label, lambda m=message, r=rectified: decode_camera_info(m, r))
            if camera is not None and k % 2 == 0:
                run.case("camera in use", label, lambda c=camera: in_use(c, good))
        elif kind == "cloud":
            cloud = run.case(kind, label, lambda m=message: decode_cloud(m))
            if cloud is not None and k % 3 == 0:
                stamp = stamp_ns(message.header.stamp)
                run.case("scan in use", label, lambda c=cloud, s=stamp: ingest(Frame(good.image, c, CAMERA, STAMP, s)))
        else:
            decoder = decode_image if kind == "image" else decode_compressed_image
            image = run.case(kind, label, lambda m=message, d=decoder: d(m))
            if image is not None and k % 3 == 0:
                run.case("picture in use", label, lambda i=image: ingest(Frame(i, good.cloud, CAMERA, STAMP, STAMP)))


def in_use(camera: Camera, good: Frame) -> None:
    """What the node does with a camera: features of a frame, points in the picture."""
    recalibrator = Recalibrator(camera, nominal(0.0), EDGES_ONLY)
    recalibrator.ingest(Frame(good.image, good.cloud, camera, STAMP, STAMP))
    camera.project(good.cloud.xyz @ nominal(0.0)[:3, :3].T)


def pipeline(run: Run, seed: int, count: int) -> None:
    """Pairs of messages, one of them mutated, through the pipeline with both its threads."""
    fuzzers = [MessageFuzzer(seed + k, family) for k, family in enumerate(families())]
    events: list[Any] = []
    inputs = Inputs(decode, lambda image, cloud: ("camera", "lidar"), lambda *_: Result(nominal(0.0), INITIAL))
    few = {"starts": 64, "rounds": 1}
    whole = Pipeline(Config.from_dict({"search": few, "online": {"similarity_threshold": 1.0}}), inputs, events.append)
    whole.set_camera(CAMERA)
    SegmentationModels(SemanticsConfig())(good_frame(seed))  # the first import of its libraries takes seconds
    run.start()
    for k in range(count):
        fuzzer = fuzzers[k % len(fuzzers)]
        stamp = STAMP + k * NANOSECONDS
        if k % 10 == 9:
            camera = run.case("camera", f"camera {k}", lambda f=fuzzer: decode_camera_info(f.camera_info()))
            whole.set_camera(camera or CAMERA)
        image, cloud = fuzzer.one((fuzzer.image, fuzzer.compressed, *2 * [fuzzer.good_image]))(), fuzzer.cloud(stamp)

        def take_in(image: Any = image, cloud: Any = cloud, stamp: int = stamp) -> None:
            whole.add_image(stamp, image)
            whole.add_cloud(stamp, cloud)
            if not whole.wait_idle(HANG_S):
                raise TimeoutError("the pipeline hangs")

        run.case("pair", f"pair {k} of {fuzzer.make.family}", take_in)
        whole.set_camera(CAMERA)
    if not whole.stop():
        run.fail("the pipeline does not stop")
    for line in (event.message for event in events if isinstance(event, Problem)):
        run.outcomes["pipeline says"] += 1
        if line.startswith("unexpected") or "\n" in line:
            run.fail(line)
    extrinsics = [event.extrinsic for event in events if isinstance(event, ExtrinsicUpdated)]
    for extrinsic in extrinsics:
        se3.as_transform(extrinsic.result.T_camera_lidar)
    run.outcomes["extrinsics"] = len(extrinsics)


# --- files ----------------------------------------------------------------------------------------------------------------

SHIPPED = ROOT / "config" / "calib_ros.yaml"


def texts(run: Run, seed: int, count: int) -> None:
    """Configurations, parameter files, results and states."""
    rng = np.random.default_rng(seed)
    samples = {"config": configurations(rng), "result": results(), "state": results()}
    work: dict[str, Callable[[Path], Any]] = {
        "config": lambda path: Config.from_dict(load_stages(path)),
        "result": lambda path: usable(result.load(path)),
        "state": lambda path: usable(load_state(path, CAMERA, "camera", "lidar")),
    }
    with tempfile.TemporaryDirectory() as folder:
        run.start()
        for k in range(count):
            kind = ("config", "result", "state", "config")[k % 4]
            path = mutated(rng, samples[kind], Path(folder))
            run.case(kind, f"{kind} {k}", lambda p=path, w=work[kind]: w(p))


def mutated(rng: np.random.Generator, samples: list[tuple[str, str]], folder: Path) -> Path:
    """A file made of one of the samples (name, text), with something wrong."""
    name, text = samples[int(rng.integers(len(samples)))]
    (folder / name).write_bytes(text_file(rng, text))
    return folder / name


def usable(loaded: Result) -> None:
    """A result that was read can be written again, as JSON, YAML and a message."""
    se3.as_transform(loaded.T_camera_lidar)
    for yaml_format in (False, True):
        result.parse(loaded.dumps(yaml_format), "what was written")
    loaded.dumps().encode()
    if not 0 <= loaded.frames_used < 2**32:
        raise ValueError(f"frames_used = {loaded.frames_used}")
    "".join((loaded.status, loaded.reason, loaded.camera_frame, loaded.lidar_frame)).encode()


def configurations(rng: np.random.Generator) -> list[tuple[str, str]]:
    """Parts of the shipped file, as parameters of the node and as stages."""
    lines = [line.strip() for line in SHIPPED.read_text().splitlines() if ": " in line and not line.strip().startswith("#")]
    out = []
    for _ in range(40):
        some = [lines[int(k)] for k in rng.integers(0, len(lines), 12)]
        out.append(("params.yaml", "/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in some)))
        stages: dict[str, list[str]] = {}
        for line in some:
            stage, dot, value = line.partition(".")
            if dot and ":" not in stage:
                stages.setdefault(stage, []).append(value)
        out.append(("config.yaml", "".join(f"{s}:\n" + "".join(f"  {v}\n" for v in vs) for s, vs in stages.items())))
    return out


def results() -> list[tuple[str, str]]:
    full = Result(nominal(0.0), "converged", "ok", 0.5, np.eye(6) * 1e-4, 7, frame_scores=(0.5, 0.4), frame_names=("a", "b"))
    camera = {"width": WIDTH, "height": HEIGHT, "K": K.tolist(), "model": "plumb_bob", "D": []}
    state = json.dumps({**full.to_dict(), "camera": camera}, indent=1)
    parts = {name: full.to_dict()[name] for name in ("translation_m", "quaternion_xyzw")}
    return [("a.json", full.dumps()), ("a.yaml", full.dumps(True)), ("state.json", state), ("b.json", json.dumps(parts))]


def frames(count: int = 2) -> list[Frame]:
    """Tiny frames, of too few points for features."""
    rng = np.random.default_rng(1)
    out = []
    for k in range(count):
        cloud = PointCloud(rng.normal(size=(30, 3)).astype(np.float32), rng.random(30).astype(np.float32))
        image = rng.integers(0, 256, (24, 40, 3), np.uint8)
        out.append(Frame(image, cloud, Camera(K, 40, 24), STAMP + k * NANOSECONDS // 10, None, nominal(0.0), f"{k}"))
    return out


class Listed:
    """A source made of frames."""

    def __init__(self, listed: list[Frame]) -> None:
        self.frames, self.name, self.camera_frame, self.lidar_frame = listed, "listed", "camera", "lidar"
        self.camera, self.reference = listed[0].camera, listed[0].reference

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]

    def describe(self) -> dict[str, str]:
        return {}


def kitti(folder: Path, layout: str) -> None:
    """A drive of two frames."""
    import cv2

    def text(values: Any) -> str:
        return " ".join(f"{v:e}" for v in np.ravel(values))

    T, P = nominal(0.0)[:3], f"P2: {text(np.c_[K, [1.0, 0, 0]])}\n"
    files: dict[str, str] = {}
    if layout == "raw":
        rectified = f"R_rect_00: {text(np.eye(3))}\n{P.replace('2', '_rect_02', 1)}"
        files["calib_cam_to_cam.txt"] = f"calib_time: 09-Jan-2012 13:57:47\n{rectified}"
        files["calib_velo_to_cam.txt"] = f"R: {text(T[:, :3])}\nT: 0.1 0.2 0.3\ndelta_f: 0 0\n"
        files["calib_imu_to_velo.txt"] = f"R: {text(np.eye(3))}\nT: -0.8 0.3 -0.8\n"
        for name in ("image_02/timestamps.txt", *(f"velodyne_points/timestamps{s}.txt" for s in ("", "_start", "_end"))):
            files[name] = "".join(f"2011-09-26 13:02:25.{k}64000000\n" for k in (1, 2))
        files |= {f"oxts/data/{k:010d}.txt": " ".join(str(0.1 * v) for v in range(30)) + "\n" for k in range(2)}
    elif layout == "odometry":
        files |= {"calib.txt": f"{P}Tr: {text(T)}\n", "times.txt": "0.0\n1.03e-1\n"}
    else:
        files |= {f"calib/{k:06d}.txt": f"{P}R0_rect: {text(np.eye(3))}\nTr_velo_to_cam: {text(T)}\n" for k in range(2)}
    raw = layout == "raw"
    images, clouds = ("image_02/data", "velodyne_points/data") if raw else ("image_2", "velodyne")
    for k, frame in enumerate(frames()):
        name = f"{k:0{10 if raw else 6}d}"
        for place in (images, clouds):
            (folder / place).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / images / f"{name}{'.jpg' if layout == 'odometry' and k else '.png'}"), frame.image)
        np.c_[frame.cloud.xyz, frame.cloud.intensity].astype("<f4").tofile(folder / clouds / f"{name}.bin")
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


def plain(folder: Path) -> None:
    """A plain folder of two frames, a cloud in PCD and one in PLY."""
    import cv2
    from pypcd4 import Encoding
    from pypcd4 import PointCloud as PcdFile

    (folder / "images").mkdir(parents=True)
    (folder / "clouds").mkdir()
    K_text = ", ".join(f"{v:g}" for v in K.ravel())
    rows = "".join(f"- {row}\n" for row in nominal(0.0).tolist())
    (folder / "calibration.yaml").write_text(
        f"image_width: 40\nimage_height: 24\ncamera_matrix: {{rows: 3, cols: 3, data: [{K_text}]}}\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}}\nT_camera_lidar:\n{rows}"
    )
    (folder / "times.csv").write_text(f"name,image_ns,cloud_ns\n0,{STAMP},{STAMP}\n1,{STAMP + 10**8},\n")
    first, second = frames()
    for frame in (first, second):
        cv2.imwrite(str(folder / "images" / f"{frame.name}.{'bmp' if frame is first else 'png'}"), frame.image)
    points = np.c_[first.cloud.xyz, first.cloud.intensity]
    PcdFile.from_xyzi_points(points).save(folder / "clouds/0.pcd", Encoding.BINARY_COMPRESSED)
    header = "ply\nformat ascii 1.0\nelement vertex 30\n" + "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    lines = "".join(f"{x} {y} {z}\n" for x, y, z in second.cloud.xyz.tolist())
    (folder / "clouds/1.ply").write_text(header + lines)


def plain_otherwise(folder: Path) -> None:
    """The same in other formats: LAS and CSV, TIFF and WebP."""
    import cv2
    import laspy

    plain(folder)
    for part in ("images", "clouds"):
        for path in (folder / part).iterdir():
            path.unlink()
    first, second = frames()
    cv2.imwrite(str(folder / "images/0.tif"), first.image)
    cv2.imwrite(str(folder / "images/1.webp"), second.image)
    las = laspy.create()
    las.x, las.y, las.z = first.cloud.xyz.T.astype(float)
    las.write(folder / "clouds/0.las")
    np.savetxt(folder / "clouds/1.csv", second.cloud.xyz, "%.3f", ",", header="x,y,z")


def ros1(folder: Path) -> None:
    """A bag of ROS 1 of the same frames."""
    from rosbags.rosbag1 import Writer
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    path = write_bag(Listed(frames()), folder.parent / "to_convert")
    folder.mkdir()
    with Reader(path) as reader, Writer(folder / "drive.bag") as writer:
        topics = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, time, data in reader.messages():
            writer.write(topics[connection.topic], time, typestore().cdr_to_ros1(data, connection.msgtype))
    shutil.rmtree(path)


def nuscenes(folder: Path) -> None:
    """A scene of two key frames."""
    import cv2

    pose = {"translation": [0.1, 0.2, 0.3], "rotation": [1.0, 0.0, 0.0, 0.0]}
    channels = {"CAM_FRONT": "camera", "LIDAR_TOP": "lidar"}
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "s", "name": "scene-0061"}],
        "sample": [{"token": f"f{k}", "scene_token": "s", "timestamp": k} for k in range(2)],
        "sensor": [{"token": name, "channel": name, "modality": kind} for name, kind in channels.items()],
        "calibrated_sensor": [
            {"token": f"c{name}", "sensor_token": name, **pose, "camera_intrinsic": K.tolist() if kind == "camera" else []}
            for name, kind in channels.items()
        ],
        "sample_data": [],
        "ego_pose": [],
    }
    for k, frame in enumerate(frames()):
        for name, kind in channels.items():
            file = folder / "samples" / name / f"{k}{'.png' if kind == 'camera' else '.pcd.bin'}"
            file.parent.mkdir(parents=True, exist_ok=True)
            if kind == "camera":
                cv2.imwrite(str(file), frame.image)
            else:
                np.c_[frame.cloud.xyz, frame.cloud.intensity, np.zeros(30)].astype("<f4").tofile(file)
            token, stamp = f"{name}{k}", frame.stamp // 1000
            row = {"sample_token": f"f{k}", "ego_pose_token": token, "calibrated_sensor_token": f"c{name}", "timestamp": stamp}
            row |= {"filename": str(file.relative_to(folder)), "is_key_frame": True, "width": 40, "height": 24}
            tables["sample_data"].append({"token": token, **row})
            tables["ego_pose"].append({"token": token, "timestamp": stamp, **pose})
    (folder / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows, indent=0))


def originals(root: Path) -> list[Path]:
    """Three bags, three KITTI drives, two plain folders and nuScenes, intact."""
    out = [write_bag(Listed(frames()), root / f"bag_{storage}", storage) for storage in ("mcap", "sqlite3")]
    for layout in ("raw", "odometry", "object"):
        folder = root / layout
        folder.mkdir()
        kitti(folder, layout)
        out.append(folder)
    for make in (plain, plain_otherwise, nuscenes):
        make(root / make.__name__)
        out.append(root / make.__name__)
    ros1(root / "bag_ros1")
    return [*out, root / "bag_ros1"]


def folders(run: Run, seed: int, count: int) -> None:
    """Bags and folders: opened, described and read, as the commands do."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        whole = originals(Path(name))
        for path in whole:
            read_through(path)
        run.start()
        for k in range(count):
            source = whole[k % len(whole)]
            broken = Path(name) / "broken" / source.name
            shutil.copytree(source, broken)
            damage_folder(rng, broken)
            target = broken
            if source.name.startswith("bag") and rng.random() < 0.5:
                stores = [path for path in broken.iterdir() if path.is_file() and path.suffix in (".mcap", ".db3", ".bag")]
                target = stores[0] if stores else broken
            run.case(source.name, f"{source.name} {k}", lambda p=target: read_through(p))
            shutil.rmtree(broken)


def read_through(path: Path) -> None:
    from calib_ros.cli.output import describe

    source = open_dataset(path)
    try:
        describe(source)
        for index in range(min(len(source), 3)):
            source[index]
    except OSError as error:  # the command line says these in one line, too
        raise BadInputError(str(error)) from None
    finally:
        getattr(source, "close", lambda: None)()


def cli(run: Run, seed: int, count: int) -> None:
    """Whole commands in this process: the exit code, and what a terminal shows."""
    from calib_ros.cli.main import main

    rng = np.random.default_rng(seed)
    texts_of = {"--config": configurations(rng), "--initial": results()}
    with tempfile.TemporaryDirectory() as name:
        whole = originals(Path(name))
        terminal = os.open(Path(name) / "terminal", os.O_RDWR | os.O_CREAT)
        stderr = os.dup(2)
        run.start()
        for k in range(count):
            source = whole[k % len(whole)]
            broken = Path(name) / "broken" / source.name
            shutil.copytree(source, broken)
            if k % 2:
                option = "--config" if k % 4 == 1 else "--initial"
                argv = [("calibrate", "replay")[k // 4 % 2], str(broken), option, str(mutated(rng, texts_of[option], Path(name)))]
            else:
                damage_folder(rng, broken)
                command = ("info", "replay", "convert", "info")[k // 2 % 4]
                argv = [command, str(broken)] + ([str(Path(name) / "broken" / "converted")] if command == "convert" else [])
            os.ftruncate(terminal, 0)
            os.lseek(terminal, 0, os.SEEK_SET)
            os.dup2(terminal, 2)
            written = StringIO()
            try:
                with open(os.dup(2), "w") as shown, redirect_stderr(shown), redirect_stdout(written):
                    code = run.case(f"cli {argv[0]}", f"{' '.join(argv)} {k}", lambda a=argv: main(a))
            finally:
                os.dup2(stderr, 2)
            said = os.pread(terminal, 100_000, 0).decode("utf-8", "replace")
            if code not in (0, 1, 2):
                run.fail(f"{argv}: exit code {code}")
            if "Traceback" in said or (code == 2 and (said.count("\n") != 1 or not said.startswith("calib-ros: "))):
                # A replay notes each frame that it leaves out.
                run.fail(f"{argv}, code {code} says: {said[:1500]}")
            run.outcomes[f"code {code}"] += 1
            shutil.rmtree(Path(name) / "broken")


if __name__ == "__main__":
    warnings.simplefilter("error")
    what, first, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    this = Run()
    {"messages": messages, "pipeline": pipeline, "texts": texts, "folders": folders, "cli": cli}[what](this, first, number)
    sys.__stdout__.write(json.dumps(this.report()) + "\n")
    sys.__stdout__.flush()
