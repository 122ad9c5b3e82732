"""Writes a street whose training images have wrong depths, to see whether training follows them.

scattered: a tenth of the pixels have a random depth. mirror: surfaces in some places are seen too far away, in the same
way by all images, as in windows that reflect the street. car: something drives ahead of the camera, so that a part of
every image has the same depth.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from mmpi_ns.scripts.command import run
from mmpi_scene.cameras import Array, Cameras
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset, write_depths
from mmpi_scene.scene import Colors, Scene, render

Wrong = Literal["scattered", "mirror", "car"]
"""How the depths of training images are wrong."""
SCATTERED, NEAREST, FARTHEST = 0.1, 2.0, 40.0
"""Share of the pixels, and the distances in metres between which theirs are drawn."""
BESIDE, EVERY, LONG, TOO_FAR = 3.5, 6.0, 2.0, 1.8
"""Metres beside the camera from which mirrors hang; one every so many metres of the way, so long; how much too far."""
CAR, AHEAD = (0.4, 0.6, 0.5, 0.85), 6.0
"""Left, right, top and bottom of the car as shares of the image, and its depth in metres."""


@dataclass
class WrongDepths:
    """Writes the procedural street with wrong depths in its training images; those of test images are exact.

    Next: ns-train mmpi-small --data FOLDER
    """

    folder: tyro.conf.Positional[Path]
    """Folder to write."""
    kind: Wrong = "mirror"
    """scattered: a tenth of the pixels, at random. mirror: surfaces beside the path too far away, consistently in all
    images. car: a car that drives ahead."""
    seed: int = 0
    """Each seed gives another street."""
    overwrite: bool = False
    """Replace a data set in the folder."""

    def main(self) -> None:
        write_with_wrong_depths(make_scene("street", self.seed), self.folder, self.kind, overwrite=self.overwrite)


def write_with_wrong_depths(scene: Scene, folder: Path, kind: Wrong, **how: Any) -> None:
    """Writes a scene, and then the depths of its training images anew; ``how`` is for ``write_dataset``."""
    write_dataset(scene, folder, **how)
    for i in np.flatnonzero(~scene.cameras.is_test).tolist():
        distances = wrong_distances(kind, scene.cameras, i, render(scene, i)[1], scene.seed)
        write_depths(scene, folder, i, distances.astype(np.float32))


def wrong_distances(kind: Wrong, cameras: Cameras, camera: int, distances: Colors, seed: int) -> Array:
    """What a depth sensor of this camera reads [H, W], metres along the rays.

    Args:
        kind: how it is wrong.
        cameras: of the scene.
        camera: number of the camera.
        distances: the true ones [H, W], metres along the rays.
        seed: of the random ones.
    """
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


if __name__ == "__main__":
    sys.exit(run("wrong_depths", WrongDepths))
