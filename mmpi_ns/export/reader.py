"""A reader of baked scenes in plain NumPy: the format in a hundred lines, as a reference for other viewers.

    python -m mmpi_ns.export.reader FOLDER NUMBER image.npy      # renders camera NUMBER of the path, slowly

Written for readability, in float64, sharing no code with the rest: tests compare the renderer with it.
"""

from __future__ import annotations

import gzip
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def read(folder: Path) -> dict[str, Any]:
    """The header, with each window's arrays decoded in place of where they are in its file."""
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    assert scene["format"] == "mmpi-baked" and scene["version"] == 2
    for window in scene["windows"]:
        blob = (folder / window["file"]).read_bytes()
        for name, a in window["arrays"].items():
            data = gzip.decompress(blob[a["offset"] : a["offset"] + a["bytes"]])
            window[name + "_array"] = np.frombuffer(data, a["type"]).reshape(a["shape"])
        for name in ("density_array", "texels_array"):  # differences along rows and columns, and from brick to brick
            codes = window[name].reshape(-1, len(window["density_array"]), 8, 8).copy()
            codes[:, :, 0, 0] = np.cumsum(codes[:, :, 0, 0], axis=1, dtype=np.uint8)
            codes = codes.cumsum(-1, dtype=np.uint8).cumsum(-2, dtype=np.uint8)
            take_borders(window, codes)
            window[name] = codes.reshape(window[name].shape)
    return scene


def take_borders(window: dict[str, Any], codes: np.ndarray) -> None:
    """The last column and row of a brick are the first ones of its neighbours, if there are any."""
    bricks = []
    for mpi in window["mpis"]:
        rows, columns = -(-(mpi["height"] - 1) // 7), -(-(mpi["width"] - 1) // 7)
        for plane, row, column in np.ndindex(mpi["planes"], rows, columns):
            if (own := brick_of(window, mpi, plane, row, column)) >= 0:
                right = brick_of(window, mpi, plane, row, column + 1) if column + 1 < columns else -1
                below = brick_of(window, mpi, plane, row + 1, column) if row + 1 < rows else -1
                bricks.append((own, right, below))
    for own, right, _ in bricks:
        if right >= 0:
            codes[:, own, :7, 7] = codes[:, right, :7, 0]
    for own, _, below in bricks:
        if below >= 0:
            codes[:, own, 7] = codes[:, below, 0]
    for own, right, below in bricks:
        if right >= 0 > below:
            codes[:, own, 7, 7] = codes[:, right, 7, 0]


def camera_rays(pose: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [H W, 3] through the middles of a camera's pixels."""
    width, height = pose["size"]
    x = (np.arange(width) + 0.5 - pose["center"][0]) / pose["focal"][0]
    y = (np.arange(height) + 0.5 - pose["center"][1]) / pose["focal"][1]
    x, y = np.meshgrid(x, y)
    rays = np.stack([x, -y, -np.ones_like(x)], -1).reshape(-1, 3)
    to_world = np.array(pose["to_world"])
    directions = rays @ to_world[:, :3].T
    return np.broadcast_to(to_world[:, 3], directions.shape), directions / np.linalg.norm(directions, axis=-1)[:, None]


def brick_of(window: dict[str, Any], mpi: dict[str, Any], plane: int, row: int, column: int) -> int:
    """Number of the brick at a tile of a plane; -1 where nothing is stored."""
    down, across = -(-(mpi["height"] - 1) // 7), -(-(mpi["width"] - 1) // 7)
    index = mpi["first_column"] + (plane // 32 * down + row) * across + column
    bits, first = (int(x) for x in window["columns_array"][index])
    bit = plane % 32
    return first + bin(bits & ((1 << bit) - 1)).count("1") if bits >> bit & 1 else -1


def crossings(window: dict[str, Any], origin: np.ndarray, direction: np.ndarray) -> list[tuple]:
    """(1 / distance, optical depth, colour and features) where a ray crosses stored bricks, nearest first."""
    found = []
    for mpi in window["mpis"]:
        o, d = np.array(mpi["axes"]) @ (origin - mpi["origin"]), np.array(mpi["axes"]) @ direction
        u0, u1, v0, v1 = mpi["extent"]
        last = 0.0 if mpi["far"] is None else 1 / mpi["far"]
        for plane in range(mpi["planes"]):  # evenly spaced in disparity w from 1 / near to 1 / far
            w = last + (1 / mpi["near"] - last) * (1 - plane / (mpi["planes"] - 1))
            if d[2] <= 1e-6 or w * o[2] >= 1:
                continue  # it runs along the planes, or this plane lies behind
            inverse_t = w * d[2] / (1 - w * o[2])
            u, v = ((o[i] - o[2] * d[i] / d[2]) * w + d[i] / d[2] for i in (0, 1))
            x, y = (u - u0) / (u1 - u0) * (mpi["width"] - 1), (v - v0) / (v1 - v0) * (mpi["height"] - 1)
            if inverse_t * window["ray_near"] > 1 or not (0 <= x <= mpi["width"] - 1 and 0 <= y <= mpi["height"] - 1):
                continue
            column, row = min(int(x), mpi["width"] - 2) // 7, min(int(y), mpi["height"] - 2) // 7
            brick = brick_of(window, mpi, plane, row, column)
            if brick < 0:
                continue
            x, y = x - 7 * column, y - 7 * row
            i, j = min(int(y), 6), min(int(x), 6)
            corners = [i * 8 + j, i * 8 + j + 1, i * 8 + j + 8, i * 8 + j + 9]
            fx, fy = x - j, y - i
            weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
            raw = window["density"]["low"] + window["density"]["step"] * (
                window["density_array"][brick, corners] @ weights
            )
            tau = np.logaddexp(0, raw) * mpi["interval"]
            found.append((inverse_t, tau, activated(window, window["texels_array"][:, brick, corners] @ weights)))
    return sorted(found, key=lambda sample: -sample[0])


def activated(window: dict[str, Any], codes: np.ndarray) -> np.ndarray:
    """Colour (three sigmoids) and features (hyperbolic tangents) of a sample."""
    low, step = (np.array([c[name] for c in window["channels"]]) for name in ("low", "step"))
    raw = low + step * codes
    return np.concatenate([0.5 + 0.5 * np.tanh(0.5 * raw[:3]), np.tanh(raw[3:])])


def shade(window: dict[str, Any], mean: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The colour of a ray from its mean colour and features, by the network."""
    octaves = np.pi * 2.0 ** np.arange(window["shader"]["direction_octaves"])
    angles = (octaves[:, None] * direction).reshape(-1)
    x, at, numbers = np.concatenate([mean, direction, np.sin(angles), np.cos(angles)]), 0, window["network_array"]
    for i, (outputs, inputs) in enumerate(window["shader"]["layers"]):
        weights, biases = np.split(numbers[at : at + outputs * (inputs + 1)].astype(float), [outputs * inputs])
        x, at = weights.reshape(outputs, inputs) @ (np.maximum(x, 0) if i else x) + biases, at + outputs * (inputs + 1)
    bound, color = window["shader"]["bound"], mean[:3]
    return color / (color + (1 - color) * np.exp(-bound * np.tanh(x / bound)))


def render_ray(window: dict[str, Any], origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Renders a ray by one window."""
    light, mass, sums = 1.0, 0.0, np.zeros(len(window["channels"]))
    for _, tau, colors in crossings(window, origin, direction):
        weight = light * -np.expm1(-tau)
        if weight > window["threshold"]:
            sums, mass = sums + weight * colors, mass + weight
        light *= np.exp(-tau)
        if light < 1e-2:
            light = 0.0
            break
    if mass == 0:
        return np.full(3, light * window["background"])
    color = shade(window, sums / mass, direction) * window.get("exposure", 1.0)
    return np.clip(color * (1 - light) + light * window["background"], 0, 1)


if __name__ == "__main__":
    scene = read(Path(sys.argv[1]))
    camera = scene["path"][int(sys.argv[2])]
    rays = zip(*camera_rays(camera), strict=True)
    pixels = [render_ray(scene["windows"][0], o, d) for o, d in rays]
    np.save(sys.argv[3], np.reshape(pixels, (camera["size"][1], camera["size"][0], 3)))
