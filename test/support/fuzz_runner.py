"""The fuzzer's own process: its memory is limited, a hang ends it with a stack, and what it found goes to stdout as JSON.

python -W error fuzz_runner.py messages|commands SEED COUNT
"""

from __future__ import annotations

import faulthandler
import json
import os
import re
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
from compressed_bags import ENCODERS, FOXGLOVE, video_message
from fuzzing import HEIGHT, STAMP, WIDTH, K, MessageFuzzer, damage_folder, scan, text_file
from paths import ROOT
from sample_sources import originals

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame, PointCloud
from calib_ros.messages import (
    decode_camera_info,
    decode_cloud,
    decode_compressed_cloud,
    decode_compressed_image,
    decode_image,
    stamp_ns,
)
from calib_ros.messages.video import VideoDecoder, packet_of, picture_of
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import Result

HANG_S = 120.0  # a hang does not end, while a busy machine takes its time
SPARE = 1500 << 20  # bytes of address space beyond what the process has when it starts to fuzz
CAMERA = Camera(K, WIDTH, HEIGHT)
EDGES_ONLY = Config.from_dict({"semantics": {"segmentation": "none"}})  # models are loaded anew for each recalibrator
# Lines that the libraries of JPEG, PNG and TIFF write to stderr themselves.
OF_CODECS = re.compile(
    r"^(?:(?:\w+ )?(?:Corrupt|Premature|Invalid|Unsupported|Bogus|Inconsistent) .*|libpng .*|\[ *(?:WARN|ERROR):.*)\n",
    re.MULTILINE,
)


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


def good_frame(seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    columns = scan(rng)
    kinds = {"xyz": np.float32, "intensity": np.float32, "ring": np.int32}
    cloud = PointCloud(**{name: columns[name].astype(kind) for name, kind in kinds.items()})
    return Frame(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), cloud, CAMERA, STAMP, STAMP)


def messages(run: Run, seed: int, count: int) -> None:
    """Every message is decoded; of those that can be, every third goes on to the features of a keyframe."""
    fuzzers = [MessageFuzzer(seed + k, family) for k, family in enumerate(families())]
    first, good, recalibrator = fuzzers[0], good_frame(), Recalibrator(CAMERA, nominal(0.0))

    def ingest(frame: Frame) -> None:
        recalibrator.selector.reset()
        recalibrator.ingest(frame)

    decoders = {"cloud": decode_cloud, "image": decode_image, "compressed": decode_compressed_image} | {
        "camera_info": lambda message: decode_camera_info(message, bool(message.height % 5 == 0)),
        "video": watch,
        "compressed_cloud": decode_compressed_cloud,
    }
    for codec in ENCODERS:  # their libraries, before memory is limited
        watch([video_message(first.make, FOXGLOVE, codec, first.make.header(), packet) for packet in first.packets_of(codec)])
    decode_compressed_cloud(first.make.compressed_cloud(np.zeros(3, [(name, "<f4") for name in "xyz"]), "draco"))
    for _ in range(3):
        ingest(good)
    run.start()
    for k in range(count):
        kind = tuple(decoders)[k % len(decoders)]
        fuzzer = (
            first if kind in ("video", "compressed_cloud") else fuzzers[k // len(decoders) % len(fuzzers)]
        )  # rclpy has neither
        message, label = getattr(fuzzer, kind)(), f"{kind} {k} of {fuzzer.make.family}"
        decoded = run.case(kind, label, lambda d=decoders[kind], m=message: d(m))
        if decoded is None or k // len(decoders) % 3:
            continue
        if kind == "camera_info":
            run.case("camera in use", label, lambda c=decoded: in_use(c, good))
        elif kind == "cloud":
            stamp = stamp_ns(message.header.stamp)
            run.case("scan in use", label, lambda c=decoded, s=stamp: ingest(Frame(good.image, c, CAMERA, STAMP, s)))
        elif kind in ("image", "compressed"):
            run.case("picture in use", label, lambda i=decoded: ingest(Frame(i, good.cloud, CAMERA, STAMP, STAMP)))


def watch(messages: list[Any]) -> None:
    """What a bag does with a video topic from a key frame on."""
    decoder = VideoDecoder(packet_of(messages[0]).codec)
    for number, message in enumerate(messages):
        for _, picture in decoder.decode(packet_of(message).data, number):
            picture_of(picture)


def in_use(camera: Camera, good: Frame) -> None:
    """What the node does with a camera: features of a frame, points in the picture."""
    recalibrator = Recalibrator(camera, nominal(0.0), EDGES_ONLY)
    recalibrator.ingest(Frame(good.image, good.cloud, camera, STAMP, STAMP))
    camera.project(good.cloud.xyz @ nominal(0.0)[:3, :3].T)


# --- files ----------------------------------------------------------------------------------------------------------------

SHIPPED = ROOT / "config" / "calib_ros.yaml"


def mutated(rng: np.random.Generator, samples: list[tuple[str, str]], folder: Path) -> Path:
    """A file made of one of the samples (name, text), with something wrong."""
    name, text = samples[int(rng.integers(len(samples)))]
    (folder / name).write_bytes(text_file(rng, text))
    return folder / name


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


def commands(run: Run, seed: int, count: int) -> None:
    """Whole commands in this process: the exit code, and what a terminal shows."""
    from calib_ros.cli.main import main

    rng = np.random.default_rng(seed)
    texts_of = {"--config": configurations(rng), "--initial": results(), "export": results()}
    with tempfile.TemporaryDirectory() as name:
        whole = originals(Path(name))
        terminal = os.open(Path(name) / "terminal", os.O_RDWR | os.O_CREAT)
        stderr = os.dup(2)
        run.start()
        for k in range(count):
            source = whole[k % len(whole)]
            broken = Path(name) / "broken" / source.name
            shutil.copytree(source, broken)
            if rng.random() < 0.3:
                option = ("--config", "--initial", "export")[int(rng.integers(3))]
                text = str(mutated(rng, texts_of[option], Path(name)))
                argv = ["export", text, "--format", "yaml"] if option == "export" else ["replay", str(broken), option, text]
            else:
                damage_folder(rng, broken)
                stores = [p for p in broken.iterdir() if p.suffix in (".mcap", ".db3", ".bag") and p.is_file()]
                target = stores[0] if stores and rng.random() < 0.5 else broken
                command = ("info", "replay", "convert")[int(rng.integers(3))]
                argv = [command, str(target)] + ([str(Path(name) / "broken" / "converted")] if command == "convert" else [])
            os.ftruncate(terminal, 0)
            os.lseek(terminal, 0, os.SEEK_SET)
            os.dup2(terminal, 2)
            written = StringIO()
            try:
                with open(os.dup(2), "w") as shown, redirect_stderr(shown), redirect_stdout(written):
                    code = run.case(source.name, f"{' '.join(argv)} {k}", lambda a=argv: main(a))
            finally:
                os.dup2(stderr, 2)
            said = OF_CODECS.sub("", os.pread(terminal, 100_000, 0).decode("utf-8", "replace"))
            if code not in (0, 1, 2):
                run.fail(f"{argv}: exit code {code}")
            if "Traceback" in said or (code == 2 and (said.count("\n") != 1 or not said.startswith("calib-ros: "))):
                # A replay notes each frame that it leaves out.
                run.fail(f"{argv}, code {code} says: {said[:1500]}")
            run.outcomes[f"{source.name} code {code}"] += 1
            shutil.rmtree(Path(name) / "broken")


if __name__ == "__main__":
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", FutureWarning)  # names of former versions, which a mutation may make
    what, first, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    this = Run()
    {"messages": messages, "commands": commands}[what](this, first, number)
    sys.__stdout__.write(json.dumps(this.report()) + "\n")
    sys.__stdout__.flush()
