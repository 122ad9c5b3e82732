"""A corridor of textured planes, seen by a camera that drives through it: images whose poses are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mmpi_prepare.adjustment import similarity_between

WIDTH, HEIGHT, FOCAL = 240, 160, 170.0
EYE = 1.5
PLANES = (  # axis, place, the two other axes
    (0, -2.5, (1, 2)),
    (0, 2.5, (1, 2)),
    (2, 0.0, (0, 1)),
    (2, 4.0, (0, 1)),
    (1, 26.0, (0, 2)),
)


def noise(u, v, table, octaves):
    """Smooth random texture at (u, v), in [0, 1].

    Args:
        u, v: places on the surface.
        table: random numbers, a square for each octave, repeated without end. [octaves, n, n]
        octaves: (squares per unit, weight) of each.
    """
    total, size = 0.0, table.shape[-1]
    for t, (scale, weight) in zip(table, octaves, strict=True):
        i, j = np.floor(u * scale).astype(int), np.floor(v * scale).astype(int)
        a, b = u * scale - i, v * scale - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        parts = [
            t[(i + di) % size, (j + dj) % size] * (a if di else 1 - a) * (b if dj else 1 - b)
            for di in (0, 1)
            for dj in (0, 1)
        ]
        total = total + weight * sum(parts)
    return total


def poses(count, step=0.35, bend=0.01):
    """Camera to world, OpenCV axes, z up, metres: down the corridor, with a slight bend. [count, 4, 4]"""
    result = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(result):
        c, s = np.cos(bend * i), np.sin(bend * i)
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = (c, -s, 0), (0, 0, -1), (s, c, 0)
        pose[:3, 3] = (0.4 * np.sin(0.3 * i), step * i, EYE)
    return result


def picture(pose, seed=0):
    """Colour image. [HEIGHT, WIDTH, 3] uint8"""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(columns)], -1)
    rays = rays.reshape(-1, 3) @ pose[:3, :3].T
    nearest, image = np.full(len(rays), np.inf), np.zeros((len(rays), 3))
    for number, (axis, place, others) in enumerate(PLANES):
        table = np.random.default_rng([seed, number]).random((3, 97, 97))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (place - pose[axis, 3]) / rays[:, axis]
        hit = (distance > 0) & (distance < nearest)
        points = pose[:3, 3] + distance[hit, None] * rays[hit]
        gray = noise(points[:, others[0]], points[:, others[1]], table, ((1.2, 0.35), (4.0, 0.35), (11.0, 0.3)))
        image[hit] = np.clip(gray[:, None] * np.array([[1.0, 0.95, 0.8], [0.8, 1.0, 0.9]])[number % 2], 0, 1)
        nearest[hit] = distance[hit]
    return (image.reshape(HEIGHT, WIDTH, 3) * 255).round().astype(np.uint8)


def write_images(folder: Path, count=14, seed=0, start=0, bend=0.01):
    """Writes frames frame_001.png and so on; returns their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    chosen = poses(start + count, bend=bend)[start:]
    for i, pose in enumerate(chosen):
        Image.fromarray(picture(pose, seed)).save(folder / f"frame_{start + i + 1:03d}.png")
    return chosen


def error_of(names, actual, count):
    """Largest distance of the centres of poses [N, 4, 4] from the true ones of ``count`` frames, as a share of the
    track."""
    given = poses(count)[[int(Path(name).stem[-3:]) - 1 for name in names]]
    moved = similarity_between(actual, given)
    off = [np.linalg.norm(moved * p - q) for p, q in zip(actual[:, :3, 3], given[:, :3, 3], strict=True)]
    return max(off) / np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=-1).sum()


def depth(pose):
    """Metres along the optical axis. [HEIGHT, WIDTH]"""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(columns)], -1)
    rays = rays @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        distances = np.stack([(place - pose[axis, 3]) / rays[..., axis] for axis, place, _ in PLANES])
    return np.where(distances > 0, distances, np.inf).min(0)
