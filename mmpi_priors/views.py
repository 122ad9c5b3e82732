"""Images as their cameras see them: undistorted views, projection of points, and pixels at any place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.utils.errors import InputError
from mmpi_priors.ops.matches import place_pixels

Map = NDArray[np.float32]

REMAP_SIDE, REMAP_PART = 32766, 8192
"""Largest side of an image for OpenCV's remap, and side of rows into which longer lists of places are folded."""
STRIP = 2**16
"""Pixels processed at once: their values stay in a core's cache."""


@dataclass(frozen=True)
class View:
    """An image as a pinhole camera sees it, at working size."""

    gray: NDArray[np.uint8]
    """[h, w]"""
    pinhole: NDArray[np.float64]
    """fx, fy, cx, cy, working pixels."""
    pose: NDArray[np.float64]
    """[3, 4] camera to world, OpenGL axes."""
    inside: NDArray[np.bool_]
    """[h, w] mask of the pixels that the lens sees."""
    _reduced: dict[float, View] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Results of ``reduced``, cached: all neighbours of an image ask for the same sizes."""

    def reduced(self, factor: float) -> View:
        """The view at one over ``factor`` of its size."""
        if factor == 1:
            return self
        if (before := self._reduced.get(factor)) is not None:
            return before
        height, width = self.gray.shape
        size = max(1, round(width / factor)), max(1, round(height / factor))
        pinhole = self.pinhole * np.tile([size[0] / width, size[1] / height], 2)
        gray = cv2.resize(self.gray, size, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(self.inside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        smaller = replace(self, gray=np.asarray(gray, np.uint8), pinhole=pinhole, inside=inside > 0)
        return self._reduced.setdefault(factor, smaller)


def load_view(images: PosedImages, i: int, side: int) -> View:
    """Image i in gray, undistorted, its longer side at most ``side`` pixels."""
    gray = _read(images.files[i], cv2.IMREAD_GRAYSCALE)
    full_height, full_width = gray.shape
    if max(gray.shape) > side:
        width, height = (max(1, round(n * side / max(gray.shape))) for n in (full_width, full_height))
        gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    scale = np.array([gray.shape[1] / full_width, gray.shape[0] / full_height])
    pinhole = images.intrinsics[i] * np.tile(scale, 2)
    inside = np.broadcast_to(True, gray.shape)  # of no size
    if images.is_bent(i):
        size = gray.shape[1], gray.shape[0]
        x, y = _bent_places(images.is_fisheye(i), tuple(images.lens(i)), tuple(pinhole), size)
        gray = cv2.remap(gray, x, y, cv2.INTER_LINEAR)
        inside = (x >= 0) & (x <= size[0] - 1) & (y >= 0) & (y <= size[1] - 1)
    return View(np.ascontiguousarray(gray, np.uint8), pinhole, images.camera_to_worlds[i], inside)


def _read(file: Path, mode: int) -> NDArray[Any]:
    pixels = cv2.imread(str(file), mode | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise InputError(f"Image {file} cannot be read (by OpenCV): repair it or leave it out.")
    return pixels


@lru_cache(maxsize=2)
def _bent_places(
    fisheye: bool, distortion: tuple[float, ...], pinhole: tuple[float, ...], size: tuple[int, int]
) -> tuple[Map, Map]:
    """Places in an image (width, height) of the pixels of its undistorted view; OpenCV counts from centres."""
    matrix = camera_matrix(np.array(pinhole))
    straighten = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    matrix[:2, 2] -= 0.5
    x, y = straighten(matrix, np.array(distortion), np.eye(3), matrix, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def straightened_color(images: PosedImages, i: int, view: View) -> NDArray[np.uint8]:
    """Blue, green and red of image i, undistorted as its view. [h, w, 3]"""
    size = view.gray.shape[1], view.gray.shape[0]
    color = cv2.resize(_read(images.files[i], cv2.IMREAD_COLOR), size, interpolation=cv2.INTER_AREA)
    if images.is_bent(i):
        places = _bent_places(images.is_fisheye(i), tuple(images.lens(i)), tuple(view.pinhole), size)
        color = cv2.remap(color, *places, cv2.INTER_LINEAR)
    return np.asarray(color, np.uint8)


def straightened(images: PosedImages, i: int, shape: tuple[int, int], some: slice | None = None) -> NDArray[np.float64]:
    """Tangents (right, down) of the rays of an image's pixels at this shape, without lens distortion; of some rows. [2,
    H, W]"""
    lens = tuple(images.lens(i)) if images.is_bent(i) else ()
    camera = tuple(images.sizes[i]), tuple(images.intrinsics[i]), lens, images.is_fisheye(i)
    rows = [some] if some else strips(shape)
    parts = [_straightened_rows(*camera, shape, part.start, part.stop) for part in rows]
    return parts[0] if some else np.concatenate(parts, 1)


@lru_cache(maxsize=32)
def _straightened_rows(
    size: tuple[float, float], pinhole: tuple[float, ...], lens: tuple[float, ...], fisheye: bool,
    shape: tuple[int, int], first: int, last: int,
) -> NDArray[np.float64]:  # fmt: skip
    """The same of a strip of rows: cameras of one lens share them."""
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(first, last) + 0.5)
    at = np.stack([columns * size[0] / shape[1], rows * size[1] / shape[0]], -1).reshape(-1, 1, 2)
    fx, fy, cx, cy = pinhole
    if lens:
        straighten = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
        tangents = straighten(at, camera_matrix(np.array(pinhole)), np.array(lens))
    else:
        tangents = (at - [cx, cy]) / [fx, fy]
    return np.ascontiguousarray(np.moveaxis(tangents.reshape(*columns.shape, 2), -1, 0), np.float64)


def strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Rows of an image of this shape, in parts of about ``STRIP`` pixels."""
    rows = max(1, STRIP // shape[-1])
    return (slice(first, min(first + rows, shape[-2])) for first in range(0, shape[-2], rows))


def camera_matrix(pinhole: NDArray[np.float64]) -> NDArray[np.float64]:
    fx, fy, cx, cy = pinhole
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@dataclass(frozen=True)
class Parallax:
    """Positions of a view's pixels in a neighbouring view: homogeneous pixels a + q b for inverse depth q."""

    linear: NDArray[np.float64]
    """a at a pixel (x, y) is this times (x, y, 1). [3, 3]"""
    b: NDArray[np.float32]
    tensors: tuple[Tensor, Tensor]
    """Both as compiled operations read them."""

    @staticmethod
    def between(view: View, neighbour: View) -> Parallax:
        axes = np.diag([1.0, -1.0, -1.0])  # OpenCV's: right, down, ahead
        turn = axes @ neighbour.pose[:, :3].T @ view.pose[:, :3] @ axes
        shift = axes @ neighbour.pose[:, :3].T @ (view.pose[:, 3] - neighbour.pose[:, 3])
        to_pixels = camera_matrix(neighbour.pinhole)
        linear = to_pixels @ turn @ np.linalg.inv(camera_matrix(view.pinhole))
        b = (to_pixels @ shift).astype(np.float32)
        return Parallax(linear, b, (torch.from_numpy(linear).float(), torch.from_numpy(b)))

    def pixels(self, inverse: Map) -> tuple[Map, Map, Map]:
        """Pixels x and y of points at these inverse depths, far outside if behind, and their depths over those here."""
        x, y, ahead = place_pixels(torch.from_numpy(inverse), *self.tensors)
        return x.numpy(), y.numpy(), ahead.numpy()


def project(posed: PosedImages, j: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels [P, 2] of points [P, 3] in a camera, lens included; far outside for points behind it or so far to the side
    that the lens's polynomial turns back."""
    pose, fisheye, lens = posed.camera_to_worlds[j], posed.is_fisheye(j), posed.lens(j)
    x, y, depth = ((points - pose[:, 3]) @ pose[:, :3] * [1, -1, -1]).T  # OpenCV's axes: right, down, ahead
    ahead, aside = depth > 0, np.hypot(x, y)
    depth = np.where(ahead, depth, 1)
    radius = np.arctan2(aside, depth) if fisheye else aside / depth
    # Powers of the squared radius; the radius from which the lens turns back is where their sum's slope has its root.
    powers = np.array([1.0, *(lens if fisheye else (*lens[:2], *lens[4:]))])
    slope = powers * (2 * np.arange(len(powers)) + 1)
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(slope, "b"))
    squares = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    ahead &= radius < np.sqrt(squares.min(initial=np.inf))
    with np.errstate(over="ignore", invalid="ignore"):  # of points that are not shown
        squared = radius * radius
        bent = np.polynomial.polynomial.polyval(squared, powers)
        if fisheye:
            bent *= radius / np.maximum(aside, 1e-300)
            x, y = x * bent, y * bent
        else:
            x, y, (p1, p2) = x / depth, y / depth, lens[2:4]
            across = 2 * x * y
            x, y = (
                x * bent + p1 * across + p2 * (squared + 2 * x * x),
                y * bent + p2 * across + p1 * (squared + 2 * y * y),
            )
        fx, fy, cx, cy = posed.intrinsics[j]
        at = np.stack([fx * x + cx, fy * y + cy], -1)
    return np.where(ahead[:, None], at, -1e4)


def pixel_grid(shape: tuple[int, ...]) -> tuple[Map, Map]:
    """Coordinates x and y of pixel centres. [h, w] each"""
    x, y = np.meshgrid(np.arange(shape[1], dtype=np.float32) + 0.5, np.arange(shape[0], dtype=np.float32) + 0.5)
    return x, y


def look_up(image: NDArray[Any], x: NDArray[Any], y: NDArray[Any], *, nearest: bool = False) -> NDArray[Any]:
    """Values of an image at pixel positions, centres at halves: interpolated, or the nearest pixel's and 0 outside.

    The image is [H, W] or [H, W, C]; the places have any one shape, which the values have, too.
    """
    if not x.size:
        return np.zeros((*x.shape, *image.shape[2:]), image.dtype)
    # OpenCV counts rows and columns in 16 bits: places are folded into rows.
    at: Any = [np.subtract(c, 0.5, dtype=np.float32) for c in (x, y)]
    if x.ndim != 2 or max(x.shape) > REMAP_SIDE:
        width = x.size if x.size <= REMAP_SIDE else REMAP_PART
        rows = np.zeros((2, -(-x.size // width), width), np.float32)
        rows.reshape(2, -1)[:, : x.size] = [c.reshape(-1) for c in at]
        at = rows
    mode = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    values = np.asarray(cv2.remap(image, at[0], at[1], mode, borderMode=border, borderValue=(0.0,)))
    return values.reshape(-1, *image.shape[2:])[: x.size].reshape(*x.shape, *image.shape[2:])
