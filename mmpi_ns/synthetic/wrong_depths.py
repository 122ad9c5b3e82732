"""Depths that are wrong on purpose, to see whether training follows them.

scattered: a tenth of the pixels have a random depth. mirror: surfaces in some places are seen too far away, in the same
way by all images, as in windows that reflect the street. car: something drives ahead of the camera, so that a part of
every image has the same depth.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mmpi_ns.synthetic.cameras import Array, Cameras
from mmpi_ns.synthetic.scene import Colors

Wrong = Literal["none", "scattered", "mirror", "car"]
"""How the depths of training images are wrong."""
SCATTERED, NEAREST, FARTHEST = 0.1, 2.0, 40.0
"""Share of the pixels, and the distances in metres between which theirs are drawn."""
BESIDE, EVERY, LONG, TOO_FAR = 3.5, 6.0, 2.0, 1.8
"""Metres beside the camera from which mirrors hang; one every so many metres of the way, so long; how much too far."""
CAR, AHEAD = (0.4, 0.6, 0.5, 0.85), 6.0
"""Left, right, top and bottom of the car as shares of the image, and its depth in metres."""


def wrong_distances(kind: Wrong, cameras: Cameras, camera: int, distances: Colors, seed: int) -> Colors:
    """What a sensor of this camera says.

    Args:
        kind: how it is wrong.
        cameras: of the scene.
        camera: number of the camera.
        distances: the true ones [H, W], metres along the rays.
        seed: of the random ones.
    """
    return distances if kind == "none" else _wrong(kind, cameras, camera, distances, seed).astype(np.float32)


def _wrong(kind: Wrong, cameras: Cameras, camera: int, distances: Colors, seed: int) -> Array:
    height, width = distances.shape
    if kind == "scattered":
        g = np.random.default_rng((seed, camera))
        random = g.uniform(NEAREST, FARTHEST, distances.shape)
        return np.where(g.random(distances.shape) < SCATTERED, random, distances)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins, directions = cameras.rays(camera, np.stack([x.ravel(), y.ravel()], -1))
    if kind == "car":
        left, right, top, bottom = CAR
        inside = (x > left * width) & (x < right * width) & (y > top * height) & (y < bottom * height)
        ahead = directions @ -cameras.camera_to_worlds[camera][:, 2]
        return np.where(inside, np.minimum(distances, AHEAD / ahead.reshape(height, width)), distances)
    finite = np.where(np.isfinite(distances), distances, 0.0).reshape(-1, 1)
    sideways = (finite * directions) @ cameras.camera_to_worlds[camera][:, 0]
    along = (origins + finite * directions) @ _way(cameras)
    hangs = (np.abs(sideways) > BESIDE) & (along % EVERY < LONG)
    return np.where(hangs.reshape(height, width), TOO_FAR * distances, distances)


def _way(cameras: Cameras) -> Array:
    """Unit direction [3] from the first camera to the one farthest from it."""
    offsets = cameras.camera_to_worlds[:, :, 3] - cameras.camera_to_worlds[0, :, 3]
    longest = offsets[np.argmax(np.linalg.norm(offsets, axis=-1))]
    return longest / max(float(np.linalg.norm(longest)), 1e-12)
