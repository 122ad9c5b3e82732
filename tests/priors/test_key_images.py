"""Key images of a video: what others are compared with, and what is looked at first where movers are looked for; and
from how large a mask on anything counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors.moving import key_images


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
