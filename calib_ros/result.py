"""The answer: an extrinsic with what is known about it, and its file format."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_ros import io, se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.errors import BadInputError, ConfigError
from calib_ros.intrinsics import IntrinsicEstimate, RefinedCamera
from calib_ros.io import AsJson, write_atomically
from calib_ros.version import __version__

VERSION = __version__
LensEffect = tuple[Matrix, Covariance]  # see Result.lens_effect
CONVERGED, REFUSED, INSUFFICIENT = "converged", "refused", "insufficient"
INITIAL = "initial"  # status of an extrinsic that no frame has confirmed yet
# Statuses of the online recalibrator. The transform is the last good one; while moved, the newest that nothing confirms yet.
TENTATIVE = "tentative"  # accepted, but not confirmed by further keyframes yet
SUSPECT = "suspect"  # the newest keyframes do not fit it; being checked
MOVED = "moved"  # the calibration has moved; it is searched anew
BLINDED = "blinded"  # a sensor shows nothing: covered lens, frozen image, empty cloud

CONSUMERS_SIGMAS = 2.0  # an error is within so many standard deviations with 95 %
# What several troubles have in common, see Trouble.
INTRINSICS = "calibrate the camera's intrinsics, or have them refined"
FRAMES, WIDER = "--frames {frames}", "--search-deg {deg:g} --search-m {m:g}"
CLOCKS, LOOK = "--time-offset {seconds:.3g}", "check exposure, topics and stamps"


class Trouble(Enum):
    """What may be wrong: the one table of what terminal, pages and messages say of it.

    words: what it is. advice: what to do. options: of `calib-ros` that do it, with fields for figures; "" where none do.
    """

    words: str
    advice: str
    options: str

    def __new__(cls, value: str, words: str, advice: str, options: str = "") -> Trouble:
        """A member by its value in files and messages."""
        own = object.__new__(cls)
        own._value_, own.words, own.advice, own.options = value, words, advice, options
        return own

    def __str__(self) -> str:
        """The first part of a reason; figures follow."""
        return f"{self.words}: {self.advice}"


class RefusalCode(Trouble):
    """Why an estimate is refused or insufficient. ``Result.reason`` begins with its words, or with those of the cause."""

    # status insufficient: too few points or edges, or no classes for a first guess
    TOO_FEW_FEATURES = "too_few_features", "too little to see", "give frames with objects in view of both sensors", FRAMES
    WORSE_THAN_START = "worse_than_start", "no better extrinsic found", "check the start: it may be right as it is"
    TOO_FAR_FROM_START = "too_far_from_start", "the search is too narrow", "widen the search", WIDER
    LOW_SCORE = "low_score", "nothing in the image where the LiDAR sees edges", LOOK, WIDER
    NOT_SIGNIFICANT = "not_significant", "the optimum may be chance", "use more scenes, or widen the search", WIDER
    TOO_UNCERTAIN = "too_uncertain", "these scenes leave the extrinsic open", "add frames of other scenes", FRAMES
    OBJECTIVES_DISAGREE = "objectives_disagree", "two forms of the score disagree", "start nearer", "--objective fast"
    WRONG_INTRINSICS = "wrong_intrinsics", "wrong intrinsics", "check K and D in camera_info"
    WRONG_TIMES = "wrong_times", "wrong times", "synchronise the clocks"


class Cause(Trouble):
    """What is wrong besides the mount, where the frames show it; the simplest first."""

    TIME_OFFSET = "time_offset", "clocks apart", "mend the time stamps, or set motion.time_offset_s", CLOCKS
    FOCAL_LENGTH = "focal_length", "wrong focal length", INTRINSICS, "--intrinsics refine"  # or fx against fy
    PRINCIPAL_POINT = "principal_point", "wrong principal point", INTRINSICS, "--intrinsics refine"
    OTHER_CAMERA = "other_camera", "another camera's CameraInfo", "give K and D of this camera for this image size"
    NOT_RECTIFIED = "not_rectified", "a lens distortion that is not stated", "take the rectified topic, or the raw CameraInfo"
    ALREADY_RECTIFIED = "already_rectified", "rectified image called distorted", "set image_is_rectified: true", "--rectified"
    MIRRORED_IMAGE = "mirrored_image", "mirrored image", "flip it, or switch the driver's mirroring off"
    ROTATED_IMAGE = "rotated_image", "turned image", "turn it back, or mend the driver's rotation"
    INVERSE_TRANSFORM = "inverse_transform", "transform the wrong way round", "invert it"
    BODY_FRAME = "body_frame", "camera_link taken for the optical frame", "give the transform of the optical frame"
    QUATERNION_ORDER = "quaternion_order", "quaternion in another order", "give it as (x, y, z, w)"
    CLOUD_FRAME = "cloud_frame", "points in another frame", "publish them in the scanner's frame"


class InitialSource(Enum):
    """Where an initial extrinsic comes from."""

    SAVED_STATE = "saved_state"
    PARAMETERS = "parameters"
    TF = "tf"
    NOMINAL = "nominal"  # where none is known
    SEMANTIC = "semantic"  # from the classes of points and pixels
    MOTION = "motion"  # from the motion of both sensors


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")


@dataclass(frozen=True)
class Stamping:
    """How scans without point times are stamped. spin: as motion.spin. azimuth_deg: azimuth of the scanner half a turn after the
    scan began, as motion.stamp_azimuth_deg with motion.stamp_at: middle; the time offset counts from there."""

    spin: str
    azimuth_deg: float


@dataclass(frozen=True)
class Evidence:
    """What speaks for an optimum besides its score.

    z_score: of the score, in standard deviations of the null distribution. decoy_z_score: of the best optimum in the mirrored
    image; None where there was no doubt. p_value: of z_score against the decoy. disagreement: of halves of the data, squared, in
    units of what their covariances let expect. scenes: how many different ones the frames are worth; 0 = not known.
    """

    z_score: float
    decoy_z_score: float | None
    p_value: float
    disagreement: float
    scenes: float = 0.0


@dataclass(frozen=True, eq=False)
class Result(AsJson):
    """An estimate of the extrinsic, or an initial extrinsic in the same form.

    What is None, NaN or empty is unknown or does not apply. * : not part of the file format.

    Attributes
    ----------
    T_camera_lidar : (4, 4), from the LiDAR's into the camera's optical frame. Where the estimate is not to be used, the start.
    status : ``converged``, ``refused`` (the optimum is not to be used), ``insufficient`` (too little seen to estimate anything),
        ``initial``, or one of the online recalibrator's: ``tentative``, ``suspect``, ``moved``, ``blinded``.
    reason : for people, one line of parts between semicolons: what is wrong and what to do, at most 100 characters; then figures,
        and what else there is to know.
    score : value of the objective at the optimum, also of a refused one. initial_score : at the start.
    covariance : (6, 6) of a left perturbation (rx, ry, rz, tx, ty, tz), rad and m, for who projects with the camera as it is
        stated: a principal point that is off looks like a rotation, and together with it projects alike.
        covariance_with_intrinsics : the same for who does not, as a rig of several cameras.
    frames_used : number of frames of the estimate without the outlier frames.
    camera_frame, lidar_frame : names of the camera's optical frame and of the LiDAR's.
    elapsed_s : wall-clock time of the estimate. stamp : ISO 8601, UTC.
    initial : (4, 4), the start.
    frame_scores : of every frame, same scale as `score`; NaN for an outlier frame. frame_names : of all frames.
    frames_left_out : names of the outlier frames.
    starts : of a search, how many of how many independent starts ended at the result.
    reference_error : deg and m, if the source knows a reference.
    motion : for people, how the vehicle's motion was dealt with.
    refusal : why it is refused or insufficient. refusal_figures : numbers that this rests on, by name, as ``seconds`` of
        ``wrong_times``. cause : what is wrong besides the mount, if the frames show it.
    optimum : (4, 4), the one that was refused. Not to be used as a calibration. optimum_covariance* : (6, 6), of that one.
    evidence : what speaks for the optimum.
    intrinsics : ``focal_length_share``, ``principal_point_x_px`` and ``principal_point_y_px``: which change of the given ones, to
        which the extrinsic belongs, the scenes match best with. With camera.intrinsics: refine, the changes that were made,
        ``k1`` among them.
    refined_camera : the intrinsics corrected together with the extrinsic, where camera.intrinsics is refine.
        `Calibrator.calibrate` states the extrinsic for it, `Calibrator.estimate` that for the camera that was given.
    origin* : where an initial extrinsic comes from.
    shared_covariance* : (6, 6), part of both that estimates of the same sensors have in common: what the clocks leave open.
    lens_effect* : twist (6, n) of the extrinsic per unit of each change of the lens, rad and m, and the second moment (n, n) of
        these: the rest of `covariance_with_intrinsics`.
    clock_direction* : (6,), left twist of the extrinsic per second that the points are measured later, rad/s and m/s.
    clock_sigma_s* : standard deviation, s, of an offset of the clocks that may be as large as motion.max_time_offset_s, as far as
        the scenes tell. clock_offset_s* : that offset by the scenes alone, as `time_offset_s`, be it used or not.
    time_offset_s : of the clocks, which belongs to the extrinsic, as motion.time_offset_s: positive = points were measured later,
        or the image was exposed earlier, than stamped. time_offset_sigma_s : its standard deviation, s.
    stamping : how scans without point times are stamped, where the frames show that it is another way than configured.
    data_stamp* : of the newest frame in it, ns, by the sensors' clock; 0 if unknown.
    """

    T_camera_lidar: Transform
    status: str
    reason: str = ""
    score: float = math.nan
    covariance: Covariance | None = None
    frames_used: int = 0
    camera_frame: str = "camera"
    lidar_frame: str = "lidar"
    elapsed_s: float = 0.0
    initial_score: float = math.nan
    initial: Transform | None = None
    frame_scores: tuple[float, ...] = ()
    frame_names: tuple[str, ...] = ()
    frames_left_out: tuple[str, ...] = ()
    starts: tuple[int, int] | None = None
    reference_error: tuple[float, float] | None = None
    motion: str = ""
    stamp: str = field(default_factory=_now)
    refusal: RefusalCode | None = None
    refusal_figures: Mapping[str, float] = field(default_factory=dict)
    cause: Cause | None = None
    optimum: Transform | None = None
    optimum_covariance: Covariance | None = None
    evidence: Evidence | None = None
    intrinsics: Mapping[str, IntrinsicEstimate] = field(default_factory=dict)
    origin: InitialSource | None = None
    covariance_with_intrinsics: Covariance | None = None
    shared_covariance: Covariance | None = None
    lens_effect: LensEffect | None = None
    clock_direction: Matrix | None = None
    clock_sigma_s: float | None = None
    clock_offset_s: float | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    stamping: Stamping | None = None
    data_stamp: int = 0
    refined_camera: RefinedCamera | None = None

    @property
    def converged(self) -> bool:
        """True if the estimate is to be used."""
        return self.status == CONVERGED

    def to_dict(self) -> dict[str, Any]:
        """The result format of docs/result.md: plain numbers, lists and strings; NaN becomes null."""
        T, error = self.T_camera_lidar, self.reference_error
        return {
            "T_camera_lidar": T.tolist(),
            "translation_m": T[:3, 3].tolist(),
            "quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3]).tolist(),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "covariance_with_intrinsics": None if (whole := self.covariance_with_intrinsics) is None else whole.tolist(),
            "time_offset_s": self.time_offset_s,
            "time_offset_sigma_s": self.time_offset_sigma_s,
            "stamping": None if self.stamping is None else asdict(self.stamping),
            "score": self.score if math.isfinite(self.score) else None,
            "status": self.status,
            "reason": self.reason,
            "refusal": None if self.refusal is None else self.refusal.value,
            "cause": None if self.cause is None else self.cause.value,
            "refusal_figures": dict(self.refusal_figures),
            "optimum": None if self.optimum is None else self.optimum.tolist(),
            "evidence": None if self.evidence is None else asdict(self.evidence),
            "intrinsics": {name: told.to_dict() for name, told in self.intrinsics.items()},
            **({} if self.refined_camera is None else {"refined_camera": self.refined_camera.to_dict()}),
            "frames_used": self.frames_used,
            "frames": [
                {"name": name, "score": score if math.isfinite(score) else None, "left_out": name in self.frames_left_out}
                for name, score in zip(self.frame_names, self.frame_scores, strict=False)
            ],
            "starts": None if self.starts is None else {"agreed": self.starts[0], "climbed": self.starts[1]},
            "elapsed_s": round(self.elapsed_s, 3),
            "reference_error": None if error is None else {"rotation_deg": error[0], "translation_m": error[1]},
            "stamp": self.stamp,
            "version": VERSION,
        }

    def dumps(self, yaml_format: bool = False) -> str:
        """JSON, or YAML on request."""
        if yaml_format:
            return str(yaml.safe_dump(self.to_dict(), sort_keys=False))
        return super().dumps()

    def save(self, path: str | Path) -> None:
        """Write atomically; YAML if the name ends so, else JSON. BadInputError if the folder cannot be written."""
        write_atomically(path, self.dumps(Path(path).suffix.lower() in (".yaml", ".yml")).encode())


def parse(text: str, what: str) -> Result:
    """A Result from JSON or YAML text. BadInputError names `what` and the first thing that is wrong. Needs T_camera_lidar, or
    translation_m with quaternion_xyzw; everything else is optional."""
    try:
        data = json.loads(text) if text.lstrip().startswith("{") else io.load(text)
    except (ValueError, yaml.YAMLError, RecursionError):
        raise BadInputError(f"{what} is neither valid JSON nor YAML; it should hold a result of calib-ros") from None
    if not isinstance(data, dict):
        raise BadInputError(f"{what} holds no result: expected T_camera_lidar and its companions")
    if "T_camera_lidar" in data:
        T = se3.as_transform(data["T_camera_lidar"], f"T_camera_lidar in {what}")
    elif "translation_m" in data and "quaternion_xyzw" in data:
        try:
            parts = se3.from_parts(
                se3.rotation_from_quaternion(data["quaternion_xyzw"]), np.array(data["translation_m"], float).reshape(3)
            )
        except (TypeError, ValueError, OverflowError):
            raise BadInputError(f"{what}: translation_m must be 3 and quaternion_xyzw 4 numbers") from None
        except BadInputError as error:
            raise BadInputError(f"{what}: {error}") from None
        T = se3.as_transform(parts, f"the transform in {what}")
    else:
        raise BadInputError(f"{what} needs T_camera_lidar (4x4), or translation_m and quaternion_xyzw")
    try:
        known = (data.get(name) for name in ("covariance", "covariance_with_intrinsics"))
        covariance, whole = (None if C is None else np.array(C, float) for C in known)
        score = math.nan if data.get("score") is None else float(data["score"])
        offset, offset_sigma = (
            None if data.get(name) is None else float(data[name]) for name in ("time_offset_s", "time_offset_sigma_s")
        )
        if not math.isfinite((offset or 0.0) + (offset_sigma or 0.0)):
            raise ValueError("time_offset_s")
        frames, elapsed = int(data.get("frames_used") or 0), float(data.get("elapsed_s") or 0)
        listed = data["frames"] if isinstance(data.get("frames"), list) else []
    except (TypeError, ValueError, OverflowError):
        raise BadInputError(f"{what}: covariance, score, frames_used, elapsed_s and time_offset_s must be numbers") from None
    if not 0 <= frames < 2**32:  # what a message can hold
        raise BadInputError(f"{what}: frames_used = {frames} is no number of frames")
    if any(C is not None and (C.shape != (6, 6) or not np.isfinite(C).all()) for C in (covariance, whole)):
        raise BadInputError(f"{what}: covariance must be a finite 6x6 matrix or null")
    return Result(
        T,
        _text(data, "status", what) or INITIAL,
        _text(data, "reason", what),
        score,
        covariance,
        frames,
        _text(data, "camera_frame", what) or "camera",
        _text(data, "lidar_frame", what) or "lidar",
        elapsed,
        stamp=_text(data, "stamp", what),
        covariance_with_intrinsics=whole,
        time_offset_s=offset,
        time_offset_sigma_s=offset_sigma,
        stamping=_stamping(data, what),
        refined_camera=None if data.get("refined_camera") is None else RefinedCamera.from_dict(data["refined_camera"], what),
        frame_names=tuple(str(own["name"]) for own in listed if isinstance(own, dict) and "name" in own),
    )


def _stamping(data: dict[str, Any], what: str) -> Stamping | None:
    value = data.get("stamping")
    if value is None:
        return None
    with suppress(LookupError, TypeError, ValueError):
        stamping = Stamping(str(value["spin"]), float(value["azimuth_deg"]))
        if stamping.spin in ("clockwise", "counterclockwise", "none") and abs(stamping.azimuth_deg) <= 180:
            return stamping
    raise BadInputError(f"{what}: stamping must have a spin (clockwise, counterclockwise or none) and an azimuth_deg, or be null")


def _text(data: dict[str, Any], name: str, what: str) -> str:
    """A text of one line that can be written and sent; "" where there is none."""
    value = data.get(name)
    if isinstance(value, (list, dict)):
        raise BadInputError(f"{what}: {name} must be a text")
    # JSON may hold halves of characters, which neither a terminal nor a message takes.
    return " ".join(str(value or "").encode("utf-8", "replace").decode().split())


def load(path: str | Path) -> Result:
    """Read a result file. BadInputError if it is missing or holds no transform."""
    return parse(io.read_text(path, "result", "a JSON or YAML result of calib-ros"), str(path))


@dataclass(frozen=True, eq=False)
class Extrinsic:
    """The current extrinsic of the online recalibrator, as the node publishes it.

    result: `status` is that of the newest estimate, or the monitor's objection to the current extrinsic: suspect, moved, blinded;
    tentative until further keyframes confirm the first estimate.
    normalised_innovation: shift of the newest accepted estimate against the extrinsic before it, in units of 0.25 deg / 6 cm; see
    `monitor.normalised_innovation`. accepted: estimates accepted so far. monitor_message: the monitor's assessment of the newest
    keyframes, for a person; "" before the first. p_value: probability that keyframes of a right extrinsic look at least this
    wrong; NaN if unknown. usable: an estimate was accepted and nothing objects to it, as far as the data so far tell.
    estimated_at: stamp, ns, of the newest data in the newest accepted estimate; 0 before the first. disputed_since: stamp, ns, of
    the first keyframe that speaks against it; 0 if none does.
    """

    result: Result
    normalised_innovation: float = 0.0
    accepted: int = 0
    monitor_message: str = ""
    p_value: float = math.nan
    usable: bool = False
    estimated_at: int = 0
    disputed_since: int = 0


@dataclass(frozen=True)
class Consumer:
    """deg, m: the largest errors of rotation and translation that it can live with."""

    name: str
    deg: float
    m: float

    def is_served(self, covariance: Covariance | None) -> bool:
        """Whether the tolerances hold along every direction, by a covariance (6, 6) of a left perturbation, rad and m; None =
        unknown: it is not."""
        if covariance is None:
            return False
        turn, shift = (
            CONSUMERS_SIGMAS * math.sqrt(np.linalg.eigvalsh(block)[-1]) for block in (covariance[:3, :3], covariance[3:, 3:])
        )
        return bool(np.rad2deg(turn) <= self.deg and shift <= self.m)


def parse_consumers(texts: Sequence[str]) -> tuple[Consumer, ...]:
    """Texts "NAME DEG M" -> consumers. ConfigError for another form, tolerances that are no positive numbers, or a name twice."""
    found: dict[str, Consumer] = {}
    for text in texts:
        words, deg, m = text.split(), math.nan, math.nan
        with suppress(ValueError):
            deg, m = map(float, words[1:])
        if not (0 < deg < math.inf and 0 < m < math.inf):
            raise ConfigError(f"consumers: {text!r} must be NAME DEG M with tolerances above 0, such as 'planner 0.5 0.10'")
        if words[0] in found:
            raise ConfigError(f"consumers: {words[0]} is named twice; name each consumer once, such as 'planner 0.5 0.10'")
        found[words[0]] = Consumer(words[0], deg, m)
    return tuple(found.values())
