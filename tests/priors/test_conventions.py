"""Cameras that contradict their images: each usual mistake is named, from exact projections of points of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from mmpi_priors.conventions import OPENGL, Matches, find_convention, in_words

COUNT, WIDTH, FOCAL, CENTER = 12, 1000.0, 800.0, np.array([500.0, 375.0])
FLIP = np.diag([1.0, -1, -1, 1])


def orbit() -> np.ndarray:
    """Cameras on a bent path that look at the points around the origin; camera to world, OpenGL axes."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for i, pose in enumerate(poses):
        angle = 0.12 * i
        place = np.array([4 * np.sin(angle), 0.3 * np.sin(3 * angle), 4 * np.cos(angle)])
        back = place / np.linalg.norm(place)
        right = np.cross([0.1, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, place
    return poses


def matched(poses, focal=FOCAL, center=CENTER, bend=0.0, lens=None, noise=0.15):
    """Matches of neighbours, with pixels by the true cameras and rays by the given ones."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (400, 3))
    local = np.einsum("nji,npj->npi", poses[:, :3, :3], points - poses[:, None, :3, 3])
    at = local[..., :2] * [1, -1] / -local[..., 2:]
    at = at * (1 + bend * (at**2).sum(-1, keepdims=True))
    pixels = at * FOCAL + CENTER + rng.normal(size=at.shape) * noise
    pairs = [(i, i + k) for k in (1, 2) for i in range(COUNT - k)]
    images = np.repeat(pairs, 60, 0)
    chosen = np.concatenate([rng.choice(400, 60, replace=False) for _ in pairs])
    flat = (pixels[images, chosen[:, None]] - center) / focal
    return Matches(images, flat if lens is None else lens(flat), flat)


def judged(matrices, matches, focal=FOCAL, center=CENTER):
    lens = np.full(COUNT, focal / WIDTH), np.full((COUNT, 2), focal), np.tile(center, (COUNT, 1))
    return find_convention(matrices, OPENGL, lens, matches)


TRUE = orbit()
MIRROR = np.diag([1.0, 1, -1, 1])


@pytest.mark.parametrize(
    ("matrices", "says"),
    [
        (TRUE @ FLIP, "have OpenCV's camera axes (x right, y down, z forward):"),
        (np.linalg.inv(TRUE), "The matrices are world to camera, not camera to world:"),
        (np.linalg.inv(TRUE @ FLIP), "have OpenCV's camera axes (x right, y down, z forward) and are world to camera"),
        (MIRROR @ TRUE @ MIRROR, "have Unity's camera axes (x right, y up, z forward) and are those of a left-handed"),
        (TRUE[..., [1, 0, 2, 3]] * [-1, 1, 1, 1], "have LLFF's camera axes (x down, y right, z back):"),
        (TRUE * [1, 1, -1, 1], "have Unity's camera axes (x right, y up, z forward):"),
    ],
    ids=["opencv", "inverted", "both", "left-handed world", "llff", "left-handed axes"],
)
def test_a_convention_of_the_matrices_is_named_and_undone(matrices, says):
    as_given, better, is_wrong = judged(matrices, matched(TRUE))
    assert better is not None and is_wrong and better.error * WIDTH < 0.5 < 3 < as_given.error * WIDTH
    assert says in in_words(better, OPENGL, FOCAL, WIDTH, as_given.error)
    # The relative poses are the true ones, whatever the frame of the world.
    poses = better.applied(matrices)
    apart = [np.linalg.inv(p[:-1]) @ p[1:] for p in (poses, TRUE @ FLIP)]
    assert apart[0] == pytest.approx(apart[1], abs=1e-9)


@pytest.mark.parametrize(("factor", "center"), [(2.0, CENTER), (2.0, 2 * CENTER), (0.5, CENTER / 2)])
def test_intrinsics_of_another_image_size_are_named(factor, center):
    given = factor * FOCAL
    _, better, is_wrong = judged(TRUE, matched(TRUE, given, center), given, center)
    assert better is not None and is_wrong and better.focal * given == pytest.approx(FOCAL, rel=0.02)
    assert better.moves_center == (not np.array_equal(center, CENTER)) and not better.is_of_axes(OPENGL)


def test_a_lens_that_is_nonsense_or_left_out_is_named():
    """Terms by which most pixels have no ray; a strong barrel distortion of which the file says nothing."""
    absurd = matched(TRUE, lens=lambda flat: np.where((flat**2).sum(-1, keepdims=True) < 0.01, flat, np.nan))
    as_given, better, is_wrong = judged(TRUE, absurd)
    assert better is not None and is_wrong and better.bend == (0.0, 0.0) and better.focal == 1.0
    assert "none at all would fit" in in_words(better, OPENGL, FOCAL, WIDTH, as_given.error)
    as_given, better, _ = judged(TRUE, matched(TRUE, bend=-0.4))
    assert better is not None and better.bend is not None and 0.3 < better.bend[0] < 0.9


def test_cameras_that_are_right_or_a_little_off_are_left_alone():
    assert judged(TRUE, matched(TRUE))[1:] == (None, False)
    shaken = TRUE.copy()
    shaken[:, :3, 3] += np.random.default_rng(1).normal(size=(COUNT, 3)) * 0.01
    assert judged(shaken, matched(TRUE))[1:] == (None, False)


def test_poses_of_other_images_are_refused_without_a_convention():
    _, better, is_wrong = judged(TRUE[np.random.default_rng(2).permutation(COUNT)], matched(TRUE))
    assert better is None and is_wrong
