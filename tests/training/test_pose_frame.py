"""The frame of refined poses: what no image shows is removed, what images show is kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mmpi_ns.training.run import keep_frame

CONTENT = 3.0


def cameras(count=12, length=20.0):
    """Positions [M, 3] along a bending track, and orientations."""
    random, along = np.random.default_rng(0), np.linspace(0, length, count)
    centers = np.stack([along, 0.1 * along**2 / length, 1 + 0.1 * np.sin(along)], -1)
    return centers + 100, Rotation.from_rotvec(random.normal(0, 0.3, (count, 3)))


def framed(shifts, turns, centers, scale_is_free=False):
    moves = torch.from_numpy(np.concatenate([shifts, turns], -1))
    keep_frame(moves, torch.from_numpy(centers), CONTENT, scale_is_free)
    return moves.numpy()[:, :3], moves.numpy()[:, 3:]


def seen_from_first(shifts, turns, centers, rotations):
    """Every camera's position and orientation in the first one's axes: all that images can show."""
    moved, places = Rotation.from_rotvec(turns) * rotations, centers + shifts
    return moved[0].inv().apply(places - places[0]), (moved[0].inv() * moved).as_matrix()


@pytest.mark.parametrize("scale_is_free", [False, True])
def test_a_rigid_motion_of_all_cameras_is_removed(scale_is_free):
    centers, _ = cameras()
    turn, middle = np.array([2e-4, -3e-4, 1e-4]), centers.mean(0)
    shifts = np.cross(turn, centers - middle) + np.array([0.01, -0.02, 0.03])
    shifts, turns = framed(shifts, np.broadcast_to(turn, centers.shape), centers, scale_is_free)
    assert np.abs(shifts).max() < 1e-5 and np.abs(turns).max() < 1e-6


def test_what_images_show_of_random_corrections_stays():
    centers, rotations = cameras()
    random = np.random.default_rng(1)
    shifts, turns = random.normal(0.02, 0.01, (2, 12, 3)) * 0.1
    before = seen_from_first(shifts, turns, centers, rotations)
    kept = framed(shifts, turns, centers)
    for a, b in zip(before, seen_from_first(*kept, centers, rotations), strict=True):
        assert np.allclose(a, b, atol=2e-5)
    assert np.abs(kept[1] - turns).max() > 1e-4, "something was to remove"


def test_cameras_that_turn_where_they_stand_keep_their_common_turn():
    centers, _ = cameras()
    heading = np.broadcast_to([0.0, 0.0, 0.01], centers.shape)
    _, turns = framed(np.zeros_like(centers), heading, centers)
    assert turns[:, 2].min() > 0.007  # a track this long bends visibly


def test_a_change_of_scale_stays_where_depths_fix_it():
    centers, _ = cameras()
    grown = 0.01 * (centers - centers.mean(0))
    none = np.zeros_like(centers)
    assert np.allclose(framed(grown, none, centers)[0], grown, atol=1e-9)
    assert np.abs(framed(grown, none, centers, scale_is_free=True)[0]).max() < 0.02 * np.abs(grown).max()
