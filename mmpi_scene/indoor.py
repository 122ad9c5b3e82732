"""Scenes around one place: a room, and an object that is walked round."""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np

from mmpi_scene.cameras import Cameras
from mmpi_scene.primitives import BEIGE, BROWN, GRAY, GREEN, PAINTS, PALE_GREEN, WALLS, WHITE, Kit, look
from mmpi_scene.scene import Light, Scene
from mmpi_scene.surroundings import floor_inside, meadow, open_sky

ROOM = (6.4, 5.2, 2.7)
"""Width (x), depth (y) and height of the room, metres."""
OAK, DARK_OAK = (0.68, 0.48, 0.29), (0.46, 0.29, 0.16)
EYE = 1.5


class Room(Kit):
    """A living room with a window in the far wall and a table in the middle."""

    def shell(self) -> None:
        (w, d, h), t = ROOM, 0.16
        paper = (self.pick(WALLS), self.pick(WALLS), self.varied(WHITE))
        self.box((0, 0, h + t / 2), (w, d, t), "wood", WHITE, (0.8, 0.77, 0.68))
        mortar = (0.8, 0.78, 0.72)
        self.box((w / 2 + t / 2, 0, h / 2), (t, d, h), "bricks", paper[0], self.varied(paper[0], 0.2), mortar)
        self.box((-w / 2 - t / 2, 0, h / 2), (t, d, h), "stripes", *paper)
        self.box((0, -d / 2 - t / 2, h / 2), (w, t, h), "plaster", paper[1], self.varied(paper[1], 0.2))
        # The far wall has a window: four pieces round a hole, through which the sky shows.
        left, right, sill, top = -1.3, 1.1, 0.95, 2.15
        y = d / 2 + t / 2
        for x0, x1, z0, z1 in (
            (-w / 2, left, 0, h), (right, w / 2, 0, h), (left, right, 0, sill), (left, right, top, h),
        ):  # fmt: skip
            center, size = ((x0 + x1) / 2, y, (z0 + z1) / 2), (x1 - x0, t, z1 - z0)
            self.box(center, size, "checker", paper[1], self.varied(paper[1], 0.2))
        for x in (left + 0.04, (left + right) / 2, right - 0.04):
            self.box((x, y, (sill + top) / 2), (0.08, 0.1, top - sill), "wood", WHITE, (0.85, 0.82, 0.75))
        for z in (sill + 0.04, top - 0.04):
            self.box(((left + right) / 2, y, z), (right - left, 0.1, 0.08), "wood", WHITE, (0.85, 0.82, 0.75))
        for side in (-1, 1):
            middle = (left if side < 0 else right) + side * 0.1
            curtain = ((0.72, 0.24, 0.2), (0.86, 0.44, 0.3), (0.95, 0.8, 0.55))
            self.box((middle, d / 2 - 0.08, 1.35), (0.5, 0.07, 2.3), "stripes", *curtain)

    def table(self) -> None:
        self.standing((0, 0, 0.72), (1.7, 1.0, 0.05), "wood", OAK, DARK_OAK)
        for x, y in product((-0.75, 0.75), (-0.4, 0.4)):
            self.standing((x, y, 0), (0.08, 0.08, 0.72), "wood", DARK_OAK, BROWN)
        self.standing((0, 0, 0), (2.6, 1.9, 0.012), "checker", (0.66, 0.2, 0.18), (0.86, 0.72, 0.5))
        for x, y, yaw in ((-0.42, -0.8, 0.15), (0.45, -0.78, -0.1), (-0.4, 0.82, 3.2), (0.42, 0.8, 2.9)):
            c, s, seat = np.cos(yaw), np.sin(yaw), self.pick(PAINTS)
            colors = (seat, self.varied(seat, 0.4), WHITE)
            self.standing((x, y, 0.42), (0.44, 0.44, 0.05), "stripes", *colors, yaw=yaw)
            back = (x + s * 0.2, y - c * 0.2, 0.47)
            self.standing(back, (0.44, 0.04, 0.46), "wood", OAK, DARK_OAK, yaw=yaw)
            for u, v in product((-0.19, 0.19), repeat=2):
                leg = (x + c * u - s * v, y + s * u + c * v, 0)
                self.standing(leg, (0.04, 0.04, 0.42), "wood", DARK_OAK, BROWN, yaw=yaw)
        self.sphere((0.1, 0.05, 0.77 + 0.16), 0.16, "stripes", (0.2, 0.4, 0.62), WHITE, (0.85, 0.6, 0.2))
        self.cylinder((-0.3, 0.12, 0.77), 0.09, 0.24, "checker", (0.75, 0.5, 0.2), (0.25, 0.2, 0.3))
        self.sphere((-0.3, 0.12, 1.15), 0.2, "foliage", GREEN, PALE_GREEN)
        covers = [self.pick(PAINTS) for _ in range(3)]
        self.standing((0.5, -0.18, 0.77), (0.3, 0.22, 0.06), "painting", *covers, yaw=0.4)
        self.standing((0.52, -0.17, 0.83), (0.24, 0.18, 0.05), "checker", self.pick(PAINTS), WHITE, yaw=0.7)
        self.cylinder((-0.55, -0.25, 0.77), 0.05, 0.11, "stripes", WHITE, (0.8, 0.25, 0.2))
        self.cylinder((0, 0, ROOM[2] - 0.07), 0.22, 0.07, "plaster", WHITE, (1.0, 0.95, 0.8))

    def walls(self) -> None:
        """Furniture along the walls, and pictures on them."""
        w, d, _ = ROOM
        self.standing((-w / 2 + 0.18, 0.9, 0), (0.34, 1.9, 2.1), "books", OAK, DARK_OAK)
        self.standing((-w / 2 + 0.22, -1.4, 0), (0.42, 1.5, 0.8), "wood", DARK_OAK, OAK)
        self.sphere((-w / 2 + 0.25, -1.0, 0.97), 0.17, "checker", (0.2, 0.5, 0.5), (0.9, 0.85, 0.7))
        self.standing((-w / 2 + 0.2, -1.75, 0.8), (0.3, 0.4, 0.32), "books", DARK_OAK, OAK)
        cloth = ((0.28, 0.42, 0.5), (0.4, 0.56, 0.62))
        self.standing((0.4, -d / 2 + 0.42, 0), (2.3, 0.8, 0.42), "plaster", *cloth)
        self.standing((0.4, -d / 2 + 0.12, 0.42), (2.3, 0.2, 0.46), "plaster", *cloth)
        for x, color in ((-0.45, PAINTS[6]), (0.2, PAINTS[0]), (1.15, WHITE)):
            self.standing((x, -d / 2 + 0.38, 0.42), (0.4, 0.16, 0.38), "checker", self.varied(color), BEIGE, yaw=0.15)
        self.standing((w / 2 - 0.2, 0.2, 0), (0.38, 1.8, 0.55), "wood", OAK, DARK_OAK)
        self.standing((w / 2 - 0.2, 0.2, 0.58), (0.08, 1.1, 0.65), "painting", *(self.pick(PAINTS) for _ in range(3)))
        self.cylinder((w / 2 - 0.45, 1.9, 0), 0.2, 0.4, "bricks", (0.7, 0.38, 0.26), (0.6, 0.3, 0.2), (0.5, 0.26, 0.18))
        self.cylinder((w / 2 - 0.45, 1.9, 0.4), 0.03, 0.5, "wood", BROWN, DARK_OAK)
        for dx, dy, dz in ((0, 0, 1.15), (0.16, -0.18, 0.98), (-0.2, 0.05, 1.0), (0.02, 0.18, 1.35)):
            self.sphere((w / 2 - 0.45 + dx, 1.9 + dy, dz), 0.27, "foliage", GREEN, PALE_GREEN)
        self.standing((-2.2, d / 2 - 0.25, 0), (1.1, 0.4, 1.05), "wood", OAK, DARK_OAK)
        self.standing((2.0, -d / 2 + 0.3, 0), (0.5, 0.5, 0.6), "checker", DARK_OAK, OAK)
        self.cylinder((2.0, -d / 2 + 0.3, 0.6), 0.04, 0.35, "stripes", GRAY, WHITE)
        self.cylinder((2.0, -d / 2 + 0.3, 0.95), 0.17, 0.24, "stripes", BEIGE, WHITE, (0.8, 0.6, 0.3))
        for x, z, size in ((-2.0, 1.6, 0.8), (-0.6, 1.65, 0.65), (0.75, 1.6, 0.95), (2.3, 1.55, 0.55)):
            colors = [self.pick(PAINTS), self.pick(PAINTS), DARK_OAK]
            self.box((x, -d / 2 + 0.02, z), (size, 0.04, size * 0.75), "painting", *colors)
        for y, size in ((-1.6, 0.7), (1.3, 0.8)):
            self.box((w / 2 - 0.02, y, 1.65), (0.04, size, size), "painting", *(self.pick(PAINTS) for _ in range(3)))
        self.box((2.1, d / 2 - 0.02, 1.6), (0.8, 0.04, 1.1), "painting", *(self.pick(PAINTS) for _ in range(3)))
        self.box((-w / 2 + 0.02, -1.4, 1.55), (0.04, 1.1, 0.7), "painting", *(self.pick(PAINTS) for _ in range(3)))


def _room(name: str, seed: int, cameras: Cameras) -> Scene:
    lamp, kit = Light((0.0, 0.0, 2.38), is_lamp=True, strength=0.42, ambient=0.62), Room(seed, 11)
    kit.shell()
    kit.table()
    kit.walls()
    return Scene(name, seed, kit.done(), partial(floor_inside, ROOM[:2]), open_sky, lamp, cameras)


def room(seed: int, count: int, width: int, height: int) -> Scene:
    """A walk round the table, turning to look all round."""
    random = np.random.default_rng([seed, 12])
    angle = 2 * np.pi * (np.arange(count) + random.uniform()) / count
    places = np.stack([1.85 * np.cos(angle), 1.45 * np.sin(angle), EYE + 0.08 * np.sin(3 * angle)], -1)
    pitch = -0.16 + 0.14 * np.sin(5 * angle)
    return _room("room", seed, Cameras(look(places, 3 * angle, pitch), 0.62 * width, width, height, test_every=8))


def look_round(seed: int, count: int, width: int, height: int) -> Scene:
    """Cameras at nearly one spot of the room, in three rings of pitch."""
    random = np.random.default_rng([seed, 13])
    i = np.arange(count)
    places = np.array([1.5, -1.1, EYE]) + random.uniform(-0.04, 0.04, (count, 3))
    pitch = np.radians(np.array([-28.0, 0.0, 25.0])[i % 3])
    poses = look(places, 2 * np.pi * i / count, pitch)
    return _room("look-round", seed, Cameras(poses, 0.62 * width, width, height, test_every=8))


def orbited(seed: int, count: int, width: int, height: int) -> Scene:
    """A sculpture of boxes and spheres on a plinth, in a garden."""
    kit = Kit(seed, 14)
    kit.cylinder((0, 0, 0), 1.7, 0.22, "bricks", (0.72, 0.66, 0.56), (0.6, 0.54, 0.46), (0.45, 0.42, 0.38))
    kit.standing((0, 0, 0.22), (1.15, 0.95, 0.6), "checker", kit.pick(PAINTS), WHITE, yaw=0.3)
    kit.standing((-0.1, 0.05, 0.82), (0.8, 0.62, 0.42), "stripes", *(kit.pick(PAINTS) for _ in range(3)), yaw=0.9)
    kit.sphere((-0.05, 0.02, 1.24 + 0.38), 0.38, "checker", kit.pick(PAINTS), BEIGE)
    kit.sphere((0.95, -0.55, 0.22 + 0.3), 0.3, "stripes", kit.pick(PAINTS), WHITE, kit.pick(PAINTS))
    kit.sphere((-0.9, 0.65, 0.22 + 0.24), 0.24, "foliage", (0.5, 0.16, 0.1), (0.9, 0.6, 0.25))
    kit.cylinder((-0.85, -0.65, 0.22), 0.17, 1.05, "bricks", (0.7, 0.4, 0.3), (0.6, 0.3, 0.22), BEIGE)
    kit.standing((0.5, 0.75, 0.22), (0.4, 0.4, 0.75), "wood", OAK, DARK_OAK, yaw=0.5)
    kit.sphere((0.5, 0.75, 0.97 + 0.19), 0.19, "plaster", PAINTS[6], (0.95, 0.85, 0.5))
    for k in range(14):
        angle, far = 2 * np.pi * (k + kit.random.uniform(-0.2, 0.2)) / 14, kit.random.uniform(9, 12)
        place = (far * np.cos(angle), far * np.sin(angle), 0.0)
        if k % 3 == 0:
            kit.cylinder(place, 0.2, 2.4, "plaster", BROWN, (0.28, 0.2, 0.13))
            kit.sphere((*place[:2], 3.2), kit.random.uniform(1.2, 1.6), "foliage", GREEN, PALE_GREEN)
        elif k % 3 == 1:
            kit.standing(place, (0.8, 3.6, kit.random.uniform(1.5, 2.2)), "foliage", GREEN, PALE_GREEN, yaw=angle)
        else:
            wall = kit.pick(WALLS)
            kit.standing(place, (0.4, 3.2, 2.3), "bricks", wall, kit.varied(wall, 0.2), GRAY, yaw=angle)
    angle = 2 * np.pi * np.arange(count) / count
    places = np.stack([4.1 * np.cos(angle), 4.1 * np.sin(angle), 1.75 + 0.65 * np.sin(3 * angle + seed)], -1)
    toward = np.array([0.0, 0.0, 0.85]) - places
    yaw, pitch = np.arctan2(toward[:, 1], toward[:, 0]), np.arctan2(toward[:, 2], np.hypot(*toward[:, :2].T))
    cameras = Cameras(look(places, yaw, pitch), 1.05 * width, width, height, test_every=8)
    return Scene("object", seed, kit.done(), meadow, open_sky, Light((-0.5, -0.35, 0.8)), cameras)
