"""Key images of a video: what others are compared with, and what is looked at first where movers are looked for; and
from how large a mask on anything counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors import moving
from mmpi_priors.dense import Depth
from mmpi_priors.moving import find_moving, key_images
from mmpi_priors.moving_evidence import Shot
from mmpi_priors.views import View


def aside(*places):
    """Cameras before a wall, so far from the first as its points shift in the image, in widths."""
    poses = np.tile(np.eye(4)[:3], (len(places), 1, 1))
    poses[:, 0, 3] = places
    pinhole, size = np.tile([100.0, 100, 50, 25], (len(places), 1)), np.tile([100.0, 50], (len(places), 1))
    files = tuple(map(Path, map(str, range(len(places)))))
    return PosedImages(files, poses, pinhole, size, np.zeros((len(places), 4)))


def wall(count=40):
    rng = np.random.default_rng(0)
    return np.stack([rng.uniform(-0.3, 0.3, count), rng.uniform(-0.2, 0.2, count), np.full(count, -1.0)], -1)


def test_key_images_are_as_far_apart_as_asked():
    images = aside(*np.arange(9) * 0.01)
    assert key_images(images, lambda i: wall(), 0.0201) == [0, 2, 4, 6, 8]
    assert key_images(images, lambda i: wall(), 0.0301) == [0, 3, 6, 8]
    assert key_images(images, lambda i: wall(), 0.009) == list(range(9))
    assert key_images(images, lambda i: wall(), 1.0) == [0, 8]
    assert key_images(images, lambda i: wall(5), 1.0) == list(range(9))  # too few points to tell
    assert key_images(aside(0, 0.5, 1), lambda i: wall(), 0.02) == [0, 1, 2]
    assert key_images(aside(0.0), lambda i: wall(), 0.02) == [0]
    # There and back: the order counts, not the places.
    assert key_images(aside(0, 0.02, 0.04, 0.02, 0), lambda i: wall(), 0.025) == [0, 1, 4]
    assert key_images(aside(0, 0.5, 0, 0, 0), lambda i: wall(), 0.025) == [0, 1, 2, 4]


@pytest.mark.parametrize("something_moves", [False, True])
def test_frames_between_key_images_are_looked_at_only_near_what_moves(monkeypatch, something_moves):
    """Of 49 frames every sixth comes first; what moves in one is looked for in others near it, on and on."""
    view = View(np.zeros((50, 100), np.uint8), np.ones(4), np.eye(4)[:3], np.ones((50, 100), bool))
    looked_at, compared = [], []
    shows = {12} | {i for i in range(13, 48) if i % 6}  # which one alone that comes first shows
    nothing = Depth(*np.zeros((2, 50, 100), np.float32))

    def depths(images, points_of, width, finish, progress, rounds, among):
        compared.append(among)
        return iter([Shot(view, np.zeros((50, 100, 3), np.uint8), nothing, None) for _ in images.files])

    def moves(shots, near, i, masks, uprights, first):
        if first is None:
            looked_at.append(i)
            assert not any(mask.any() for mask in masks) and set(near) <= set(range(0, 49, 2))
        return np.full((50, 100), something_moves and i in shows), object()

    monkeypatch.setattr(moving, "find_depths", depths)
    monkeypatch.setattr(moving, "_moves", moves)
    for name in ("_followed_on", "_outlined"):
        monkeypatch.setattr(moving, name, lambda shots, near, masks, *_: masks)
    _, masks, _ = find_moving(aside(*np.arange(49) * 0.0099), lambda i: wall())
    assert compared == [list(range(0, 49, 2))]
    assert sorted(looked_at[:9]) == [*range(0, 49, 6)]
    assert len(set(looked_at)) == len(looked_at)
    if something_moves:
        assert {i for i, mask in enumerate(masks) if mask.any()} == shows
    else:
        assert len(looked_at) == 9


@pytest.mark.parametrize("large", [False, True])
def test_small_masks_count_only_where_one_image_has_a_large_one(monkeypatch, large):
    view = View(np.zeros((20, 50), np.uint8), np.ones(4), np.eye(4)[:3], np.ones((20, 50), bool))
    nothing = Depth(*np.zeros((2, 20, 50), np.float32))
    shots = [Shot(view, np.zeros((20, 50, 3), np.uint8), nothing, None) for _ in range(5)]

    def moves(shots, near, i, masks, uprights, first):
        mask = np.zeros((20, 50), bool)
        mask.flat[: (16 if large else 14) if i == 1 else 3] = True
        return mask, None

    monkeypatch.setattr(moving, "find_depths", lambda *_: iter(shots))
    monkeypatch.setattr(moving, "_moves", moves)
    margin = np.arange(1000).reshape(20, 50) >= 990  # of outlines, which does not count
    monkeypatch.setattr(moving, "_followed_on", lambda shots, near, masks, *_: masks)
    monkeypatch.setattr(moving, "_outlined", lambda shots, near, masks, *_: [mask | margin for mask in masks])
    poses = np.tile(np.eye(4)[:3], (5, 1, 1))
    poses[:, 0, 3] = range(5)
    images = PosedImages((Path("x"),) * 5, poses, np.ones((5, 4)), np.tile([50.0, 20], (5, 1)), np.zeros((5, 4)))
    _, masks, _ = find_moving(images, lambda i: np.zeros((0, 3)))
    assert [int(mask.sum()) for mask in masks] == ([13, 26, 13, 13, 13] if large else [0] * 5)


@pytest.mark.parametrize(("known", "is_told"), [(0.45, False), (0.55, True)])
def test_nothing_is_masked_where_most_depths_are_unknown(monkeypatch, known, is_told):
    """Of the textured half of the images; the plain half, which cannot be matched, does not count."""
    gray = np.zeros((50, 100), np.uint8)
    gray[:, :50] = np.random.default_rng(0).integers(0, 255, (50, 50))
    inverse = np.zeros((50, 100), np.float32)
    inverse[: round(50 * known)] = 1
    view = View(gray, np.ones(4), np.eye(4)[:3], np.ones((50, 100), bool))
    shot = Shot(view, np.zeros((50, 100, 3), np.uint8), Depth(inverse, inverse), None)
    monkeypatch.setattr(moving, "find_depths", lambda images, *_: iter([shot] * len(images.files)))
    monkeypatch.setattr(moving, "_moves", lambda *_: (np.ones((50, 100), bool), None))
    for name in ("_followed_on", "_outlined"):
        monkeypatch.setattr(moving, name, lambda shots, near, masks, *_: masks)
    assert moving.share_known(shot) == pytest.approx(known, abs=0.02)
    _, masks, doubt = find_moving(aside(*np.arange(5) * 0.02), lambda i: wall())
    assert all(mask.any() == is_told for mask in masks)
    said = f"confirm the depths of {moving.share_known(shot):.0%} of the textured pixels alone"
    assert (said in doubt and "People who walk along may be left in" in doubt) == (not is_told)
