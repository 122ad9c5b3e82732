"""Depth of most pixels of the training images: dense matches between neighbouring views, each with its error.

Every image is compared with its nearest neighbours. A rough depth, interpolated from SfM points, warps the neighbour
into the image, so that the remaining displacement, found by DIS optical flow, is small whatever the motion was. A match
on its epipolar line gives an inverse depth; consistent matches of several neighbours are averaged. Further rounds start
from the depths of the previous one. All of it runs in OpenCV and NumPy at about twice the training size.

A point at inverse depth q lies at a + q b in the neighbour's axes, up to a factor. A match at a pixel there gives two
linear equations r + q s = 0, in pixels once divided by the point's depth: q is their least-squares solution, the
residual is the distance from the epipolar line, and |s| / depth is the parallax in pixels for each unit of q.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from mmpi_ns.capture.tracks import PosedImages
from mmpi_ns.utils.errors import InputError

Map = NDArray[np.float32]
Progress = Callable[[Iterable[int]], Iterable[int]]

NEIGHBOURS = 4
"""Neighbours that each image is compared with."""
MAX_ANGLE = 40.0
"""Degrees between the facing directions of images that are compared."""
ROUNDS = 3
"""Rounds of matching; each starts from the depths of the previous one."""
NOISE = 0.3
"""Standard deviation of a match, working pixels, where images look alike."""
MAX_EPIPOLAR = 1.0
"""Working pixels that a match may lie off its epipolar line."""
WINDOW = 7
"""Side of the window in which images are compared, working pixels."""
MIN_CORRELATION = 0.5
MIN_CONTRAST = 1.0
"""Standard deviation of gray levels in a window below which there is nothing to match."""
AGREE = 2.5
"""Matches agree if they differ by at most this many standard deviations."""
EDGE, STEP = 9, 1.1
"""An edge: inverse depths that differ by this factor within a window of this many pixels. Background there takes on the
motion of the foreground, because windows reach across."""
OWN_CONTRAST = 4.0
"""Standard deviation of gray levels in 3 x 3 pixels that a match near an edge needs."""
SAME_DEPTH = 0.03
"""The depths of a point in two images agree within this fraction plus three of their errors."""
MAX_RELATIVE = 0.15
"""Depths with a larger relative error are discarded."""
REMAP_SIDE, REMAP_PART = 32766, 8192
"""Largest side of what OpenCV's remap reads and writes, and side of the parts of anything larger."""
PRIOR_ERROR = 0.5
"""Relative error of the initial rough depths, against which measured ones are weighted."""


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
    """[h, w] where the lens shows something."""


@dataclass(frozen=True)
class Depth:
    """Inverse depth along the optical axis, and its expected error; both 0 where unknown. [h, w]"""

    inverse: Map
    error: Map


def load_view(images: PosedImages, i: int, width: int) -> View:
    """Image i in gray, at most ``width`` pixels wide, its lens distortion taken out."""
    gray = cv2.imread(str(images.files[i]), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if gray is None:
        raise InputError(f"Training image {images.files[i]} cannot be read: repair it or remove its frame.")
    full_height, full_width = gray.shape
    if full_width > width:
        height = max(1, round(full_height * width / full_width))
        gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    scale = np.array([gray.shape[1] / full_width, gray.shape[0] / full_height])
    pinhole = images.intrinsics[i] * np.tile(scale, 2)
    inside = np.broadcast_to(True, gray.shape)  # of no size
    if images.distortion[i].any():
        matrix, size = camera_matrix(pinhole), gray.shape[::-1]
        straighten = cv2.fisheye.initUndistortRectifyMap if images.is_fisheye(i) else cv2.initUndistortRectifyMap
        # OpenCV counts from pixel centres.
        matrix[:2, 2] -= 0.5
        x, y = straighten(matrix, images.distortion[i], np.eye(3), matrix, size, cv2.CV_32FC1)
        gray = cv2.remap(gray, x, y, cv2.INTER_LINEAR)
        inside = (x >= 0) & (x <= size[0] - 1) & (y >= 0) & (y <= size[1] - 1)
    return View(np.ascontiguousarray(gray, np.uint8), pinhole, images.camera_to_worlds[i], inside)


def camera_matrix(pinhole: NDArray[np.float64]) -> NDArray[np.float64]:
    fx, fy, cx, cy = pinhole
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def project(posed: PosedImages, j: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels [P, 2] at which a camera shows points [P, 3], lens included; far outside where they are behind it."""
    pose = posed.camera_to_worlds[j]
    local = (points - pose[:, 3]) @ pose[:, :3] * [1, -1, -1]  # OpenCV's axes: right, down, ahead
    ahead = local[:, 2] > 0
    local = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])[:, None]
    matrix, still = camera_matrix(posed.intrinsics[j]), np.zeros(3)
    bend = cv2.fisheye.projectPoints if posed.is_fisheye(j) else cv2.projectPoints
    at = bend(local, still, still, matrix, posed.distortion[j])[0].reshape(-1, 2)
    return np.where(ahead[:, None], at, -1e4)


def pixel_grid(shape: tuple[int, ...]) -> tuple[Map, Map]:
    """x and y of pixel centres. [h, w] each"""
    x, y = np.meshgrid(np.arange(shape[1], dtype=np.float32) + 0.5, np.arange(shape[0], dtype=np.float32) + 0.5)
    return x, y


def look_up(image: NDArray[Any], x: NDArray[Any], y: NDArray[Any], *, nearest: bool = False) -> NDArray[Any]:
    """Values of an image at pixel places, centres at halves: interpolated, or the nearest pixel's and 0 outside.

    Args:
        image: [H, W] or [H, W, C], of any size.
        x, y: places, of any one shape and number.
        nearest: take the nearest pixel.

    Returns:
        The shape of ``x``, and channels where there are several.
    """
    at_x, at_y = x.astype(np.float32) - 0.5, y.astype(np.float32) - 0.5
    mode = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    if at_x.ndim == 2 and max(*image.shape[:2], *at_x.shape) <= REMAP_SIDE:
        return np.asarray(cv2.remap(image, at_x, at_y, mode, borderMode=border, borderValue=(0.0,)))
    # OpenCV counts rows and columns in 16 bits: places are folded into rows, and large images are read in parts.
    flat_x, flat_y = at_x.reshape(-1), at_y.reshape(-1)
    values = np.zeros((len(flat_x), *image.shape[2:]), image.dtype)
    part = [
        np.clip(c // REMAP_PART, 0, (n - 1) // REMAP_PART).astype(int)
        for c, n in ((flat_y, image.shape[0]), (flat_x, image.shape[1]))
    ]
    parts = part[0] * (image.shape[1] // REMAP_PART + 1) + part[1]
    for number in np.unique(parts):
        inside = np.nonzero(parts == number)[0]
        top, left = REMAP_PART * part[0][inside[0]], REMAP_PART * part[1][inside[0]]
        view = image[top : top + REMAP_PART + 1, left : left + REMAP_PART + 1]  # one more, to interpolate with
        for begin in range(0, len(inside), REMAP_PART**2):
            chosen = inside[begin : begin + REMAP_PART**2]
            rows = np.zeros((2, -(-len(chosen) // REMAP_PART), REMAP_PART), np.float32)
            rows.reshape(2, -1)[:, : len(chosen)] = flat_x[chosen] - left, flat_y[chosen] - top
            found = cv2.remap(view, rows[0], rows[1], mode, borderMode=border, borderValue=(0.0,))
            values[chosen] = found.reshape(-1, *image.shape[2:])[: len(chosen)]
    return values.reshape(*x.shape, *image.shape[2:])


def rough_inverse_depth(view: View, points: NDArray[np.float64], step: int = 8) -> Map:
    """Inverse depth of every pixel [h, w], interpolated between SfM points [P, 3] that the image saw."""
    height, width = view.gray.shape
    local = (points - view.pose[:, 3]) @ view.pose[:, :3]
    local = local[local[:, 2] < 0]
    inverse = -1 / local[:, 2]
    fx, fy, cx, cy = view.pinhole
    at = np.stack([fx * local[:, 0] * inverse + cx, cy - fy * local[:, 1] * inverse], -1)
    at, first = np.unique(at.round(2), axis=0, return_index=True)
    inverse = inverse[first]
    if len(at) < 4 or np.linalg.matrix_rank(at - at.mean(0), tol=1.0) < 2:
        middle = float(np.median(inverse)) if len(inverse) else 0.0
        return np.full((height, width), middle, np.float32)
    x, y = np.meshgrid(np.arange(0, width + step, step), np.arange(0, height + step, step))
    between, nearest = LinearNDInterpolator(at, inverse)(x, y), NearestNDInterpolator(at, inverse)(x, y)
    coarse = np.where(np.isfinite(between), between, nearest).astype(np.float32)
    grid_x, grid_y = pixel_grid((height, width))
    return look_up(coarse, grid_x / step + 0.5, grid_y / step + 0.5)


def _flow() -> cv2.DISOpticalFlow:
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow.setFinestScale(0)
    flow.setVariationalRefinementIterations(0)
    return flow


@dataclass(frozen=True)
class _Parallax:
    """Where the points of a view's pixels lie in another view: a + q b for inverse depth q, in its axes."""

    a: Map
    b: NDArray[np.float32]
    pinhole: NDArray[np.float32]

    @staticmethod
    def between(view: View, other: View) -> _Parallax:
        x, y = pixel_grid(view.gray.shape)
        fx, fy, cx, cy = view.pinhole
        directions = np.stack([(x - cx) / fx, (cy - y) / fy, np.full_like(x, -1)], -1)
        turn = other.pose[:, :3].T @ view.pose[:, :3]
        shift = other.pose[:, :3].T @ (view.pose[:, 3] - other.pose[:, 3])
        a = directions.astype(np.float32) @ turn.T.astype(np.float32)
        return _Parallax(a, shift.astype(np.float32), other.pinhole.astype(np.float32))

    def pixels(self, inverse: Map) -> tuple[Map, Map]:
        """Pixels at which the points lie at these inverse depths; far outside where they are behind."""
        x, y, z = (self.a[..., n] + inverse * self.b[n] for n in range(3))
        fx, fy, cx, cy = self.pinhole
        ahead = z < -1e-6
        z = np.where(ahead, -z, 1)
        return np.where(ahead, fx * x / z + cx, -1e4), np.where(ahead, cy - fy * y / z, -1e4)

    def solve(self, x: Map, y: Map) -> tuple[Map, Map, Map]:
        """Inverse depth of matches at pixels (x, y), their distance from the epipolar line, and the parallax."""
        fx, fy, cx, cy = self.pinhole
        u, v = (x - cx) / fx, (cy - y) / fy
        r1, s1 = (self.a[..., 0] + u * self.a[..., 2]) * fx, (self.b[0] + u * self.b[2]) * fx
        r2, s2 = (self.a[..., 1] + v * self.a[..., 2]) * fy, (self.b[1] + v * self.b[2]) * fy
        inverse = -(r1 * s1 + r2 * s2) / np.maximum(s1 * s1 + s2 * s2, 1e-20)
        depth = -(self.a[..., 2] + inverse * self.b[2])
        depth = np.where(depth > 1e-6, depth, np.nan)
        return inverse, np.hypot(r1 + inverse * s1, r2 + inverse * s2) / depth, np.hypot(s1, s2) / depth


def measure(view: View, other: View, start: Map, flow: cv2.DISOpticalFlow) -> tuple[Map, Map]:
    """Inverse depths of a view's pixels by comparison with another view, and one over their squared errors (0: none).

    Args:
        view: the image whose depths are wanted.
        other: the image that it is compared with.
        start: rough inverse depths. [h, w]
        flow: finds small motions.
    """
    parallax = _Parallax.between(view, other)
    x, y = (p.astype(np.float32) for p in parallax.pixels(start))
    motion = np.asarray(flow.calc(view.gray, look_up(other.gray, x, y), None))  # type: ignore[call-overload]
    grid_x, grid_y = pixel_grid(view.gray.shape)
    moved = grid_x + motion[..., 0], grid_y + motion[..., 1]
    x, y = look_up(x, *moved), look_up(y, *moved)
    found = look_up(other.gray, x, y)
    seen = look_up(other.inside.astype(np.uint8), x, y, nearest=True) > 0
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        inverse, off_line, per_inverse = parallax.solve(x, y)
        alike, contrast = correlation(view.gray, found)
        variance = (NOISE**2 + off_line**2) * (1 + 10 * (1 - alike.clip(0, 1))) / per_inverse**2
        good = view.inside & seen & (off_line < MAX_EPIPOLAR) & (alike > MIN_CORRELATION) & (contrast > MIN_CONTRAST)
        good &= np.isfinite(inverse) & np.isfinite(variance) & (variance > 0)
    return np.where(good, inverse, 0).astype(np.float32), np.where(good, 1 / variance, 0).astype(np.float32)


def correlation(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Map, Map]:
    """Normalised correlation of two images in a window about each pixel, and the standard deviation of the first."""
    first, second = a.astype(np.float32), b.astype(np.float32)
    mean_a, mean_b = _mean(first), _mean(second)
    var_a, var_b = _mean(first * first) - mean_a**2, _mean(second * second) - mean_b**2
    both = _mean(first * second) - mean_a * mean_b
    return both / np.sqrt(np.maximum(var_a, 1) * np.maximum(var_b, 1)), np.sqrt(np.maximum(var_a, 0))


def _mean(x: Map, side: int = WINDOW) -> Map:
    return np.asarray(cv2.blur(x, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)


def fuse(inverse: NDArray[np.float32], weight: NDArray[np.float32]) -> Depth:
    """The mean of the largest consistent subset of n measurements [n, h, w], and its expected error.

    A single measurement counts if there is no other; ``confirmed`` checks it in another image. Weights are one over
    squared errors, 0 where there is no measurement. The error is at least the scatter of the measurements averaged.
    """
    best = np.zeros(inverse.shape[1:], np.float32)
    mean, error = np.zeros_like(best), np.zeros_like(best)
    variance, measured = 1 / np.maximum(weight, 1e-30), (weight > 0).sum(0)
    for k in range(len(inverse)):
        agrees = (weight > 0) & (weight[k] > 0) & ((inverse - inverse[k]) ** 2 < AGREE**2 * (variance + variance[k]))
        w = np.where(agrees, weight, 0)
        total, count = w.sum(0), agrees.sum(0)
        average = (w * inverse).sum(0) / np.maximum(total, 1e-30)
        scatter = (w * (inverse - average) ** 2).sum(0) / np.maximum(count - 1, 1)
        better = (
            (count >= np.minimum(measured, 2))
            & (average > 0)
            & (count + total / np.maximum(weight.sum(0), 1e-30) > best)
        )
        best = np.where(better, count + total / np.maximum(weight.sum(0), 1e-30), best)
        mean = np.where(better, average, mean)
        error = np.where(better, np.sqrt(np.maximum(scatter, 1) / np.maximum(total, 1e-30)), error)
    kept = (best > 0) & (error < MAX_RELATIVE * mean)
    return Depth(np.where(kept, mean, 0).astype(np.float32), np.where(kept, error, 0).astype(np.float32))


def filled(depth: Depth, rough: Map) -> Map:
    """Inverse depths of all pixels: rough ones pulled towards measured ones nearby, from coarse to fine."""
    relative = depth.error / np.maximum(depth.inverse, 1e-12)
    weight = np.where(depth.inverse > 0, 1 / np.maximum(relative, 0.01), 0).astype(np.float32)
    for side in (65, 33, 17, 9):
        near = _mean(weight, side)
        share = near / (near + PRIOR_ERROR)
        rough = share * _mean(weight * depth.inverse, side) / np.maximum(near, 1e-9) + (1 - share) * rough
    return rough


def neighbours_of(images: PosedImages, i: int) -> list[int]:
    """The nearest images with a similar viewing direction and another position."""
    poses = images.camera_to_worlds
    distance = np.linalg.norm(poses[:, :, 3] - poses[i, :, 3], axis=-1)
    alike = poses[:, :, 2] @ poses[i, :, 2] > np.cos(np.radians(MAX_ANGLE))
    usable = alike & (distance > 1e-9 * max(1.0, float(distance.max())))
    order = np.argsort(np.where(usable, distance, np.inf), kind="stable")
    return [int(j) for j in order[: min(NEIGHBOURS, int(usable.sum()))]]


def find_depths(
    images: PosedImages,
    points_of: Callable[[int], NDArray[np.float64]],
    width: int,
    progress: Progress = iter,
) -> Iterator[tuple[View, Depth]]:
    """The views of all images at working size and their depths.

    Args:
        images: the training images in their originals.
        points_of: SfM points [P, 3] that an image saw.
        width: working size, pixels.
        progress: wraps the numbers 0 to ROUNDS times the images as they are worked on.
    """
    cv2.setNumThreads(1)
    flow, count = _flow(), len(images.files)
    views = [load_view(images, i, width) for i in range(count)]
    near = [neighbours_of(images, i) for i in range(count)]
    rough: dict[int, Map] = {}
    found: dict[int, Depth] = {}
    for n in progress(range(ROUNDS * count)):
        i = n % count
        start = rough[i] if i in rough else rough_inverse_depth(views[i], points_of(i))
        found[i] = without_fringes(views[i], compared(views, near, i, start, flow))
        rough[i] = filled(found[i], start)
    for i, view in enumerate(views):
        yield view, confirmed(view, found[i], [(views[j], found[j]) for j in near[i]])


def compared(views: list[View], near: list[list[int]], i: int, start: Map, flow: cv2.DISOpticalFlow) -> Depth:
    """The depths of a view by comparison with its neighbours."""
    parts = [measure(views[i], views[j], start, flow) for j in near[i]]
    if not parts:
        return Depth(np.zeros_like(start), np.zeros_like(start))
    return fuse(*(np.stack(p) for p in zip(*parts, strict=True)))


def without_fringes(view: View, depth: Depth) -> Depth:
    """Removes the fringe around a foreground object where the background has no texture of its own."""
    known = depth.inverse > 0
    least = cv2.erode(np.where(known, depth.inverse, 1e30).astype(np.float32), np.ones((EDGE, EDGE), np.uint8))
    gray = view.gray.astype(np.float32)
    own = np.sqrt(np.maximum(_mean(gray * gray, 3) - _mean(gray, 3) ** 2, 0))
    return _only(depth, known & ((depth.inverse / STEP < least) | (own > OWN_CONTRAST)))


def confirmed(view: View, depth: Depth, others: list[tuple[View, Depth]]) -> Depth:
    """Keeps the depths confirmed by the depth of at least one other image and by at least as many as contradict it."""
    confirm, contradict = np.zeros(depth.inverse.shape, np.int8), np.zeros(depth.inverse.shape, np.int8)
    for other, theirs in others:
        parallax = _Parallax.between(view, other)
        at = parallax.pixels(depth.inverse)
        ahead = -(parallax.a[..., 2] + depth.inverse * parallax.b[2])
        expected = np.where(ahead > 1e-6, depth.inverse / np.where(ahead > 1e-6, ahead, 1), 0)
        inverse, error = (look_up(m, *at, nearest=True) for m in (theirs.inverse, theirs.error))
        tolerance = 3 * np.hypot(error, depth.error) + SAME_DEPTH * expected
        both = (inverse > 0) & (expected > 0)
        confirm += both & (np.abs(inverse - expected) < tolerance)
        contradict += both & (inverse < expected - tolerance)
    return _only(depth, (confirm >= 1) & (confirm > contradict))


def _only(depth: Depth, kept: NDArray[np.bool_]) -> Depth:
    return Depth(np.where(kept, depth.inverse, 0), np.where(kept, depth.error, 0))
