"""A reader of baked scenes in plain NumPy: the format and its rendering (docs/export.md) in two hundred lines.

    python mmpi_show/reader.py FOLDER NUMBER image.npy      # camera NUMBER of the path: the field of the first window

Float64, every plane of every MPI, without other code of this package: an example for other viewers, the reference of
the tests, and the form that runs where there is no compiler.
"""

from __future__ import annotations

import gzip
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Window = dict[str, Any]
"""Header of a window, with its arrays: columns_array [N, 2], density_array [B, 64], texels_array [B, 64, C]."""
CORNERS = np.array([0, 1, 8, 9])
"""Texels of a cell, counted from its first one through a brick of 8 x 8."""


class Samples(NamedTuple):
    """Samples of R rays on S planes, nearest first; weight 0 in empty bricks and where the ray is terminated."""

    inverse_t: np.ndarray  # [R, S] 1 / distance
    weights: np.ndarray  # [R, S]
    mpis: np.ndarray  # [R, S]
    texels: np.ndarray  # [R, S, 4] that a sample reads, counted through all bricks
    shares: np.ndarray  # [R, S, 4] of these
    transmittance: np.ndarray  # [R, 1] behind the last sample


def read(folder: Path) -> dict[str, Any]:
    """The header, with each window's arrays decoded."""
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    assert scene["format"] == "mmpi-baked" and scene["version"] == 5
    for window in scene["windows"]:
        blob = (folder / window["file"]).read_bytes()
        for name, a in window["arrays"].items():
            data = gzip.decompress(blob[a["offset"] : a["offset"] + a["bytes"]])
            window[name + "_array"] = np.frombuffer(data, a["type"]).reshape(a["shape"])
        codes = decode(window)
        window["density_array"], window["texels_array"] = codes[0], np.moveaxis(codes[1:], 0, -1)
    return scene


def decode(window: Window) -> np.ndarray:
    """Codes [channels, B, 64] of the density and the other channels; fills in the numbers of bricks in the columns."""
    bits, early = (window[name][:, None] >> np.arange(32) & 1 for name in ("columns_array", "early_columns_array"))
    counts, early = bits.sum(1), early[bits > 0] > 0
    window["columns_array"] = np.stack([window["columns_array"], counts.cumsum() - counts], 1)
    codes = np.zeros((len(window["fine_array"]), len(early), 8, 8), np.uint8)
    for name, which in (("early_array", early), ("late_array", ~early)):  # every second row and column
        part = np.moveaxis(window[name], 1, -1).reshape(len(codes), -1, 4, 4).copy()
        part[:, :, 0, 0] = np.cumsum(part[:, :, 0, 0], axis=1, dtype=np.uint8)
        codes[:, which, ::2, ::2] = part.cumsum(-1, dtype=np.uint8).cumsum(-2, dtype=np.uint8)
    is_fine = (np.arange(64) % 16 >= 8) | (np.arange(64) % 2 > 0)
    codes.reshape(*codes.shape[:2], 64)[..., is_fine] = np.moveaxis(window["fine_array"], 1, -1)
    after = [1, 2, 3, 3]  # the last row and column have nothing behind them
    even = codes[:, :, ::2, ::2].astype(np.uint16)
    codes[:, :, ::2, 1::2] += ((even + even[..., after]) // 2).astype(np.uint8)
    even = codes[:, :, ::2].astype(np.uint16)
    codes[:, :, 1::2] += ((even + even[:, :, after]) // 2).astype(np.uint8)
    beside = neighbours(window["columns_array"], window["mpis"])
    for channel in codes:
        take_borders(channel, beside)
    return codes.reshape(*codes.shape[:2], 64)


def brick_numbers(columns: np.ndarray, mpis: list[dict[str, Any]]) -> Iterator[np.ndarray]:
    """Brick of every tile [planes, rows, columns] of each MPI, from the columns [N, 2] of all; -1 where it is empty."""
    first = 0
    for mpi in mpis:
        shape = -(-mpi["planes"] // 32), 1, -(-(mpi["height"] - 1) // 7), -(-(mpi["width"] - 1) // 7)
        columns_here = columns[first : first + math.prod(shape)].astype(np.int64)
        first += len(columns_here)
        bits, start = columns_here.T.reshape(2, *shape)
        stored = bits >> np.arange(32)[:, None, None] & 1
        numbers = np.where(stored, start + stored.cumsum(1) - stored, -1)
        yield numbers.reshape(-1, *shape[2:])[: mpi["planes"]]


def neighbours(columns: np.ndarray, mpis: list[dict[str, Any]]) -> np.ndarray:
    """The bricks to the right of each brick and below it [2, B], in its plane; -1 if there is none."""
    numbers = list(brick_numbers(columns, mpis))
    bricks = np.full((2, sum(int((n >= 0).sum()) for n in numbers)), -1)
    for here in numbers:
        beside = np.pad(here, ((0, 0), (0, 1), (0, 1)), constant_values=-1)
        bricks[:, here[here >= 0]] = np.stack([beside[:, :-1, 1:], beside[:, 1:, :-1]])[:, here >= 0]
    return bricks


def take_borders(codes: np.ndarray, beside: np.ndarray) -> None:
    """The last column and row of a brick [B, 8, 8, ...] become the first ones of its neighbours, if there are any."""
    right, below = beside
    has_right, has_below, alone = right >= 0, below >= 0, (right >= 0) & (below < 0)
    codes[has_right, :7, 7] = codes[right[has_right], :7, 0]
    codes[has_below, 7] = codes[below[has_below], 0]
    codes[alone, 7, 7] = codes[right[alone], 7, 0]


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


def _cross(window: Window, mpi: dict[str, Any], numbers: np.ndarray, rays: tuple[Any, ...]) -> tuple[np.ndarray, ...]:
    """1 / distance and optical depth [R, P], texels and their shares [R, P, 4] where rays intersect an MPI's planes."""
    (origins, directions, near, far), axes = rays, np.array(mpi["axes"])
    (ox, oy, oz), (dx, dy, dz) = (
        np.moveaxis((axes * x[:, None, :]).sum(-1), 1, 0)[..., None] for x in (origins - mpi["origin"], directions)
    )
    steps, down, across = (mpi[name] - 1 for name in ("planes", "height", "width"))
    last = 0.0 if mpi["far"] is None else 1 / mpi["far"]
    planes = np.arange(mpi["planes"])  # evenly spaced in disparity w from 1 / near to 1 / far
    w = last + (1 / mpi["near"] - last) * (1 - planes / steps)
    ahead = (dz > 1e-6) & (w * oz < 1)  # not parallel to the planes, and this one lies ahead
    dz = np.where(dz > 1e-6, dz, 1.0)
    inverse_t = w * dz / np.where(ahead, 1 - w * oz, 1.0)
    u0, u1, v0, v1 = mpi["extent"]
    x = ((ox - oz * dx / dz) * w + dx / dz - u0) / (u1 - u0) * across
    y = ((oy - oz * dy / dz) * w + dy / dz - v0) / (v1 - v0) * down
    intersected = (
        ahead & (inverse_t * near <= 1) & (inverse_t >= 1 / far) & (x >= 0) & (x <= across) & (y >= 0) & (y <= down)
    )
    x, y = np.where(intersected, x, 0), np.where(intersected, y, 0)
    column, row = (np.minimum(a.astype(int), n - 1) // 7 for a, n in ((x, across), (y, down)))
    brick = np.where(intersected, numbers[planes, row, column], -1)
    x, y = x - 7 * column, y - 7 * row
    i, j = np.minimum(y.astype(int), 6), np.minimum(x.astype(int), 6)
    texels = (np.maximum(brick, 0) * 64 + i * 8 + j)[..., None] + CORNERS
    fx, fy = x - j, y - i
    shares = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    if not window["density_array"].size:
        return 0 * inverse_t, 0 * inverse_t, texels, shares
    codes = (window["density_array"].reshape(-1)[texels] * shares).sum(-1)
    raw = window["density"]["low"] + window["density"]["step"] * codes
    tau = np.where(brick >= 0, np.logaddexp(0, raw) * mpi["interval"], 0)
    return np.where(brick >= 0, inverse_t, 0), tau, texels, shares


def march(
    window: Window, origins: np.ndarray, directions: np.ndarray, near: np.ndarray | None = None, far: Any = np.inf
) -> Samples:
    """The samples of rays [R, 3] between distances near (the window's, if None) and far [R, 1]."""
    rays = (origins, directions, np.array(window["ray_near"]) if near is None else near, np.array(far))
    numbers = brick_numbers(window["columns_array"], window["mpis"])
    parts = [_cross(window, *mpi, rays) for mpi in zip(window["mpis"], numbers, strict=True)]
    inverse_t, tau, texels, shares = (np.concatenate(x, 1) for x in zip(*parts, strict=True))
    order = np.argsort(-inverse_t, axis=1, kind="stable")
    mpis = np.repeat(np.arange(len(parts)), [part[0].shape[1] for part in parts])[order]
    inverse_t, tau = (np.take_along_axis(x, order, 1) for x in (inverse_t, tau))
    texels, shares = (np.take_along_axis(x, order[..., None], 1) for x in (texels, shares))
    after = np.exp(-tau.cumsum(1))
    before = np.concatenate([np.ones_like(after[:, :1]), after[:, :-1]], 1)
    weights = np.where(before > 1e-2, before * -np.expm1(-tau), 0.0)  # a ray is terminated below this transmittance
    return Samples(inverse_t, weights, mpis, texels, shares, after[:, -1:])


def gather(window: Window, samples: Samples, kept: np.ndarray) -> np.ndarray:
    """Sums [R, C] of weight times colour (three sigmoids) and features (hyperbolic tangents) of samples kept [R, S]."""
    low, step = (np.array([c[name] for c in window["channels"]]) for name in ("low", "step"))
    codes = window["texels_array"].reshape(-1, len(low))[samples.texels[kept]]
    raw = low + step * (codes * samples.shares[kept][..., None]).sum(1)
    values = np.concatenate([0.5 + 0.5 * np.tanh(0.5 * raw[:, :3]), np.tanh(raw[:, 3:])], 1)
    sums = np.zeros((len(kept), len(low)))
    np.add.at(sums, kept.nonzero()[0], samples.weights[kept][:, None] * values)
    return sums


def shade(window: Window, mean: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours [R, 3] of rays from their mean colour and features [R, C], by the network."""
    octaves = np.pi * 2.0 ** np.arange(window["shader"]["direction_octaves"])
    angles = (octaves[:, None] * directions[:, None]).reshape(len(directions), -1)
    x, at, numbers = np.concatenate([mean, directions, np.sin(angles), np.cos(angles)], 1), 0, window["network_array"]
    for i, (outputs, inputs) in enumerate(window["shader"]["layers"]):
        weights, biases = np.split(numbers[at : at + outputs * (inputs + 1)].astype(float), [outputs * inputs])
        x = (np.maximum(x, 0) if i else x) @ weights.reshape(outputs, inputs).T + biases
        at += outputs * (inputs + 1)
    bound, color = window["shader"]["bound"], mean[:, :3]
    return color / (color + (1 - color) * np.exp(-bound * np.tanh(x / bound)))


def render(window: Window, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours [R, 3] of rays by one window."""
    samples = march(window, origins, directions)
    kept = samples.weights > window["threshold"]
    mass = (samples.weights * kept).sum(1, keepdims=True)
    color = shade(window, gather(window, samples, kept) / np.maximum(mass, 1e-6), directions)
    color = np.where(mass > 0, color * window.get("exposure", 1.0), 0.0)
    transmittance = np.where(samples.transmittance > 1e-2, samples.transmittance, 0.0)
    return np.clip(color * (1 - transmittance) + transmittance * window["background"], 0, 1)


if __name__ == "__main__":
    scene = read(Path(sys.argv[1]))
    camera = scene["path"][int(sys.argv[2])]
    rays = camera_rays(camera)
    parts = [render(scene["windows"][0], *(x[i : i + 1024] for x in rays)) for i in range(0, len(rays[0]), 1024)]
    np.save(sys.argv[3], np.concatenate(parts).reshape(camera["size"][1], camera["size"][0], 3))
