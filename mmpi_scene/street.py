"""A street, driven or walked along: house fronts, parked cars, lamps, trees; straight or bending, of any length."""

from __future__ import annotations

from functools import partial

import numpy as np

from mmpi_scene.cameras import Cameras
from mmpi_scene.primitives import BROWN, GRAY, GREEN, PAINTS, PALE_GREEN, WALLS, WHITE, Kit, look
from mmpi_scene.road import Road
from mmpi_scene.scene import Light, Scene
from mmpi_scene.surroundings import open_sky, street_ground

SUN = (-0.45, -0.4, 0.8)
CAMERA_HEIGHT, EYE = 1.65, 1.6
"""Metres from the ground to the camera of a car, and to the phone."""
FOCAL_SHARE, PHONE_FOCAL_SHARE = 0.58, 0.76
"""Focal length as a share of the image width, as on KITTI, and as of a phone's video."""
PACE, STEPS = 1.3, 1.9
"""Metres and steps a second."""
LENS = (-0.11, 0.045, 0.0012, -0.0008)
"""k1, k2, p1, p2: pixels at the corners of a wide image are 4 % nearer to its middle than in a pinhole."""
ASIDE, WEAVE = -2.2, 0.8
"""Metres to the left of the middle line, and by how much that changes: the right side of the carriageway."""
TURN, GLANCE, NOD = 0.7, 0.2, 0.05
"""Radians: slow turns towards the house fronts, faster and smaller ones, and up and down."""
SHAKE = (0.009, 0.008, 0.012)
"""Standard deviation of yaw, pitch and roll by a shaking hand, radians."""
SLOWEST, FASTEST = 0.7, 6.0
"""Shakes a second."""
STRIDE = (0.03, 0.025)
"""Metres of sway from step to step, and of bob with each."""


class Street(Kit):
    """Objects along a road: houses, parked cars, trees, lamps."""

    def __init__(self, seed: int, road: Road, topic: int = 1) -> None:
        super().__init__(seed, topic)
        self.road = road

    def place(self, along: float, aside: float, z: float = 0.0) -> tuple[tuple[float, float, float], float]:
        """World place and heading at a place along the road."""
        xy, heading = self.road.at(np.array([along]), aside)
        return (float(xy[0, 0]), float(xy[0, 1]), z), float(heading[0])

    def houses(self, side: int, first: float, last: float) -> None:
        """A row of house fronts, with a gap closed by a hedge here and there."""
        along = first
        while along < last:
            width, depth = self.random.uniform(7.5, 13), self.random.uniform(7, 10)
            middle = along + width / 2
            if self.random.random() < 0.16:
                place, yaw = self.place(middle, side * (self.road.pavement + 1.5))
                self.standing(place, (width, 0.9, self.random.uniform(1.3, 2)), "foliage", GREEN, PALE_GREEN, yaw=yaw)
                self.tree(along + width * 0.6, side * (self.road.pavement + 5), 1.5)
            else:
                self.house(middle, side, width, depth)
            along += width + (0.0 if self.random.random() < 0.6 else self.random.uniform(0.6, 2.5))

    def house(self, along: float, side: int, width: float, depth: float) -> None:
        storeys = int(self.random.integers(2, 5))
        height = storeys * self.random.uniform(2.9, 3.3)
        back = self.road.pavement + self.random.uniform(0, 0.9)
        place, yaw = self.place(along, side * (back + depth / 2))
        wall = self.pick(WALLS)
        # Fronts face the street on both sides: the solid's own left must be the street's.
        colors = (wall, self.varied(wall, 0.15), self.varied(WHITE))
        self.standing(place, (width, depth, height), "facade", *colors, yaw=yaw)
        roof = self.varied((0.5, 0.27, 0.2) if self.random.random() < 0.6 else (0.33, 0.34, 0.37))
        dark = tuple(0.75 * c for c in roof)
        top = (place[0], place[1], height)
        self.standing(top, (width + 0.3, depth + 0.7, 0.28), "plaster", roof, dark, yaw=yaw)
        self.standing((*top[:2], height + 0.28), (width * 0.9, depth * 0.7, 1.5), "bricks", roof, dark, dark, yaw=yaw)
        chimney, _ = self.place(along + width * 0.25, side * (back + depth * 0.4), height + 1.7)
        self.standing(chimney, (0.7, 0.7, 1.2), "bricks", (0.6, 0.36, 0.28), (0.5, 0.3, 0.24), GRAY, yaw=yaw)
        if self.random.random() < 0.4:
            step, _ = self.place(along, side * (back - 0.55), 2.75)
            awning = self.pick(PAINTS)
            self.box(step, (width * 0.5, 1.1, 0.12), "stripes", awning, self.varied(WHITE), awning, yaw=yaw)

    def parked(self, side: int, first: float, last: float) -> None:
        along = first
        while along < last:
            if self.random.random() < 0.62:
                self.car(along, side * (self.road.half_width + 1.05), self.pick(PAINTS))
            elif self.random.random() < 0.3:
                place, yaw = self.place(along, side * (self.road.kerb + 0.6))
                self.standing(place, (0.7, 0.7, 1.1), "checker", self.pick(PAINTS), WHITE, yaw=yaw)
            along += self.random.uniform(5.3, 6.4)

    def car(self, along: float, aside: float, paint) -> None:
        place, yaw = self.place(along, aside, 0.22)
        lamp = (0.95, 0.9, 0.75)
        van = self.random.random() < 0.2
        self.standing(place, (4.2, 1.72, 0.72), "car", paint, paint, lamp, yaw=yaw)
        top, _ = self.place(along - 0.15, aside, 0.94)
        self.standing(top, (3.6 if van else 2.3, 1.58, 1.0 if van else 0.56), "cabin", paint, yaw=yaw)
        for end in (-1.3, 1.3):
            for side in (-0.62, 0.62):
                wheel, _ = self.place(along + end, aside + side, 0.33)
                self.sphere(wheel, 0.33, "plaster", (0.08, 0.08, 0.09), (0.16, 0.16, 0.17))

    def kerbside(self, side: int, first: float, last: float) -> None:
        """Trees and lamp posts along the kerb."""
        along = first
        while along < last:
            if self.random.random() < 0.55:
                self.tree(along, side * (self.road.kerb + 0.75), self.random.uniform(0.8, 1.15))
            else:
                metal = (0.24, 0.3, 0.28)
                place, yaw = self.place(along, side * (self.road.kerb + 0.4))
                self.cylinder(place, 0.07, 5.4, "plaster", metal, (0.3, 0.36, 0.34))
                arm, _ = self.place(along, side * (self.road.kerb - 0.3), 5.4)
                self.box(arm, (0.1, 1.5, 0.1), "plaster", metal, metal, yaw=yaw)
                self.sphere((arm[0], arm[1], 5.25), 0.2, "plaster", WHITE, (0.9, 0.85, 0.6))
                if self.random.random() < 0.6:
                    sign, _ = self.place(along, side * (self.road.kerb + 0.4), 2.5)
                    self.box(sign, (0.08, 0.75, 0.75), "painting", self.pick(PAINTS), WHITE, self.pick(PAINTS), yaw=yaw)
            along += self.random.uniform(9, 16)

    def tree(self, along: float, aside: float, scale: float) -> None:
        height = scale * self.random.uniform(2.6, 3.2)
        place, _ = self.place(along, aside)
        self.cylinder(place, 0.16 * scale, height, "plaster", BROWN, (0.28, 0.2, 0.13))
        leaf = self.varied((0.17, 0.33, 0.1), 0.2)
        bright = tuple(min(1.0, c * 2.1 + 0.08) for c in leaf)
        for _ in range(4):
            shift = self.random.uniform(-0.8, 0.8, 3) * scale * [1, 1, 0.8]
            center = (place[0] + shift[0], place[1] + shift[1], height + (0.75 * scale + shift[2]))
            self.sphere(center, self.random.uniform(0.85, 1.3) * scale, "foliage", leaf, bright)


def drive_cameras(road: Road, seed: int, count: int, width: int, height: int) -> Cameras:
    """Cameras along the right-hand lane, looking ahead, swaying a little."""
    random = np.random.default_rng([seed, 2])
    along = np.linspace(0, road.length, count) if count > 1 else np.zeros(1)
    phases = random.uniform(0, 2 * np.pi, 4)
    sizes, periods = np.array([[0.2, 0.03, 0.015, 0.008], [31, 17, 23, 13]])
    aside, up, yaw, pitch = sizes[:, None] * np.sin(2 * np.pi * along / periods[:, None] + phases[:, None])
    xy, heading = road.at(along, -1.7 + aside)
    places = np.concatenate([xy, CAMERA_HEIGHT + up[:, None]], -1)
    poses = look(places, heading + yaw, pitch + 0.01)
    return Cameras(poses, FOCAL_SHARE * width, width, height, test_every=2)


def make_street(name: str, road: Road, seed: int, cameras: Cameras) -> Scene:
    """Builds a street along a road; the work grows linearly with its length."""
    kit = Street(seed, road)
    first, last = -road.before, road.length + road.beyond
    for side in (-1, 1):
        kit.houses(side, first + kit.random.uniform(0, 4), last)
        kit.parked(side, first + kit.random.uniform(0, 4), last)
        kit.kerbside(side, first + kit.random.uniform(0, 8), last)
    return Scene(name, seed, kit.done(), partial(street_ground, road), open_sky, Light(SUN), cameras, road=road)


def street(seed: int, count: int, width: int, height: int, length: float) -> Scene:
    """A straight street."""
    road = Road(length, beyond=150.0)
    return make_street("street", road, seed, drive_cameras(road, seed, count, width, height))


def long_road(seed: int, count: int, width: int, height: int, length: float) -> Scene:
    """A bending road of any length: radii of 100 m and more."""
    phases = np.random.default_rng([seed, 3]).uniform(0, 2 * np.pi, 2)
    # A whole number of half turns apart would start straight for every seed: phases are free.
    waves = ((9.0, 250.0, float(phases[0])), (38.0, 900.0, float(phases[1])))
    road = Road(length, waves)
    return make_street("long-road", road, seed, drive_cameras(road, seed, count, width, height))


def walk(seed: int, count: int, width: int, height: int, length: float) -> Scene:
    """A hand-held walk down a gently bending street: a phone's lens, steps, a shaking hand, slow turns of the head."""
    random = np.random.default_rng([seed, 17])
    road = Road(length, ((5.0, 170.0, float(random.uniform(0, 2 * np.pi))),), beyond=150.0)
    along = np.linspace(0, length, count) if count > 1 else np.zeros(1)
    seconds = along / PACE
    phases = random.uniform(0, 2 * np.pi, 6)
    turns = np.stack([seconds * STEPS / 2, seconds * STEPS, along / 35, along / 27, along / 10, along / 14])
    sizes = np.array([*STRIDE, WEAVE, TURN, GLANCE, NOD])
    sway, bob, weave, turn, glance, nod = sizes[:, None] * np.sin(2 * np.pi * turns + phases[:, None])
    xy, heading = road.at(along, ASIDE + weave + sway)
    shakes = []
    for size in SHAKE:  # band-limited noise: equal waves at random frequencies
        frequencies = np.exp(random.uniform(np.log(SLOWEST), np.log(FASTEST), 12))
        turns = seconds[:, None] * frequencies + random.uniform(0, 1, 12)
        shakes.append(size * np.sqrt(2 / 12) * np.sin(2 * np.pi * turns).sum(-1))
    yaw_shake, pitch_shake, roll = shakes
    yaw = heading + turn + glance + yaw_shake
    poses = look(np.column_stack([xy, EYE + bob]), yaw, nod + pitch_shake)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    right, up = poses[:, :, 0], poses[:, :, 1]
    poses[:, :, 0], poses[:, :, 1] = c * right + s * up, c * up - s * right
    cameras = Cameras(poses, PHONE_FOCAL_SHARE * width, width, height, test_every=8, distortion=LENS)
    return make_street("walk", road, seed, cameras)
