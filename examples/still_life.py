"""Writes a still life in front of a grid of cameras as a Nerfstudio data set: python examples/still_life.py FOLDER."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro

from mmpi_ns.scripts.command import run
from mmpi_scene.cameras import Cameras
from mmpi_scene.dataset import write_dataset
from mmpi_scene.indoor import DARK_OAK, OAK
from mmpi_scene.primitives import BEIGE, BROWN, PAINTS, WALLS, WHITE, Kit, look
from mmpi_scene.scene import Light, Scene
from mmpi_scene.surroundings import floor_inside, open_sky


def still_life(seed: int = 0, count: int = 25, width: int = 240, height: int = 160) -> Scene:
    """Things on a table before a wall; a grid of cameras that all face it."""
    kit = Kit(seed, 15)
    wall = kit.pick(WALLS)
    kit.standing((1.7, 0, 0), (0.2, 9, 4.0), "bricks", wall, kit.varied(wall, 0.2), (0.82, 0.8, 0.74))
    kit.standing((0.35, 0, 0.7), (1.5, 2.6, 0.07), "wood", OAK, DARK_OAK)
    for x in (-0.3, 1.0):
        for y in (-1.2, 1.2):
            kit.standing((x, y, 0), (0.1, 0.1, 0.7), "wood", DARK_OAK, BROWN)
    kit.box((1.58, 0.75, 1.75), (0.04, 0.9, 0.65), "painting", *(kit.pick(PAINTS) for _ in range(3)))
    kit.box((1.58, -0.7, 1.8), (0.04, 0.55, 0.75), "painting", *(kit.pick(PAINTS) for _ in range(3)))
    kit.standing((0.85, 0.85, 0.77), (0.26, 0.7, 0.42), "books", OAK, DARK_OAK, yaw=0.1)
    kit.cylinder((0.35, 0.25, 0.77), 0.13, 0.36, "checker", kit.pick(PAINTS), WHITE)
    for dy, dz in ((0.0, 0.2), (0.15, 0.08), (-0.13, 0.1)):
        kit.sphere((0.35, 0.25 + dy, 1.13 + dz), 0.17, "foliage", (0.55, 0.2, 0.12), (0.95, 0.7, 0.3))
    kit.standing((-0.05, -0.35, 0.77), (0.3, 0.42, 0.09), "painting", *(kit.pick(PAINTS) for _ in range(3)), yaw=0.35)
    kit.sphere((-0.05, -0.35, 0.86 + 0.1), 0.1, "stripes", PAINTS[6], (0.9, 0.5, 0.15))
    kit.sphere((0.5, -0.5, 0.77 + 0.22), 0.22, "stripes", kit.pick(PAINTS), WHITE, kit.pick(PAINTS))
    kit.standing((0.8, -0.95, 0.77), (0.3, 0.3, 0.55), "stripes", kit.pick(PAINTS), BEIGE, kit.pick(PAINTS), yaw=0.6)
    kit.cylinder((0.0, 0.65, 0.77), 0.06, 0.14, "stripes", WHITE, PAINTS[1])
    kit.sphere((-0.1, 0.15, 0.77 + 0.07), 0.07, "plaster", (0.8, 0.2, 0.12), (0.9, 0.5, 0.2))
    columns = int(np.ceil(np.sqrt(count)))
    row, column = np.divmod(np.arange(count), columns)
    middle = (columns - 1) / 2
    y, z = (middle - column) * 0.13, 1.25 + (middle - row) * 0.1
    jitter = np.random.default_rng([seed, 16]).uniform(-0.01, 0.01, (count, 3))
    places = np.stack([np.full(count, -2.1), y, z], -1) + jitter
    cameras = Cameras(look(places, np.zeros(count), np.full(count, -0.06)), 0.95 * width, width, height, test_every=8)
    light = Light((-0.7, 0.45, 0.75))
    return Scene("still-life", seed, kit.done(), partial(floor_inside, (20.0, 20.0)), open_sky, light, cameras)


@dataclass
class StillLife:
    """Writes the still life, as mmpi-scene writes its scenes."""

    folder: tyro.conf.Positional[Path]
    """Folder to write."""
    overwrite: bool = False
    """Replace a data set in the folder."""

    def main(self) -> None:
        write_dataset(still_life(), self.folder, overwrite=self.overwrite)


if __name__ == "__main__":
    sys.exit(run("still_life", StillLife))
