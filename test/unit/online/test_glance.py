"""A look tells a knock from what is usual, and nothing that it cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import Scene

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online import glance as module
from calib_ros.online.glance import EVERY_S, LEAST_KEPT, Glance, match_loss

CONFIG = Config()
KNOCKS = {"1.5 deg": ([0.9, 0.9, 0.8], [0, 0, 0]), "15 cm": ([0, 0, 0], [0.1, -0.1, 0.05])}


def at(frame: Frame, look: int) -> Frame:
    """The frame at the time of a look."""
    stamp = round(look * EVERY_S * NANOSECONDS)
    return replace(frame, stamp=stamp, cloud_stamp=stamp)


def looked(scene: Scene, looks: int) -> Glance:
    """That has seen the scene's frames at their extrinsic."""
    glance = Glance()
    for k in range(looks):
        assert not glance.strikes(at(scene.frames[k % len(scene.frames)], k), scene.truth, CONFIG) or k >= LEAST_KEPT
    return glance


@pytest.mark.parametrize("knock", KNOCKS.values(), ids=KNOCKS)
def test_a_knock_strikes_at_once(scene, knock):
    for frame in scene.frames:
        assert looked(scene, 12).strikes(at(frame, 12), scene.off(knock), CONFIG)


def test_nothing_strikes_before_it_is_known_what_is_usual(scene):
    glance = looked(scene, LEAST_KEPT - 1)
    assert not glance.strikes(at(scene.frames[0], 99), scene.off(KNOCKS["1.5 deg"]), CONFIG)
    glance = looked(scene, LEAST_KEPT)
    glance.reset()
    assert not glance.strikes(at(scene.frames[0], 99), scene.off(KNOCKS["1.5 deg"]), CONFIG)


def test_what_strikes_is_usual_afterwards(scene):
    glance, off = looked(scene, LEAST_KEPT), scene.off(KNOCKS["1.5 deg"])
    assert [glance.strikes(at(scene.frames[0], 20 + k), off, CONFIG) for k in range(3)] == [True, False, False]


def test_looks_are_no_more_often_than_needed():
    glance = Glance()
    glance.put_off(0)
    spacing = round(module.REST_EVERY_S * NANOSECONDS)
    assert [glance.is_due(t, at_rest=True) for t in (spacing - 1, spacing)] == [False, True]
    glance.reset()
    assert glance.is_due(0)
    glance.put_off(5 * NANOSECONDS)
    spacing = round(EVERY_S * NANOSECONDS)
    assert [glance.is_due(5 * NANOSECONDS + t) for t in (0, spacing - 1, spacing, -1)] == [False, False, True, True]


def test_what_cannot_be_looked_at_says_nothing(scene):
    frame = scene.frames[0]
    empty = replace(frame, cloud=frame.cloud.select(np.arange(0)))
    behind = se3.exp([0, np.pi, 0, 0, 0, 0]) @ scene.truth
    black = replace(frame, image=np.zeros_like(frame.image))
    nan = replace(frame, cloud=replace(frame.cloud, xyz=np.full_like(frame.cloud.xyz, np.nan)))
    assert [match_loss(f, scene.truth, CONFIG) for f in (empty, black, nan)] == [None] * 3
    assert match_loss(frame, behind, CONFIG) != 0.0  # whatever is there: no exception
