"""The fast score against a slow one that samples point by point, and its slopes against differences."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import ConstraintsConfig, ScoreConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.image.edges import EdgeLevel
from calib_ros.lidar.edges import UPWARD, EdgePoints
from calib_ros.registration.covariance import (
    FEW_POINTS,
    USUAL_NOISE,
    covariance,
    effective_points,
    inverse_curvature,
    noise_level,
    scenes_of,
)
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.objective import (
    RING_SPACING_DEG,
    SYSTEMATIC_ERROR,
    WEIGHT_FLOOR,
    WEIGHT_SIDE,
    WEIGHT_SKY_SIDE,
    WEIGHT_SKY_TOP,
    WEIGHT_TOP,
    FastScore,
)
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import MARGIN
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import Limits, PoseConstraints, pose_constraints

WIDTH, HEIGHT, F = 322, 121, 200.0
CAMERA = Camera(np.array([[F, 0, 160.2], [0, F * 1.3, 59.1], [0, 0, 1]]), WIDTH, HEIGHT)
CONFIG = ScoreConfig()
SCALES = (8, 4, 2, 1, 1)
SIGMAS = (16.0, 8.0, 4.0, 2.0, 1.2)


def points(seed: int, n: int = 900, spacing_deg: float = 0.4) -> EdgePoints:
    """In front of the LiDAR, most of them in the picture, some beside it, too near or behind."""
    rng = np.random.default_rng(seed)
    xyz = np.c_[rng.uniform(1.5, 40, n), np.zeros((n, 2))]
    xyz[:, 1] = xyz[:, 0] * rng.uniform(-0.95, 0.95, n)
    xyz[:, 2] = xyz[:, 0] * rng.uniform(-0.4, 0.4, n)
    xyz[: n // 30, 0] *= -1
    xyz[n // 30 : n // 15] *= 0.05
    kind = rng.choice(5, n, p=[0.4, 0.3, 0.2, 0.08, 0.02]).astype(np.uint8)
    return EdgePoints(xyz.astype(np.float32), rng.uniform(0.2, 2, n).astype(np.float32), kind, float(np.deg2rad(spacing_deg)))


def levels(seed: int, smoothness: float = 1.0) -> list[EdgeLevel]:
    rng = np.random.default_rng(1000 + seed)
    out = []
    for scale, sigma in zip(SCALES, SIGMAS, strict=True):
        shape = (2, HEIGHT // scale, WIDTH // scale)
        maps = [cv2.GaussianBlur(rng.standard_normal(shape[1:]), (0, 0), smoothness * sigma / scale) for _ in range(2)]
        out.append(EdgeLevel.of(np.stack([(m - m.mean()) / m.std() for m in maps]).astype(np.float32), scale, sigma))
    return out


def frame(seed: int, smoothness: float = 1.0, **options) -> FrameFeatures:
    return FrameFeatures(points(seed, **options), levels(seed, smoothness), CAMERA, seed, str(seed), True)


FRAMES = [frame(k) for k in range(3)]
NO_POINTS = EdgePoints(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8))
EMPTY = FrameFeatures(NO_POINTS, FRAMES[1].levels, CAMERA, 0, "", True)
POSES = [
    se3.exp(np.array(xi)) @ nominal() for xi in ([0] * 6, [0.02, -0.03, 0.01, 0.1, -0.05, 0.2], [0, 0.2, -0.1, 0.3, 0.4, 0.5])
]


def slow(
    features: list[FrameFeatures], T: np.ndarray, level: int, config: ScoreConfig = CONFIG, share: float = MARGIN
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge strength, weight and frame of every point that the prior keeps, in double precision."""
    weights_of = np.array([WEIGHT_SIDE, WEIGHT_TOP, config.weight_reflectivity, WEIGHT_SKY_SIDE, WEIGHT_SKY_TOP])
    sampled, weight, number = [], [], []
    for j, f in enumerate(features):
        uv, z = pixels(f.points.xyz, nominal())
        border = share * WIDTH
        near = (z > MIN_DEPTH) & (uv > -border).all(axis=1) & (uv < np.array([WIDTH, HEIGHT]) + border).all(axis=1)
        kinds, strengths = f.points.kind[near], f.points.strength[near].astype(float)
        upward, blunt = np.isin(kinds, UPWARD), np.sqrt(min(1, RING_SPACING_DEG / np.rad2deg(f.points.ring_spacing)))
        of_kind = np.array([max(own.sum(), WEIGHT_FLOOR * own.mean()) for own in (strengths[kinds == k] for k in range(5))])
        weight.append(weights_of[kinds] * np.where(upward, blunt, 1) * strengths / of_kind[kinds])
        number.append(np.full(len(kinds), j))
        uv, z = pixels(f.points.xyz[near], T)
        u, v = ((uv + 0.5) / f.levels[level].scale - 0.5).T
        side, up = (bilinear(f.levels[level].maps[k], u, v) for k in (0, 1))
        sampled.append(np.where(z >= MIN_DEPTH, np.where(upward, up, side), 0))
    weights = np.concatenate(weight)
    return np.concatenate(sampled), weights / weights.sum(), np.concatenate(number)


def pixels(xyz: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    P = se3.transform(T, xyz.astype(float))
    return P[:, :2] / P[:, 2:] * np.diag(CAMERA.K)[:2] + CAMERA.K[:2, 2], P[:, 2]


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Outside the picture all is 0."""
    framed, rows, columns = np.pad(image, 1), np.floor(v), np.floor(u)
    (height, width), out = image.shape, np.zeros(len(u))
    for a, b in itertools.product((0, 1), repeat=2):
        row, column = np.clip(rows + 1 + a, 0, height + 1), np.clip(columns + 1 + b, 0, width + 1)
        out += framed[row.astype(int), column.astype(int)] * (1 - abs(v - rows - a)) * (1 - abs(u - columns - b))
    return out


@pytest.mark.parametrize(("config", "margin"), [(CONFIG, MARGIN), (replace(CONFIG, weight_reflectivity=0.3), 0.2)])
def test_the_fast_score_is_the_slow_one(config, margin):
    """Weights of kinds, of those with few points and of rings far apart; points near the picture; strengths under them."""
    features = [FRAMES[0], frame(1, spacing_deg=1.6), FRAMES[2]]
    for level in range(len(SCALES)) if config is CONFIG else (1,):
        T = POSES[level % 3]
        score = FastScore(features, nominal(), config, margin)
        sampled, weight, number = slow(features, T, level, config, margin)
        assert 1500 < len(sampled) < 2650  # some of the 2700 points are left out, most are not
        assert np.array_equal(score.frame, number)
        assert np.allclose(score.weights, weight, rtol=1e-4)
        # cv2.remap knows pixels to 1/32.
        assert np.abs(score.samples(T, level) - sampled).max() < 0.15
        assert score.at(level).value(T) == pytest.approx(weight @ sampled, abs=1e-3)
        per_frame = [np.average(sampled[number == j], weights=weight[number == j]) for j in range(3)]
        assert score.frame_scores(T, level) == pytest.approx(per_frame, abs=2e-3)
        assert score.values(np.stack(POSES), level)[level % 3] == pytest.approx(weight @ sampled, abs=3e-3)
        assert score.frame_values(T[None], level)[0] == pytest.approx(per_frame, abs=5e-3)


def test_many_frames_need_several_columns_and_score_the_same(monkeypatch):
    features = [frame(k, n=300) for k in range(7)]
    one = FastScore(features, nominal(), CONFIG)
    # 10 of the 14 tiles of the finest level in a column.
    monkeypatch.setattr("calib_ros.registration.score.atlas.MAX_SIDE", 1300)
    several = FastScore(features, nominal(), CONFIG)
    assert several.atlas.levels[-1].image.shape[1] > 1.9 * one.atlas.levels[-1].image.shape[1]
    for T, level in itertools.product(POSES, range(len(SCALES))):
        assert several.at(level).value(T) == pytest.approx(one.at(level).value(T), abs=5e-4)
        assert several.frame_scores(T, level) == pytest.approx(one.frame_scores(T, level), abs=4e-3)
    monkeypatch.setattr("calib_ros.registration.score.atlas.MAX_SIDE", 600)
    with pytest.raises(TooFewFeaturesError, match="7 frames of 322x121 do not fit one score"):
        FastScore(features, nominal(), CONFIG)


def test_a_subset_is_the_score_of_its_points():
    score = FastScore(FRAMES, nominal(), CONFIG)
    T = POSES[1]
    part = score.subset(500, np.random.default_rng(4))
    assert part.points.shape == (3, 500)
    assert part.weights.sum() == pytest.approx(1, abs=1e-5)
    chosen = [int(np.nonzero((score.points == p[:, None]).all(axis=0))[0][0]) for p in part.points.T]
    assert len(set(chosen)) == 500
    for level in range(len(SCALES)):
        expected = np.average(score.samples(T, level)[chosen], weights=score.weights[chosen])
        assert part.at(level).value(T) == pytest.approx(expected, abs=1e-4)
    assert part.at(-1).value(T) == score.subset(500, np.random.default_rng(4)).at(-1).value(T)
    assert score.subset(10**6, np.random.default_rng(0)) is score


def test_too_few_points_are_refused_with_their_number(monkeypatch):
    with pytest.raises(TooFewFeaturesError, match="no frame"):
        FastScore([], nominal(), CONFIG)
    few = [frame(0, n=100), frame(1, n=90)]
    with pytest.raises(TooFewFeaturesError, match=r"1\d\d edge points near the image in 2 frames, 200 are needed"):
        FastScore(few, nominal(), CONFIG)
    with pytest.raises(TooFewFeaturesError, match="no edge points"):
        FastScore([frame(0)], se3.from_parts(np.diag([-1.0, 1, -1]) @ nominal()[:3, :3], [0, 0, -500]), CONFIG)
    monkeypatch.setattr("calib_ros.registration.objective.MIN_POINTS", 100)
    FastScore(few, nominal(), CONFIG)


# --- uncertainty ----------------------------------------------------------------------------------------------------------


def peaked(offset_px: float, seed: int) -> FrameFeatures:
    """Points scattered around 40 bumps of the maps, which are moved right by `offset_px`."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([20, 15], [WIDTH - 20, HEIGHT - 15], (40, 2))
    uv = np.repeat(centre, 10, axis=0) + rng.normal(0, 3, (400, 2))
    depth = np.repeat(rng.uniform(4, 25, 40), 10)[:, None]
    xyz = se3.transform(se3.inverse(nominal()), np.c_[(uv - CAMERA.K[:2, 2]) / np.diag(CAMERA.K)[:2], np.ones(400)] * depth)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    bumps = sum(np.exp(-((x - u - offset_px) ** 2 + (y - v) ** 2) / (2 * 4.0**2)) for u, v in centre)
    level = EdgeLevel.of(np.stack([bumps, bumps]).astype(np.float32), 1, 4.0)
    p = EdgePoints(xyz.astype(np.float32), np.ones(400, np.float32), (np.arange(400) % 2).astype(np.uint8))
    return FrameFeatures(p, [level] * len(SCALES), CAMERA, 0, "", True)


def noise_of(score: FastScore, **arguments) -> np.ndarray:
    """The covariance without the systematic error."""
    return covariance(score, nominal(), **arguments) - np.diag(SYSTEMATIC_ERROR**2)


def test_other_optima_nearby_count_as_far_as_they_are_as_good():
    score = FastScore([peaked(0, k) for k in range(4)], nominal(), CONFIG)
    aside = se3.exp(np.array([0, 0.02, 0, 0, 0, 0])) @ nominal()  # 4 px, where the score is far lower
    alone = covariance(score, nominal())
    assert np.allclose(covariance(score, nominal(), others=[aside, nominal()]), alone, rtol=0.05, atol=1e-8)
    noise = noise_level(score, nominal(), inverse_curvature(score, nominal(), np.arange(6)), np.arange(6))
    less = score.at(-1).value(nominal()) - score.at(-1).value(aside)
    alike = 20 * less / noise  # of so much noise that the two are nearly as probable
    spread = covariance(score, nominal(), others=[aside], inflation=alike) - covariance(score, nominal(), inflation=alike)
    assert spread[1, 1] == pytest.approx(0.02**2 / 2, rel=0.1)
    assert np.allclose(noise_of(score, inflation=4.0), 4 * noise_of(score), rtol=1e-6)  # a factor of the variance


def test_agreeing_frames_have_less_variance_but_at_least_the_systematic_error(monkeypatch):
    monkeypatch.setattr("calib_ros.registration.covariance.FEW_POINTS", 0.0)  # what the frames themselves tell
    score = FastScore([peaked(0, k) for k in range(4)], nominal(), CONFIG)
    agreeing = covariance(score, nominal())
    assert np.array_equal(agreeing, agreeing.T)
    assert np.linalg.eigvalsh(agreeing).min() > 0
    assert (np.diag(agreeing) >= SYSTEMATIC_ERROR**2 * 0.999).all()
    apart = covariance(FastScore([peaked(d, k) for k, d in enumerate((-2, 2, -2, 2))], nominal(), CONFIG), nominal())
    # Two pixels to the right are a turn about the camera's vertical axis.
    assert np.sqrt(apart[1, 1]) > 1.5 * np.sqrt(agreeing[1, 1])  # the noise is pooled over all directions
    assert np.sqrt(apart[1, 1]) > 0.4 * 2 / F / np.sqrt(4)


def test_frames_of_few_points_are_less_certain():
    """Once as the mean of fewer points, and once more where all frames together have few."""
    score = FastScore([peaked(0, k) for k in range(4)], nominal(), CONFIG)
    axes = np.arange(6)
    some = score.subset(120, np.random.default_rng(0))
    bread = inverse_curvature(score, nominal(), axes)
    enough, few = (noise_level(s, nominal(), bread, axes) for s in (score, some))
    assert effective_points(some) < 130
    least = USUAL_NOISE / scenes_of(some) * FEW_POINTS * 4 / effective_points(some)
    assert few >= 0.99 * least * FEW_POINTS / effective_points(some)
    assert few > 5 * enough


def test_doubled_frames_are_no_more_certain_and_others_are():
    """Frames of one place repeat their errors."""
    two, others = [peaked(d, k) for k, d in enumerate((-2, 2))], [peaked(d, k + 2) for k, d in enumerate((-2, 2))]
    single, doubled, four = (FastScore(f, nominal(), CONFIG) for f in (two, two * 2, two + others))
    assert scenes_of(doubled) == pytest.approx(scenes_of(single), rel=1e-4)
    assert scenes_of(FastScore([two[0]] * 3, nominal(), CONFIG)) == pytest.approx(1)
    assert 1.5 < scenes_of(single) <= 2
    assert 2 < scenes_of(four) <= 4
    assert np.diag(noise_of(doubled)) == pytest.approx(np.diag(noise_of(single)), rel=0.25)
    assert np.trace(noise_of(four)[:3, :3]) < 0.75 * np.trace(noise_of(single)[:3, :3])


def test_frame_without_edges_adds_no_information():
    empty = replace(peaked(0, 1), points=EMPTY.points)
    one, two = FastScore([peaked(0, 0)], nominal(), CONFIG), FastScore([peaked(0, 0), empty], nominal(), CONFIG)
    assert np.allclose(covariance(one, nominal()), covariance(two, nominal()), rtol=1e-5)
    three = FastScore([peaked(d, k) for k, d in enumerate((-2, 2, 1))], nominal(), CONFIG)
    left = FastScore([peaked(d, k) for k, d in enumerate((-2, 2))], nominal(), CONFIG)
    assert np.allclose(covariance(three.select(three.frame < 2), nominal()), covariance(left, nominal()), rtol=1e-3)


def test_what_is_fixed_has_no_variance_and_a_prior_adds_its_information():
    score = FastScore([peaked(d, k) for k, d in enumerate((-2, 2, -2, 2))], nominal(), CONFIG)
    free = covariance(score, nominal())
    limits = Limits(nominal(), np.array([np.inf, np.inf, 1, 0, np.inf, 0]))
    fixed = covariance(score, nominal(), constraints=PoseConstraints(limits))
    assert not fixed[[3, 5]].any()
    assert not fixed[:, [3, 5]].any()
    rest = np.ix_([0, 1, 2, 4], [0, 1, 2, 4])
    assert np.linalg.eigvalsh(fixed[rest]).min() > 0
    assert (np.diag(fixed) <= np.diag(free) * 1.01).all()
    sigma_m = 0.05
    config = ConstraintsConfig(sigma_m=(0.0, sigma_m, 0.0))
    held = covariance(score, nominal(), constraints=pose_constraints(nominal(), config, 4))
    expected = np.linalg.inv(np.linalg.inv(free) + np.diag([0, 0, 0, 0, 1 / sigma_m**2, 0]))
    assert np.allclose(held, expected, rtol=1e-6, atol=1e-12)
    assert held[4, 4] < sigma_m**2
    assert not covariance(score, nominal(), constraints=PoseConstraints(Limits(nominal(), np.zeros(6)))).any()


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 3, 1], [2, 0, 2]])
def test_an_atlas_that_takes_over_another_one_scores_as_a_new_one(order):
    """Also if a frame is given twice, before or after."""
    frames = [*FRAMES, frame(3)]
    for before in ([0, 1, 2], [0, 0, 3]):
        last = Atlas([frames[k].levels for k in before], CAMERA)
        images = [level.image for level in last.levels]
        wanted = [frames[k] for k in order]
        taken = Atlas([f.levels for f in wanted], CAMERA, last)
        assert all(level.image is image for level, image in zip(taken.levels, images, strict=True))
        for level in range(len(SIGMAS)):
            own = FastScore(wanted, POSES[0], CONFIG, atlas=taken).at(level).value(POSES[1])
            assert own == FastScore(wanted, POSES[0], CONFIG).at(level).value(POSES[1])


def test_an_atlas_of_another_form_is_not_taken_over():
    last = Atlas([f.levels for f in FRAMES], CAMERA)
    fewer = Atlas([f.levels for f in FRAMES[:2]], CAMERA, last)
    assert fewer.levels[0].image is not last.levels[0].image
    other = replace(CAMERA, K=CAMERA.K * np.array([[1.1], [1], [1]]))
    assert Atlas([f.levels for f in FRAMES], other, last).levels[0].image is not last.levels[0].image


def test_a_camera_mounted_on_its_side_scores_as_an_upright_one():
    """Side edges of the scan are horizontal in its picture."""
    on_its_side = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    upright = FRAMES[0]
    K = np.array([[CAMERA.K[1, 1], 0, CAMERA.K[1, 2]], [0, CAMERA.K[0, 0], WIDTH - 1 - CAMERA.K[0, 2]], [0, 0, 1]])
    turned = replace(
        upright,
        camera=Camera(K, HEIGHT, WIDTH),
        levels=[replace(own, packed=np.stack([np.rot90(own.packed[k]) for k in (1, 0)])) for own in upright.levels],
    )
    for T in POSES:
        scores = [FastScore([upright], T, CONFIG, 2.0), FastScore([turned], on_its_side @ T, CONFIG, 2.0)]
        for level in (k for k, scale in enumerate(SCALES) if scale == 1):
            values = [s.at(level).value(pose) for s, pose in zip(scores, (T, on_its_side @ T), strict=True)]
            assert abs(values[0]) > 0.001
            assert values[1] == pytest.approx(values[0], abs=2e-4)
