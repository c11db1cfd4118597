"""The coach: what an extrinsic lacks, what to drive past to learn it, and how long that takes.

An edge Z ahead, at the tangents x and y from the optical axis, moves by a left twist (rx, ry, rz, tx, ty, tz) by

    ry (1 + x^2) - rx x y - rz y + (tx - x tz) / Z   to the right, and
    ry x y - rx (1 + y^2) + rz x + (ty - y tz) / Z   down,

of which only what is across the edge shows. So rotations show at any distance and shifts nearby; a vertical edge shows yaw and a
shift sideways, a horizontal one pitch and height, one away from the centre roll and a shift forward as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.config.online import MANUAL
from calib_ros.online.sensor_health import SensorFault
from calib_ros.online.tracker import NOTHING, Confirmations
from calib_ros.registration.covariance import open_directions
from calib_ros.registration.estimate import largest_sigmas
from calib_ros.result import BLINDED, CONVERGED, MOVED, REFUSED, SUSPECT, TENTATIVE, RefusalCode, Result

AXES = ("pitch", "yaw", "roll", "sideways", "height", "forward")  # of a twist, as seen by the camera
TURN_LIKE = {"height": "pitch", "sideways": "yaw"}  # the rotation that moves all edges at one distance as the shift does
MANY = 3  # axes; where more are weak, any structure helps
# Times as far as near edges: they then tell a shift from its rotation within 1.5 times as well as edges infinitely far would.
FAR = 3.0
EDGE_PX = 1.0  # edges of scan and image are placed within a pixel of the image that is worked on
STRUCTURE = "poles, buildings or parked cars"
LYING = "horizontal edges", "parked cars, low walls, kerbs"
STANDING = "vertical edges", "poles, trunks, corners of buildings"
NO_SCENES = (RefusalCode.LOW_SCORE, RefusalCode.TOO_FAR_FROM_START)  # for which other scenes are no cure
IF_RAW = "set image_is_rectified: false if straight lines are bent in the images"


@dataclass(frozen=True)
class Advice:
    """weak: axes that are not known well enough, weakest first. text: what to do, for a person; "" = nothing. progress: share of
    what is needed that is there, 0..1. remaining_s: at the present pace of keyframes, of the data's time; None = unknown."""

    weak: tuple[str, ...] = ()
    text: str = ""
    progress: float = 0.0
    remaining_s: float | None = None

    def __str__(self) -> str:
        """In a line."""
        time = "" if self.remaining_s is None else f", about {self.remaining_s:.0f} s to go"
        return f"{self.text} ({self.progress:.0%} of what is needed{time})" if self.text else ""


@dataclass(frozen=True)
class Counted:
    """What there is beside the covariance. keyframes: in the buffer. per_s: new ones, of the data's time; 0 = unknown. fused: how
    many the covariance rests on. missing: confirmations, of_all that the extrinsic needs. fault: of a sensor."""

    keyframes: int = 0
    per_s: float = 0.0
    fused: float = 0.0
    missing: Confirmations = NOTHING
    of_all: Confirmations = NOTHING
    fault: SensorFault | None = None


@dataclass(frozen=True)
class Need:
    """weak: axes that are not known well enough, weakest first. variance: of the weakest direction, in units of what is wanted.
    rad, m: wanted standard deviations of rotations and shifts. turns: (3,) rad, of pitch, yaw and roll, at most the wanted."""

    weak: tuple[str, ...]
    variance: float
    rad: float
    m: float
    turns: Matrix


def need(result: Result, config: Config) -> Need | None:
    """What is not known well enough of an estimate: of one that is too uncertain its optimum, by the stage ``refine``; else the
    extrinsic, by ``tracker``. None where no covariance tells."""
    deg, m, covariance = config.tracker.max_sigma_deg, config.tracker.max_sigma_m, result.covariance
    if result.refusal is RefusalCode.TOO_UNCERTAIN:
        deg, m = largest_sigmas(config.refine.tolerance_deg, config.refine.tolerance_m)
        covariance = result.optimum_covariance
    elif covariance is not None and result.shared_covariance is not None:
        covariance = covariance - result.shared_covariance  # no scenes lower what the clocks leave open
    if covariance is None:
        return None
    # Units of what is wanted, so that rotations and shifts compare.
    unit, names = np.repeat([math.radians(deg), m], 3), []
    for direction in open_directions(covariance, deg, m):
        shares = {axis: sigma / unit[axis] for axis, sigma in zip(direction.axes, direction.sigma, strict=True)}
        names += [AXES[axis] for axis in sorted(shares, key=lambda axis: -shares[axis])]
    variance = float(np.linalg.eigvalsh(covariance / np.outer(unit, unit))[-1])
    turns = np.sqrt(np.clip(np.diag(covariance)[:3], 0, unit[:3] ** 2))
    return Need(tuple(dict.fromkeys(names)), variance, math.radians(deg), m, turns)


@dataclass(frozen=True)
class Sight:
    """Edges to have in view. edges: their name, and where they are found. nearer, farther: m from the camera. at_sides: of the
    image, nearer to its border than to its centre."""

    edges: str
    examples: str = ""
    nearer: float = math.inf
    farther: float = 0.0
    at_sides: bool = False

    def __str__(self) -> str:
        """For a person."""
        where = f"nearer than {self.nearer:.0f} m" if self.nearer < math.inf else "at any distance"
        where = f"farther than {self.farther:.0f} m" if self.farther else where
        sides, found = " towards the sides of the image" * self.at_sides, f" ({self.examples})" * bool(self.examples)
        return f"{self.edges} {where}{sides}{found}"


def sights(lacking: Need, camera: Camera, T: Transform) -> tuple[Sight, ...]:
    """What shows the weak axes of an extrinsic T_camera_lidar (4, 4). camera: whose image is worked on."""
    placed, border = EDGE_PX / float(camera.focal[0]), math.sin(math.radians(min(camera.field_deg / 2, 90.0)))

    def near(turn: float) -> float:
        # Where the wanted shift moves an edge by as much as it is placed to beside a rotation that is known to `turn`, or by the
        # wanted rotation: what shows that of far edges shows the shift of these.
        return lacking.m / min(math.hypot(placed, turn), lacking.rad)

    turns = dict(zip(AXES[:3], lacking.turns, strict=True))
    if len(lacking.weak) > MANY:
        nearer = near(max(turns["pitch"], turns["yaw"]))
        return Sight(STRUCTURE, nearer=nearer), Sight("others", farther=FAR * nearer)
    # The scanner's z axis is taken to be upright: a camera on its side sees poles lie.
    lying, standing = (LYING, STANDING) if abs(T[1, 2]) >= abs(T[0, 2]) else (STANDING, LYING)
    found = []
    for axis in lacking.weak:
        edges = lying if axis in ("pitch", "height") else standing
        if axis in TURN_LIKE:
            found.append(Sight(*edges, nearer=near(turns[TURN_LIKE[axis]])))
        elif axis == "forward":  # no rotation looks like it; at the border it moves edges by so much less
            found.append(Sight("edges", "parked cars, walls, poles", nearer=border * near(0.0), at_sides=True))
        elif axis == "roll":
            found += [] if "forward" in lacking.weak else [Sight("edges", at_sides=True)]
        elif any(TURN_LIKE.get(other) == axis for other in lacking.weak):
            found.append(Sight(edges[0], farther=FAR * near(turns[axis])))
        else:
            found.append(Sight(*edges))
    return tuple(found)


def words(lacking: Need, camera: Camera, T: Transform, do: str) -> str:
    """What is weak and what to do, as `do` "drive past", in a line; "" where nothing is weak."""
    if not lacking.weak:
        return ""
    return f"not known well enough: {', '.join(lacking.weak)}; {do} {', and '.join(map(str, sights(lacking, camera, T)))}"


def advise(result: Result, config: Config, camera: Camera, counted: Counted) -> Advice:
    """What the current extrinsic lacks. result: as published. camera: whose image is worked on."""
    if result.status == CONVERGED:
        return Advice(progress=1.0, remaining_s=0.0)
    lacking, needed, missing = need(result, config), config.online.min_keyframes, counted.missing
    if result.status == MOVED and result.refusal is not RefusalCode.TOO_UNCERTAIN:
        lacking = None  # what is known is of another extrinsic
    if lacking is None:
        shares, keyframes = [min(counted.keyframes / needed, 1.0), 0.0], float(max(needed - counted.keyframes, 0))
    else:
        # The information grows as the number of keyframes does, and the variance falls.
        rests_on = result.frames_used if result.refusal is RefusalCode.TOO_UNCERTAIN else counted.fused
        variance = max(lacking.variance, 1.0)
        shares, keyframes = [1.0, 1 / variance], math.ceil((variance - 1) * rests_on)
    if result.status in (BLINDED, SUSPECT):
        shares.append(0.0)
    elif any(counted.of_all):
        shares.append(1 - sum(missing) / sum(counted.of_all))
    text, drive = _text(result, config, counted, lacking, camera)
    known = drive and counted.per_s > 0
    remaining = (keyframes + max(missing.keyframes, missing.estimates)) / counted.per_s if known else None
    return Advice(() if lacking is None else lacking.weak, text, float(np.mean(shares)), remaining)


def _text(result: Result, config: Config, counted: Counted, lacking: Need | None, camera: Camera) -> tuple[str, bool]:
    """What to do, and whether that is to drive on, so that keyframes tell how long it takes."""
    status, missing, needed = result.status, counted.missing, config.online.min_keyframes
    weak = "" if lacking is None else words(lacking, camera, result.T_camera_lidar, "drive past")
    if status == BLINDED:
        return counted.fault.advice if counted.fault else "", False
    if status == SUSPECT:
        return "keep driving: the newest keyframes decide whether the extrinsic still holds", False
    if counted.keyframes < needed and lacking is None:
        if not counted.keyframes:
            return f"no keyframe yet: drive where there are {STRUCTURE}, in light", True
        return f"keep driving: {counted.keyframes} of {needed} keyframes, each of another view", True
    if result.cause is not None:
        raw = result.refusal is RefusalCode.WRONG_INTRINSICS and camera.said_rectified
        return f"{IF_RAW}, else {result.cause.advice}" if raw else result.cause.advice, False
    if result.refusal is not None and result.refusal in NO_SCENES:
        return result.refusal.advice, False
    if config.online.mode == MANUAL and status != TENTATIVE:
        return f"{weak}; then call ~/calibrate" if weak else "call ~/calibrate", False
    if weak:
        return weak, True
    if result.refusal is not None:
        return f"drive where there are {STRUCTURE}, near and far", False
    if status == MOVED:
        return f"keep driving: {missing.estimates} further estimates have to agree", True
    if missing.keyframes:
        of_all = counted.of_all.keyframes
        return f"keep driving: {of_all - missing.keyframes} of {of_all} further keyframes", True
    if missing.estimates:
        return "keep driving: another estimate has to agree", True
    if missing.clocks:
        return "drive at another speed or through a turn, which shows whether the clocks agree", False
    return "keep driving: more keyframes decide" if status == REFUSED else "keep driving: an estimate is due", False
