"""Rendered training pictures: the same from the same number, with labels that are what stands there. No PyTorch is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from paths import ROOT

sys.path.insert(0, str(ROOT))  # training/ is no part of the installed package

from calib_ros_synthetic.rays import NEAREST, intersect
from training import data
from training import render as command
from training.world import stage
from training.world.paint import open_at
from training.world.picture import picture_of, render, world_of

SCALE = 0.15  # of the pictures here: 40 to 120 px a side


def files_of(folder: Path) -> dict[str, bytes]:
    """Everything in a folder by its path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_picture_depends_on_seed_and_number_only():
    image, labels = picture_of(3, 5, SCALE)
    again, labels_again = picture_of(3, 5, SCALE)
    assert (image == again).all()
    assert (labels == labels_again).all()
    for other in (picture_of(3, 6, SCALE), picture_of(4, 5, SCALE)):
        assert other[0].shape != image.shape or (other[0] != image).any()


@pytest.mark.parametrize("number", [1, 2, 12])
def test_labels_are_what_a_ray_meets_first(number: int):
    """Every solid is tried on some rays, one by one, without the windows and the order of the renderer."""
    world = world_of(2, number, SCALE)
    camera, solids = world.camera, world.solids
    _, labels = render(world)
    rays = camera.view.rays(camera.R)
    spots = np.random.default_rng(0).choice(np.flatnonzero(camera.view.seen), 40, replace=False)
    for row, column in zip(*np.divmod(spots, labels.shape[1]), strict=True):
        one = rays.window(slice(row, row + 1), slice(column, column + 1))
        nearest, label = np.inf, None
        for i in range(len(solids)):
            t = float(intersect(solids, i, one)[0, 0])
            if t < nearest and not is_hole(world, i, one, t):
                nearest, label = t, int(solids.label[i])
        down = -float(one.direction[2][0, 0])
        x, y = (np.array([float(d[0, 0])], np.float32) for d in one.direction[:2])
        if down > 1e-3 and NEAREST < camera.height / down < 1.05 * nearest:
            t = camera.height / down
            near_kerb = len({bool(world.layout.is_road(x * k * t, y * k * t)[0]) for k in np.linspace(0.8, 1.02, 12)}) > 1
            if near_kerb or t > 0.9 * nearest:
                continue  # which of them is met first depends on the kerb
            label = stage.ROAD if world.layout.is_road(x * t, y * t)[0] else stage.PAVEMENT
        if label is None:  # the sky, or the woods and houses on the horizon
            assert labels[row, column] in (stage.SKY, stage.TREE, stage.BUILDING)
        else:
            assert labels[row, column] == label


def is_hole(world, i, ray, t) -> bool:
    """Whether a ray that meets solid i at t goes on through one of its holes."""
    solids, cover = world.solids, int(world.solids.surface[i])
    if cover not in stage.POROUS or not np.isfinite(t):
        return False
    point = np.array([float(p[0, 0]) for p in ray.at(np.array([[t]], np.float32))]) - solids.centre[i]
    c, s = np.cos(solids.yaw[i]), np.sin(solids.yaw[i])
    local = np.array([c * point[0] + s * point[1], c * point[1] - s * point[0], point[2]]) / solids.half[i]
    return bool(
        open_at(cover, round(float(solids.style[i, 2])), local[:, None].astype(np.float32), solids.half[i].astype(np.float32))[0]
    )


def test_all_classes_are_in_a_few_pictures():
    seen = np.zeros(data.VOID + 1, int)
    for number in range(14):
        image, labels = picture_of(1, number, SCALE)
        assert image.shape == (*labels.shape, 3)
        assert image.dtype == labels.dtype == np.uint8
        seen += np.bincount(labels.ravel(), minlength=data.VOID + 1)
    assert (seen[: data.VOID] > 0).all(), dict(zip(data.NAMES, seen, strict=False))


def test_a_killed_run_goes_on_and_ends_with_the_same_files(tmp_path: Path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    command.render(whole, 7, range(4), 1, SCALE)
    command.render(killed, 7, range(2), 1, SCALE)
    kept = killed / "images" / "000000.jpg"
    stamp = kept.stat().st_mtime_ns
    (killed / "labels" / "000001.png").unlink()
    (killed / "images" / "000002.new.jpg").write_bytes(b"half")  # what a killed process leaves
    command.render(killed, 7, range(4), 2, SCALE)
    assert files_of(killed) == files_of(whole)
    assert kept.stat().st_mtime_ns == stamp


def test_pictures_of_two_seeds_are_not_mixed(tmp_path: Path):
    command.render(tmp_path, 7, range(1), 1, SCALE)
    with pytest.raises(ValueError, match="seed 7 scale"):
        command.render(tmp_path, 8, range(1), 1, SCALE)


def test_every_fortieth_rendered_picture_is_held_out(tmp_path: Path):
    for kind, suffix in (("images", ".jpg"), ("labels", ".png")):
        (tmp_path / kind).mkdir()
        for number in range(82):
            picture = np.full((8, 8, 3) if kind == "images" else (8, 8), number % 11, np.uint8)
            cv2.imwrite(str(tmp_path / kind / f"{number:06d}{suffix}"), picture)
    held, trained = (data.samples(tmp_path, held_out) for held_out in (True, False))
    assert [sample.name for sample in held] == ["000000", "000040", "000080"]
    assert len(trained) == 79
    pictures = data.Pictures(held)
    assert len(pictures) == 3
    assert (pictures[1][1] == 40 % 11).all()
    held[0].labels.unlink()  # as if it were being written
    assert [sample.name for sample in data.samples(tmp_path, True)] == ["000040", "000080"]
    with pytest.raises(ValueError, match="must be a grey PNG"):
        held[0].read()
    with pytest.raises(FileNotFoundError, match="no rendered pictures to train on"):
        data.samples(tmp_path / "nowhere", False)
