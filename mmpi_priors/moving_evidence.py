"""Evidence that a pixel shows something that moves, from neighbouring images, their depths and the ground.

A static point looks alike in all images that see it. So each pixel is compared with its neighbours at every inverse
depth that a static point there may have: its own or that of a pixel beside it, the depths of the neighbours, the
ground's, and infinity. A pixel that none of them explains moves if two neighbours agree about something else behind it,
or if an impossible depth explains it (``moving_sweep.py``).
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
"""Levels by which colours of one surface differ, beyond the range of colours of the pixels around."""
SPARSE = 2
"""Side of the squares of pixels of which one gives its depth to another image, and which get one depth."""
SOLID = 0.75
"""Inverse depths below this multiple of the ground's lie below the ground."""
SLOPE = 0.05
"""Tangent of the angle below the horizon from which a pixel may show the ground only: roads rise and fall."""
STEEP = 20.0
"""Degrees between the normal of the ground and up."""
GROUND_SHARE, BELOW_SHARE = 0.08, 0.03
"""Share of the known depths that lie on the ground, at least, and below it, at most."""
OCCLUDES, NEAR = 1.15, 13
"""A neighbour shows a point if its inverse depth in a window of this many pixels is the same but for this factor."""
NEAREST = 95
"""Percentile of an image's inverse depths that stands for the nearest content."""
CLEARLY, WINDOW = 80, 5
"""Levels beyond which a larger difference says no more, and side of the window over which differences are averaged."""
NOISE = 75
"""Percentile of the differences of surfaces of known depth that stands for the noise; some of them move."""
ALL = 255
TURNED = 3.0
"""Degrees between the facing directions of two images from which the camera turned between them. Where it goes straight
on, what neighbours say nothing about is mostly what stands (docs/ablations.md)."""


@dataclass(frozen=True)
class Shot:
    """An image at working size, with what is known of it."""

    view: View
    color: Bytes
    """Blue, green, red, a little blurred. [h, w, 3]"""
    depth: Depth
    ground: Map | None
    """Inverse depth of the ground, 0 near the horizon and above; None where no ground is found. [h, w]"""
    horizon: NDArray[np.float64] | None = None
    """Row of the horizon in each column, where a ground is found. [w]"""
    level: NDArray[np.float64] | None = None
    """The horizon also where no ground is found; None where the camera looks steeply up or down. [w]"""

    @cached_property
    def around(self) -> Map:
        """Inverse depth of the nearest pixel that has one, 0 where none is near. [h, w]"""
        near = cv2.dilate((self.depth.inverse > 0).astype(np.uint8), np.ones((NEAR, NEAR), np.uint8)) > 0
        return np.where(near, nearest_known(self.depth.inverse), 0) if near.any() else self.depth.inverse


@dataclass(frozen=True)
class Evidence:
    """Levels from 0 to 255. [h, w] each"""

    strong: Bytes
    """By which a pixel differs from every neighbour at every possible depth, though neighbours agree about what is
    behind it or it has an impossible depth."""
    weak: Bytes
    """By which it differs from all neighbours but one, two of which agree about what is behind it."""
    behind: Bytes
    """By which it differs from what two neighbours agree to be behind it."""
    judged: Mask
    """Two neighbours agree about a surface there, so that something else in front of it is seen; everywhere if the
    camera did not turn between the image and the two nearest."""
    noise: float
    """Levels by which surfaces of known depth differ from all neighbours but one, most of them."""


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
    """Inverse depth of the plane on which most of the content stands; 0 near the horizon and above.

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
    """Inverse depths at the pixels of a shot from those of another one, the nearest of several in a square. [h, w]"""
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
    shown = (ahead > 0) & (right >= 0) & (right < width * ahead) & (down >= 0) & (down < height * ahead)
    right, down, ahead, inverse = (part[shown] for part in (right, down, SPARSE * ahead, inverse))
    result = np.zeros((-(-height // SPARSE), -(-width // SPARSE)), np.float32)
    places = (  # a quotient may round up to the first square beyond the border
        np.minimum((part / ahead).astype(int), squares - 1)
        for part, squares in zip((down, right), result.shape, strict=True)
    )
    np.maximum.at(result, tuple(places), SPARSE * inverse / ahead)
    result = np.where(result > 0, result, cv2.dilate(result, np.ones((3, 3), np.uint8)))
    return np.repeat(np.repeat(result, SPARSE, 0), SPARSE, 1)[:height, :width]


def nearest_known(inverse: Map) -> Map:
    """Every pixel's inverse depth, or that of the nearest pixel that has one. [h, w]"""
    measured = inverse > 0
    _, label = cv2.distanceTransformWithLabels(
        (~measured).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(label.max()) + 1, np.float32)
    table[label[measured]] = inverse[measured]
    return table[np.asarray(label, np.int64)]


def possible_depths(shot: Shot, others: Sequence[Neighbour]) -> tuple[list[Map], list[Map]]:
    """Inverse depths that a static point may have, 0 where there is none: those from the image itself, and those of
    surfaces that other images or the ground put there."""
    splats = np.stack([splat(shot, other.shot) for other in others])
    farthest = np.where(splats > 0, splats, np.inf).min(0)
    behind = [np.where(np.isfinite(farthest), farthest, 0).astype(np.float32), splats.max(0)]
    if shot.ground is not None:
        behind.append(shot.ground)
    inverse, mine = shot.depth.inverse, [np.full_like(shot.depth.inverse, 1e-9)]
    if inverse.any():
        mine += [nearest_known(inverse), cv2.dilate(inverse, np.ones((11, 11), np.uint8))]
    return mine, behind


@dataclass(frozen=True)
class Warp:
    """Where another image shows the pixels of a shot, as OpenCV counts: from the middle of the first one."""

    far: list[Map]
    """Homogeneous pixels of what is infinitely far. [h, w] each"""
    shifts: list[float]
    """Their change for each unit of inverse depth."""

    @staticmethod
    def between(view: View, other: View) -> Warp:
        parallax, middle = Parallax.between(view, other), np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
        y, x = (np.arange(n) + 0.5 for n in view.gray.shape)
        far = [np.add.outer(a[1] * y + a[2], a[0] * x, dtype=np.float32) for a in middle @ parallax.linear]
        return Warp(far, (middle @ parallax.b).tolist())

    def at(self, pixels: tuple[NDArray[np.intp], ...], times: int) -> Warp:
        """Of some pixels, in so many equal rows."""
        return Warp([np.repeat(far[pixels][None], times, 0) for far in self.far], self.shifts)

    def places(self, inverse: Map) -> tuple[Map, Map, Map]:
        """Pixels x and y at these inverse depths, and depths over those in the shot, at most 0 behind the camera, where
        the pixels mean nothing. [h, w] each"""
        right, down, ahead = (
            np.asarray(cv2.scaleAdd(inverse, shift, far), np.float32)
            for shift, far in zip(self.shifts, self.far, strict=True)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return right / ahead, down / ahead, ahead


@dataclass(frozen=True)
class Neighbour:
    """Another image as it is compared with a shot."""

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

    def with_still(self, moves: Mask | None) -> Bytes:
        """Its colours, and ALL inside the lens where nothing moves as far as is known, else 0. [h, w, 4]"""
        still = self.shot.view.inside if moves is None else self.shot.view.inside & ~moves
        layer = np.asarray(cv2.cvtColor(self.color, cv2.COLOR_BGR2BGRA), np.uint8)
        layer[..., 3] = 0
        layer[1:-1, 1:-1, 3] = all_where(still[1:-1, 1:-1])
        return layer


def _compare(
    shot: Shot, others: Sequence[Neighbour], layers: Sequence[Bytes], inverse: Map, pairs: bool
) -> tuple[list[Bytes], Bytes, Mask]:
    """A shot against its neighbours, with what stands still as a fourth channel, at some inverse depths.

    Returns:
        Levels by which the colours of each neighbour differ, ALL where it shows nothing. [h, w] each
        Levels by which the shot differs from both of two neighbours that agree and have nothing in front. [h, w]
        Where two neighbours do. [h, w]
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
    """What of a shot no static scene explains.

    Args:
        shot: the image.
        others: its neighbours.
        masks: what moves in each neighbour, as far as is known. [h, w]
        impossible: where only an impossible depth is alike (``moving_sweep.py``). [h, w]
    """
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
    # Nobody can tell where fewer than two neighbours would show even the nearest content.
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
    """Levels by which a shot differs from the neighbour most like it, without what moves there, at the possible depth
    that is best; ALL where none shows anything, and outside of a box. Other arguments are those of ``evidence``.
    [h, w]"""
    layers = [other.with_still(mask) for other, mask in zip(others, masks, strict=True)]
    mine, surfaces = possible_depths(shot, others)
    part, result = replace(shot, color=shot.color[box]), np.full(shot.view.gray.shape, ALL, np.uint8)
    others = [replace(o, warp=replace(o.warp, far=[far[box] for far in o.warp.far])) for o in others]
    for inverse in (each[box] for each in mine + surfaces):
        possible = inverse > 0 if shot.ground is None else (inverse > 0) & (inverse >= SOLID * shot.ground[box])
        for distance in _compare(part, others, layers, inverse, False)[0]:
            result[box] = np.minimum(result[box], distance | all_where(~possible))
    return result
