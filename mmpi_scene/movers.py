"""Cars and people that move through a street while it is filmed, and exact masks of the pixels that they change.

Test images are rendered without them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mmpi_scene.cameras import Array
from mmpi_scene.primitives import PAINTS, WHITE, Primitives, Tracer
from mmpi_scene.road import Road
from mmpi_scene.scene import Scene, tile_order
from mmpi_scene.street import Street

WALKING, DRIVING = 1.3, 8.0
"""Speeds in metres a second; the camera walks or drives too."""
LANE, PAVEMENT = 1.8, 7.6
"""Metres from the middle line at which cars drive, and people walk."""
STRIDES, SWING = 0.95, 0.28
"""Double steps a second, and metres by which a foot is ahead of the body."""
MOVER, SHADOW = 255, 128
"""Values of masks: the object itself, or its shadow."""
CHANGED = 1 / 255
"""Minimum change of a colour in a shadow."""


def movers_at(seed: int, road: Road, count: int, along: Array, walks: bool, camera: int) -> Primitives:
    """Cars and people on a road when an image is taken: in turns oncoming, ahead of the camera, crossing, on the
    pavement, and overtaking. ``along`` are metres along the road of each camera [M], which walks or drives."""
    speed, rows = WALKING if walks else DRIVING, []
    seconds = (along - along[0]) / speed
    now = float(seconds[camera])
    ego = float(np.interp(now, seconds, along))
    for number in range(count):
        # The same draws for every image: a mover keeps its looks.
        kit = Street(seed, road, topic=100 + number)
        meets = float(kit.random.uniform(0.1, 0.9)) * float(seconds[-1])
        since, met = now - meets, float(np.interp(meets, seconds, along))
        paint, side = kit.pick(PAINTS), float(kit.random.choice([-1, 1]))
        if number % 5 == 0:
            kit.car(met + 8 - DRIVING * since, LANE, paint)
        elif number % 5 == 1 and walks:
            _add_person(kit, ego + float(kit.random.uniform(4, 8)), float(kit.random.uniform(-1.2, 0.6)), paint, now)
        elif number % 5 == 1:
            kit.car(ego + 9, -LANE, paint)
        elif number % 5 == 2:
            _add_person(kit, met + (7 if walks else 18), side * WALKING * since, paint, now)
        elif number % 5 == 3:
            _add_person(kit, met + 5 - WALKING * since, side * PAVEMENT, paint, now)
        else:
            kit.car(met + 8 + (speed + 4) * since, LANE, paint)
        rows += kit.rows
    movers = Street(seed, road)
    movers.rows = rows
    return movers.done()


def _add_person(kit: Street, along: float, aside: float, paint, now: float) -> None:
    """Somebody who walks: two legs, a body and a head."""
    swing = SWING * np.sin(2 * np.pi * STRIDES * now)
    trousers = kit.pick(PAINTS)
    for foot, half in ((swing, 0.09), (-swing, -0.09)):
        kit.cylinder(kit.place(along + foot, aside + half)[0], 0.085, 0.85, "plaster", trousers, trousers)
    kit.cylinder(kit.place(along, aside, 0.8)[0], 0.22, 0.62, "stripes", paint, kit.varied(paint, 0.3), WHITE)
    kit.sphere(kit.place(along, aside, 1.56)[0], 0.13, "plaster", (0.8, 0.6, 0.48), (0.7, 0.5, 0.4))


def with_movers(scene: Scene, count: int) -> Scene:
    """The scene with ``count`` movers in its training images. Raises ValueError if it has no road."""
    if scene.road is None:
        raise ValueError(f"Nothing moves in the scene {scene.name}: choose street, long-road or walk.")
    along = scene.road.locate(scene.cameras.camera_to_worlds[:, :2, 3])[0]
    return replace(scene, movers=partial(movers_at, scene.seed, scene.road, count, along, scene.name == "walk"))


def moving_mask(scene: Scene, camera: int) -> NDArray[np.uint8]:
    """Mask [H, W] of the pixels of which at least one of 3 x 3 rays meets a moving object, or its shadow; zeros
    elsewhere."""
    cameras, filmed = scene.cameras, scene.filmed_by(camera)
    mask = np.zeros(cameras.height * cameras.width, np.uint8)
    if filmed.movers is None or scene.movers is None:
        return mask.reshape(cameras.height, cameras.width)
    movers = Tracer(scene.movers(camera), scene.reach)
    order = tile_order(cameras.height, cameras.width)
    tangents = cameras.central_tangents[order]
    origins, directions = cameras.rays_at(camera, tangents)
    distance = filmed.hit(origins, directions)[0]
    solid = np.flatnonzero(np.isfinite(distance))
    points = origins[solid] + distance[solid, None] * directions[solid]
    sun = np.broadcast_to(np.array(scene.light.toward) / np.linalg.norm(scene.light.toward), points.shape)
    dark = solid[np.isfinite(movers(points, sun)[0])]
    rays, pixel = (origins[dark], directions[dark]), 1 / cameras.focal
    change = np.abs(scene.trace(*rays, pixel)[1] - filmed.trace(*rays, pixel)[1]).max(-1, initial=0)
    mask[order[dark[change > CHANGED]]] = SHADOW
    inner = (np.arange(3) + 0.5) / 3 - 0.5
    for shift in np.stack(np.meshgrid(inner, inner), -1).reshape(-1, 2):
        origins, directions = cameras.rays(camera, cameras.pixel_centers[order] + shift)
        near = np.flatnonzero(np.isfinite(movers(origins, directions)[0]))
        row = filmed.hit(origins[near], directions[near])[1]
        mask[order[near[filmed.moving[row] & (row >= 0)]]] = MOVER
    return mask.reshape(cameras.height, cameras.width)
