"""Skies at infinity and the ground plane."""

from __future__ import annotations

import numpy as np

from mmpi_scene.materials import Noise, band, mix, pulse, rgb
from mmpi_scene.primitives import Array
from mmpi_scene.road import Road
from mmpi_scene.scene import Colors

GRASS = rgb(0.33, 0.42, 0.17), rgb(0.47, 0.5, 0.25)


def open_sky(directions: Array, pixel: float, noise: Noise) -> Colors:
    """Blue with clouds over three ridges of hills, all at infinity."""
    d = directions.astype(np.float32)
    up, azimuth = np.arcsin(d[:, 2].clip(-1, 1)), np.arctan2(d[:, 1], d[:, 0]) / np.float32(2 * np.pi)
    width = np.full_like(up, pixel)
    share = np.clip(up / 0.6, 0, 1)[:, None] ** 0.6
    color = (1 - share) * rgb(0.88, 0.92, 0.95) + share * rgb(0.38, 0.6, 0.9)
    # Clouds lie in a plane overhead: toward the horizon they crowd, and are averaged over wider footprints.
    lift = np.maximum(d[:, 2], 0) + 0.12
    clouds = noise(d[:, 0] / lift * 3, d[:, 1] / lift * 3, width * 3 / lift**2)
    color = mix(color, np.full_like(color, 0.98), np.clip(0.2 + 0.9 * clouds, 0, 0.9) * np.clip(up * 8, 0, 1))
    far, near = rgb(0.6, 0.68, 0.76), rgb(0.33, 0.43, 0.27)
    for k, base in enumerate((0.1, 0.065, 0.03)):
        # The ridge is periodic in azimuth, so that there is no seam.
        ridge = base * (1 + 0.5 * noise(azimuth * 32, np.full_like(up, 3.7 * k), width * 5))
        ridge = ridge + 0.004 * (k + 1) * noise(azimuth * 160, np.full_like(up, 5.1 * k), width * 25)
        texture = noise(azimuth * 96, up * 15 + k, width * 15)
        hill = (far + (near - far) * (k / 2)) * (1 + 0.2 * texture)[:, None]
        color = mix(color, hill, np.clip((ridge - up) / max(pixel, 1e-3) + 0.5, 0, 1))
    return color


def meadow(places: Array, directions: Array, width: Array, noise: Noise) -> Colors:
    """Grass."""
    x, y = places.T.astype(np.float32)
    blurred = (width * 2 / np.sqrt(np.maximum(-directions[:, 2], 0.01))).astype(np.float32)
    shade = 0.5 + 0.6 * noise(x, y, blurred) + 0.6 * noise(x * 0.13, y * 0.13, blurred * 0.13)
    return mix(GRASS[0], GRASS[1], shade)


def street_ground(road: Road, places: Array, directions: Array, width: Array, noise: Noise) -> Colors:
    """Asphalt, markings, kerbs and paving along a road, grass beyond."""
    along, aside, heading = road.locate(places)
    s, d = along.astype(np.float32), aside.astype(np.float32)
    c, sn = np.cos(heading), np.sin(heading)
    down = np.maximum(-directions[:, 2], 0.01)
    ds = (width * np.hypot(1, (directions[:, 0] * c + directions[:, 1] * sn) / down)).astype(np.float32)
    dd = (width * np.hypot(1, (directions[:, 1] * c - directions[:, 0] * sn) / down)).astype(np.float32)
    blurred = np.maximum(np.sqrt(ds * dd), ds / 3)
    fine, coarse = noise(s, d, blurred), noise(s * 0.21, d * 0.21 + 5, blurred * 0.21)
    streaks = noise(s * 0.06, d * 1.3, np.maximum(blurred * 0.06, dd * 1.3))
    tone = 1 + 0.16 * fine + 0.14 * coarse + 0.13 * streaks
    color = rgb(0.36, 0.36, 0.38) * tone[:, None]
    side = np.abs(d)
    # Patches of newer tar and lids, so that the road has something to hold on to.
    patch = (noise(s * 0.05 + 3, np.sign(d) * 4, blurred * 0.05) > 0.45) * band(side, dd, 0.5, 2.6)
    color = mix(color, color * 0.72, patch)
    white = np.full_like(color, 0.92) * (1 + 0.1 * fine)[:, None]
    marks = pulse(s / 6, ds / 6, 0.0, 0.5) * band(d, dd, -0.08, 0.08) + band(
        side, dd, road.half_width - 0.4, road.half_width - 0.26
    )
    crossing = (
        pulse(s / 55, ds / 55, 0.32, 0.385)
        * pulse(d / 1.1, dd / 1.1, 0.2, 0.75)
        * band(side, dd, 0, road.half_width - 0.5)
    )
    color = mix(color, white, np.clip(marks + crossing, 0, 1) * np.clip(0.85 + 0.3 * coarse, 0, 1))
    bays = rgb(0.45, 0.44, 0.43) * tone[:, None]
    bays = mix(bays, white, pulse(s / 5.6, ds / 5.6, 0.0, 0.02))
    color = mix(color, bays, band(side, dd, road.half_width, road.kerb))
    slab = np.maximum(pulse(s / 0.8, ds / 0.8, 0.0, 0.045), pulse(side / 0.6, dd / 0.6, 0.0, 0.06))
    paving = rgb(0.66, 0.62, 0.57) * (1 + 0.2 * fine + 0.14 * coarse)[:, None]
    color = mix(color, mix(paving, paving * 0.55, slab), band(side, dd, road.kerb, road.pavement))
    stone = np.full_like(color, 0.78) * (1 + 0.15 * fine)[:, None]
    stone = mix(stone, stone * 0.6, pulse(s / 1.0, ds, 0.0, 0.03))
    color = mix(color, stone, band(side, dd, road.kerb, road.kerb + 0.22))
    grass = meadow(places, directions, width, noise)
    return mix(grass, color, band(side, dd, 0.0, road.pavement))


def floor_inside(size: tuple[float, float], places: Array, directions: Array, width: Array, noise: Noise) -> Colors:
    """Planks within a room of this width and depth, grass outside."""
    x, y = places.T.astype(np.float32)
    down = np.maximum(-directions[:, 2], 0.05)
    dx, dy = ((width * np.hypot(1, directions[:, k] / down)).astype(np.float32) for k in (0, 1))
    plank = y / 0.18
    shift = np.floor(plank) * 0.37
    grain = noise(x * 0.5 + shift * 7, y * 4, np.sqrt(dx * dy) * 2)
    tone = noise(np.floor(plank) * 2.3 + np.floor(x / 1.6 + shift) * 5.1, np.floor(plank) * 3.7, dy * 4)
    color = mix(rgb(0.5, 0.31, 0.17), rgb(0.74, 0.52, 0.32), 0.5 + 0.5 * grain + 0.5 * tone)
    seam = np.maximum(pulse(plank, dy / 0.18, 0.0, 0.06), pulse(x / 1.6 + shift, dx / 1.6, 0.0, 0.008))
    color = mix(color, color * 0.4, seam)
    inside = (np.abs(x) < size[0] / 2) & (np.abs(y) < size[1] / 2)
    return np.where(inside[:, None], color, meadow(places, directions, width, noise))
