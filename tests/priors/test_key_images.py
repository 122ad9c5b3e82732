"""Key images of a video: what others are compared with, and what is looked at first where movers are looked for; and
from how large a mask on anything counts."""

from __future__ import annotations

import numpy as np
import pytest
from hand_made import posed

from mmpi_priors.dense import Depth
from mmpi_priors.moving import key_images, too_few_depths
from mmpi_priors.moving_evidence import Shot
from mmpi_priors.views import View


def aside(*places):
    """Cameras before a wall, so far from the first as its points shift in the image, in widths."""
    poses = np.tile(np.eye(4)[:3], (len(places), 1, 1))
    poses[:, 0, 3] = places
    return posed(poses, [100, 100, 50, 25], [100, 50])


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


@pytest.mark.parametrize(("depths", "is_enough"), [(0.45, False), (0.55, True)])
def test_where_most_depths_are_unknown_nothing_can_be_told(depths, is_enough):
    """Of the textured half of the images; the plain half, which cannot be matched, does not count."""
    gray = np.zeros((50, 100), np.uint8)
    gray[:, :50] = np.random.default_rng(0).integers(0, 255, (50, 50))
    inverse = np.zeros((50, 100), np.float32)
    inverse[: round(50 * depths)] = 1
    view = View(gray, np.ones(4), np.eye(4)[:3], np.ones((50, 100), bool))
    said = too_few_depths([Shot(view, np.zeros((50, 100, 3), np.uint8), Depth(inverse, inverse), None)] * 5)
    assert bool(said) != is_enough and (is_enough or "People who walk along may be left in" in said)
