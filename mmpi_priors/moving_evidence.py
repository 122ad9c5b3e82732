"""Evidence of moving pixels, from neighbouring images, their depths and the ground.

A static point looks alike in all images that see it. So each pixel is compared with its neighbours at every possible
inverse depth: its own or that of an adjacent pixel, the depths of the neighbours, the ground's, and infinity. A pixel
that matches at none of them is moving if two neighbours agree on another surface behind it, or if it matches at an
impossible depth (``moving_sweep.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_priors.dense import Depth
from mmpi_priors.views import Map, Parallax, View, pixel_grid

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

SAME = 12
"""Tolerance of colours of one surface in gray levels, beyond the range of the pixels around."""
SPARSE = 2
"""Side of the squares of pixels that are reduced to one depth in another image."""
SOLID = 0.75
"""Multiple of the ground's inverse depth below which a point lies below the ground."""
SLOPE = 0.05
"""Tangent of the angle below the horizon from which ground depths are used: roads rise and fall."""
STEEP = 20.0
"""Maximum angle between the normal of the ground and up, degrees."""
GROUND_SHARE, BELOW_SHARE = 0.08, 0.03
"""Minimum share of the depths on the ground, and maximum share below it."""
OCCLUDES, NEAR = 1.15, 13
"""A neighbour sees a point if an inverse depth in a window of this many pixels agrees up to this factor."""
NEAREST = 95
"""Percentile of an image's inverse depths taken as the nearest content."""
CLEARLY, WINDOW = 80, 5
"""Gray levels at which differences are truncated, and side of the window over which they are averaged."""
NOISE = 75
"""Percentile of the differences at pixels with a depth, taken as the noise; some of them move."""
ALL = 255
TURNED = 3.0
"""Minimum angle between the directions of two images for a turn of the camera, degrees. Without a turn, pixels that no
neighbour sees are mostly static."""


@dataclass(frozen=True)
class Shot:
    """An image at working size, with depth and ground."""

    view: View
    color: Bytes
    """Blue, green, red, a little blurred. [h, w, 3]"""
    depth: Depth
    ground: Map | None
    """Inverse depth of the ground, 0 near the horizon and above; None if no ground is detected. [h, w]"""
    horizon: NDArray[np.float64] | None = None
    """Row of the horizon in each column, if a ground is detected. [w]"""
    level: NDArray[np.float64] | None = None
    """The horizon, also without a ground; None if the camera looks steeply up or down. [w]"""

    @cached_property
    def around(self) -> Map:
        """Inverse depth of the nearest pixel with one, 0 where none is near. [h, w]"""
        near = cv2.dilate((self.depth.inverse > 0).astype(np.uint8), np.ones((NEAR, NEAR), np.uint8)) > 0
        return np.where(near, nearest_valid(self.depth.inverse), 0) if near.any() else self.depth.inverse


@dataclass(frozen=True)
class Evidence:
    """Evidence in gray levels from 0 to 255. [h, w] each"""

    strong: Bytes
    """Difference of a pixel from every neighbour at every possible depth, where neighbours agree on a surface behind it
    or it has an impossible depth."""
    weak: Bytes
    """Difference from all neighbours but one, two of which agree on a surface behind it."""
    behind: Bytes
    """Difference from the surface behind it that two neighbours agree on."""
    judged: Mask
    """Mask where two neighbours agree on a surface, so that an object in front of it is detectable; everywhere if the
    camera did not turn between the image and the two nearest."""
    noise: float
    """Noise: gray levels by which most pixels with a depth differ from all neighbours but one."""


def turned(view: View, other: View) -> bool:
    """Whether the camera turned between two images."""
    return float(view.pose[:, 2] @ other.pose[:, 2]) < np.cos(np.radians(TURNED))


def horizon_of(view: View, up: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Row of the horizon in each column of a view [w]; None where it looks steeply up or down."""
    fx, fy, cx, cy = view.pinhole
    right, down, ahead = np.array([1, -1, -1]) * (view.pose[:, :3].T @ up)
    if abs(down) < 0.5:
        return None
    x = (np.arange(view.gray.shape[1]) + 0.5 - cx) / fx
    return cy - fy * (right * x + ahead) / down


def ground_of(view: View, depth: Depth, up: NDArray[np.float64]) -> Map | None:
    """Inverse depth of the ground plane; 0 near the horizon and above.

    Args:
        view: the image.
        depth: its depths.
        up: unit vector in the world. [3]
    """
    rows, columns = np.nonzero(depth.inverse > 0)
    random = np.random.default_rng(0)
    kept = random.permutation(len(rows))[:3000]
    rows, columns = rows[kept], columns[kept]
    x, y = pixel_grid(view.gray.shape)
    fx, fy, cx, cy = view.pinhole
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1).astype(np.float64)
    v, q = rays[rows, columns], depth.inverse[rows, columns].astype(np.float64)
    upward = np.array([1, -1, -1]) * (view.pose[:, :3].T @ up)
    low = np.flatnonzero(v @ upward < -SLOPE)
    if len(low) < GROUND_SHARE * len(q) + 50:
        return None
    corners = low[random.integers(0, len(low), (300, 3))]
    corners = corners[np.abs(np.linalg.det(v[corners])) > 1e-5]
    planes = np.linalg.solve(v[corners], q[corners][..., None])[..., 0]
    level = -(planes @ upward) > np.cos(np.radians(STEEP)) * np.linalg.norm(planes, axis=-1)
    planes = planes[level]
    if not len(planes):
        return None
    expected, error = v @ planes.T, (2 * depth.error[rows, columns] + 0.03 * q)[:, None]
    on, below = np.abs(expected - q[:, None]) < error, expected > q[:, None] + 2 * error
    best = int((on.sum(0) - below.sum(0)).argmax())
    if on[:, best].mean() < GROUND_SHARE or below[:, best].mean() > BELOW_SHARE:
        return None
    chosen = on[:, best]
    weight = 1 / error[chosen, 0]
    plane = np.linalg.lstsq(v[chosen] * weight[:, None], q[chosen] * weight, rcond=None)[0]
    # Where the ground slopes otherwise than here, a pixel just below the horizon may show something else.
    seen = (rays @ upward < -SLOPE) & (rays @ plane > 0)
    return np.where(seen, rays @ plane, 0).astype(np.float32)


def splat(shot: Shot, other: Shot) -> Map:
    """Inverse depths of a shot's pixels, projected from another shot; the nearest of several in a square. [h, w]"""
    height, width = shot.view.gray.shape
    every = np.s_[::SPARSE, ::SPARSE]
    measured = np.nonzero(other.depth.inverse[every])
    inverse, parallax = other.depth.inverse[every][measured], Parallax.between(other.view, shot.view)
    a, b, (y, x) = (
        parallax.linear.astype(np.float32),
        parallax.b,
        (SPARSE * c.astype(np.float32) + 0.5 for c in measured),
    )
    right, down, ahead = (m[0] * x + m[1] * y + (m[2] + inverse * shift) for m, shift in zip(a, b, strict=True))
    visible = (ahead > 0) & (right >= 0) & (right < width * ahead) & (down >= 0) & (down < height * ahead)
    right, down, ahead, inverse = (part[visible] for part in (right, down, SPARSE * ahead, inverse))
    result = np.zeros((-(-height // SPARSE), -(-width // SPARSE)), np.float32)
    places = (  # a quotient may round up to the first square beyond the border
        np.minimum((part / ahead).astype(int), squares - 1)
        for part, squares in zip((down, right), result.shape, strict=True)
    )
    np.maximum.at(result, tuple(places), SPARSE * inverse / ahead)
    result = np.where(result > 0, result, cv2.dilate(result, np.ones((3, 3), np.uint8)))
    return np.repeat(np.repeat(result, SPARSE, 0), SPARSE, 1)[:height, :width]


def nearest_valid(inverse: Map) -> Map:
    """Inverse depth of every pixel, or of the nearest pixel with one. [h, w]"""
    measured = inverse > 0
    _, label = cv2.distanceTransformWithLabels(
        (~measured).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(label.max()) + 1, np.float32)
    table[label[measured]] = inverse[measured]
    return table[np.asarray(label, np.int64)]


def possible_depths(shot: Shot, others: Sequence[Neighbour]) -> tuple[list[Map], list[Map]]:
    """Possible inverse depths of static points, 0 where there is none: those from the image itself, and those of
    surfaces in other images and of the ground."""
    splats = np.stack([splat(shot, other.shot) for other in others])
    farthest = np.where(splats > 0, splats, np.inf).min(0)
    behind = [np.where(np.isfinite(farthest), farthest, 0).astype(np.float32), splats.max(0)]
    if shot.ground is not None:
        behind.append(shot.ground)
    inverse, mine = shot.depth.inverse, [np.full_like(shot.depth.inverse, 1e-9)]
    if inverse.any():
        mine += [nearest_valid(inverse), cv2.dilate(inverse, np.ones((11, 11), np.uint8))]
    return mine, behind


@dataclass(frozen=True)
class Warp:
    """Positions of a shot's pixels in another image, in OpenCV's convention: 0 is the centre of the first one."""

    far: list[Map]
    """Homogeneous pixels at infinity. [h, w] each"""
    shifts: list[float]
    """Their change for each unit of inverse depth."""

    @staticmethod
    def between(view: View, other: View) -> Warp:
        parallax, middle = Parallax.between(view, other), np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
        y, x = (np.arange(n) + 0.5 for n in view.gray.shape)
        far = [np.add.outer(a[1] * y + a[2], a[0] * x, dtype=np.float32) for a in middle @ parallax.linear]
        return Warp(far, (middle @ parallax.b).tolist())

    def at(self, pixels: tuple[NDArray[np.intp], ...], times: int) -> Warp:
        """The warp of some pixels, repeated in rows."""
        return Warp([np.repeat(far[pixels][None], times, 0) for far in self.far], self.shifts)

    def places(self, inverse: Map) -> tuple[Map, Map, Map]:
        """Pixels x and y at these inverse depths, and ratio of depths to those in the shot, at most 0 behind the
        camera, where the pixels are meaningless. [h, w] each"""
        right, down, ahead = (
            np.asarray(cv2.scaleAdd(inverse, shift, far), np.float32)
            for shift, far in zip(self.shifts, self.far, strict=True)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return right / ahead, down / ahead, ahead


@dataclass(frozen=True)
class Neighbour:
    """Another image, for comparison with a shot."""

    shot: Shot
    color: Bytes
    """At the exposure of the shot. [h, w, 3]"""
    warp: Warp
    """From the shot."""

    @staticmethod
    def of(shot: Shot, other: Shot, gain: NDArray[np.float64] | float = 1.0) -> Neighbour:
        """Another image, its blue, green and red times a gain. [3]"""
        levels = np.rint(np.arange(256)[:, None] * np.broadcast_to(gain, 3)).clip(0, 255).astype(np.uint8)
        color = np.asarray(cv2.LUT(other.color, levels[:, None]), np.uint8)
        return Neighbour(other, color, Warp.between(shot.view, other.view))

    def with_still(self, is_moving: Mask | None) -> Bytes:
        """Colours, and ALL inside the lens where nothing is masked as moving, else 0. [h, w, 4]"""
        still = self.shot.view.inside if is_moving is None else self.shot.view.inside & ~is_moving
        layer = np.asarray(cv2.cvtColor(self.color, cv2.COLOR_BGR2BGRA), np.uint8)
        layer[..., 3] = 0
        layer[1:-1, 1:-1, 3] = all_where(still[1:-1, 1:-1])
        return layer


def _compare(
    shot: Shot, others: Sequence[Neighbour], layers: Sequence[Bytes], inverse: Map, pairs: bool
) -> tuple[list[Bytes], Bytes, Mask]:
    """Comparison of a shot with its neighbours, with static pixels as a fourth channel, at some inverse depths.

    Returns:
        Differences of the colours of each neighbour, ALL where it sees nothing. [h, w] each Difference of the shot from
        both of two neighbours that agree and have nothing in front. [h, w] Mask where two neighbours agree so. [h, w]
    """
    kernel, four = np.ones((3, 3), np.uint8), cv2.cvtColor(shot.color, cv2.COLOR_BGR2BGRA)
    nearest, farthest = OCCLUDES * inverse, inverse / OCCLUDES
    distances, warped, free = [], [], []
    for other, layer in zip(others, layers, strict=True):
        x, y, ahead = other.warp.places(inverse)
        there = cv2.remap(layer, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        inside = (cv2.extractChannel(there, 3) > 0) & (ahead > 0)
        low, high = cv2.erode(there, kernel), cv2.dilate(there, kernel)
        apart = most_of_channels(cv2.max(cv2.subtract(low, four), cv2.subtract(four, high)))
        _, apart = cv2.threshold(apart, CLEARLY, CLEARLY, cv2.THRESH_TRUNC)
        distances.append(np.asarray(cv2.blur(apart, (WINDOW, WINDOW)), np.uint8) | all_where(~inside))
        if pairs:
            theirs = cv2.multiply(cv2.remap(other.shot.around, x, y, cv2.INTER_NEAREST), ahead)
            free.append(inside & (theirs <= nearest) & (theirs >= farthest))
            warped.append(there)
    pair, agreed = np.zeros(inverse.shape, np.uint8), np.zeros(inverse.shape, bool)
    for a in range(len(warped)):
        for b in range(max(0, a - 2), a):
            agree = free[a] & free[b] & (most_of_channels(cv2.absdiff(warped[a], warped[b])) < SAME)
            agreed |= agree
            pair = np.maximum(pair, all_where(agree) & np.minimum(distances[a], distances[b]))
    return distances, pair, agreed


def most_of_channels(apart: NDArray[Any]) -> Bytes:
    """The largest of the first three channels; NumPy takes three times as long. [h, w]"""
    blue, green, red = cv2.split(apart)[:3]
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def all_where(mask: Mask) -> Bytes:
    """ALL where a mask is set, else 0; np.where takes ten times as long. [h, w]"""
    return mask.view(np.uint8) * np.uint8(ALL)


def two_least(levels: Sequence[Bytes]) -> tuple[Bytes, Bytes]:
    """The least and the second least of several, ALL where there is none. [h, w] each"""
    first, second = np.full((2, *levels[0].shape), ALL, np.uint8)
    for each in levels:
        second = np.minimum(second, np.maximum(first, each))
        first = np.minimum(first, each)
    return first, second


def evidence(shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask | None], impossible: Mask) -> Evidence:
    """Evidence of pixels of a shot that match no static scene, from its neighbours, the masks of moving objects in each
    so far, and that of pixels that match only at an impossible depth (``moving_sweep.py``). [h, w] each"""
    shape = shot.view.gray.shape
    if len(others) < 2:
        nothing = np.zeros(shape, np.uint8)
        return Evidence(nothing, nothing, nothing, np.ones(shape, bool), 0.0)
    one, two, behind = np.full(shape, ALL, np.uint8), np.full(shape, ALL, np.uint8), np.zeros(shape, np.uint8)
    judged = np.zeros(shape, bool)
    layers = [other.with_still(mask) for other, mask in zip(others, masks, strict=True)]
    mine, surfaces = possible_depths(shot, others)
    for n, inverse in enumerate(mine + surfaces):
        distances, pair, agreed = _compare(shot, others, layers, inverse, n >= len(mine))
        possible = inverse > 0
        if shot.ground is not None:
            possible &= inverse >= SOLID * shot.ground
        first, second = (levels | all_where(~possible) for levels in two_least(distances))
        one, two = np.minimum(one, first), np.minimum(two, second)
        behind = np.maximum(behind, pair & all_where(possible))
        judged |= agreed & possible
    # Undecidable where fewer than two neighbours would see even the nearest content.
    measured = shot.depth.inverse[shot.depth.inverse > 0]
    nearest = np.full(shape, np.percentile(measured, NEAREST) if len(measured) else 0, np.float32)
    showing = np.zeros(shape, np.uint8)
    for other in others:
        x, y, ahead = other.warp.places(nearest)
        height, width = other.shot.view.gray.shape
        showing += (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5) & (ahead > 0)
    decided = (showing >= 2) & shot.view.inside
    strong = np.where(decided & (one < ALL), np.minimum(one, np.where(impossible, ALL, behind)), 0).astype(np.uint8)
    weak = np.where(decided & (two < ALL), np.minimum(two, behind), 0).astype(np.uint8)
    judged &= decided
    if not any(turned(shot.view, other.shot.view) for other in others[:2]):
        judged[:] = True
    differences = two[(shot.depth.inverse > 0) & (two < ALL)]
    noise = float(np.percentile(differences, NOISE)) if len(differences) else 0.0
    return Evidence(strong, weak, behind, judged, noise)


def least_unlike(shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask], box: tuple[slice, slice]) -> Bytes:
    """Difference of a shot from the most similar neighbour, without its moving objects, at the best possible depth; ALL
    where none sees anything, and outside of a box. Other arguments are those of ``evidence``. [h, w]"""
    layers = [other.with_still(mask) for other, mask in zip(others, masks, strict=True)]
    mine, surfaces = possible_depths(shot, others)
    part, result = replace(shot, color=shot.color[box]), np.full(shot.view.gray.shape, ALL, np.uint8)
    others = [replace(o, warp=replace(o.warp, far=[far[box] for far in o.warp.far])) for o in others]
    for inverse in (each[box] for each in mine + surfaces):
        possible = inverse > 0 if shot.ground is None else (inverse > 0) & (inverse >= SOLID * shot.ground[box])
        for distance in _compare(part, others, layers, inverse, False)[0]:
            result[box] = np.minimum(result[box], distance | all_where(~possible))
    return result
