"""Depth extrapolated from surrounding surfaces, where hardly any other training image looks.

In regions that at most one other training image sees, such as the borders of the first image of a drive, little can be
matched, and content at many distances fits the colours. There, nearby surfaces with a depth (the road, a wall) are
extrapolated. A plane n.x = d appears along the unit direction v at the inverse distance n.v / d, which is linear in v
for any lens. So w.v is fitted to the inverse distances of the pixels with a depth around a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import nearest_views
from mmpi_priors.views import Map, project

WIDTHS = (1 / 80, 1 / 40, 1 / 20, 1 / 10, 1 / 5)
"""Widths of the Gaussian weights, as fractions of the longer side of the image; the most certain fit is used."""
PIXELS = 2.0
"""Largest standard deviation of a blur in pixels; wider ones are computed on smaller images."""
ENOUGH = 0.05
"""Smallest weighted fraction of pixels with a depth around a pixel for which a plane is fitted."""
LEAST_ERROR, MOST_ERROR = 0.05, 0.3
"""Minimum relative error of an extrapolated distance, and the error above which it is discarded."""
NEAREST, MOST_OTHERS = 16, 1
"""Nearby images that are checked for a point, and maximum number of them that may see a lone one; with more, matches
and colours are more reliable."""


def continued(depths: Map, directions: Map) -> Map:
    """Inverse distances of pixels without a depth, from planes fitted to the pixels with one around them.

    ``depths`` [H, W, 2] are inverse distances, 0 where unknown, and their expected errors, ``directions`` [H, W, 3] are
    of unit length. Returns the same as ``depths`` for the other pixels only: 0 where no plane fits.
    """
    inverse, error = depths[..., 0].astype(np.float64), depths[..., 1].astype(np.float64)
    has_depth = inverse > 0
    extended, best = np.zeros(depths.shape, np.float32), np.where(has_depth, 0, MOST_ERROR)
    if not has_depth.any():
        return extended
    scale = float(np.median(inverse[has_depth]))
    q, v = inverse / scale, np.moveaxis(directions, -1, 0).astype(np.float64, order="C")
    trust = np.where(has_depth, 1 / (1 + (error / np.maximum(LEAST_ERROR * inverse, 1e-30)) ** 2), 0)
    parts = [trust, trust * q * q, *(trust * q * axis for axis in v)]
    parts += [trust * v[i] * v[j] for i in range(3) for j in range(i, 3)]
    height, width = inverse.shape
    for share in WIDTHS:  # sums under a wide Gaussian, zero outside, from smaller images
        shrink = max(1.0, share * max(height, width) / PIXELS)
        blur, sums = share * max(height, width) / shrink, []
        for part in parts:
            size = max(1, round(width / shrink)), max(1, round(height / shrink))
            small = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
            small = cv2.GaussianBlur(small, (0, 0), blur, borderType=cv2.BORDER_CONSTANT)
            sums.append(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))
        rows, columns = np.nonzero((sums[0] > ENOUGH) & (best > LEAST_ERROR))
        # w.v is fitted to q along v; its expected error is the scatter, larger the farther extrapolated.
        sums, sight = [s[rows, columns] for s in sums], [axis[rows, columns] for axis in v]
        _, squares, *right, xx, xy, xz, yy, yz, zz = (s / sums[0] for s in sums)
        xx, yy, zz = xx + 1e-7, yy + 1e-7, zz + 1e-7
        # In closed form, part by part: LAPACK takes matrices one by one, and NumPy is slow along short axes.
        cofactors = (
            (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy),
            (xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
            (xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy),
        )
        determinant = xx * cofactors[0][0] + xy * cofactors[0][1] + xz * cofactors[0][2]
        plane, spread = ([_dot(row, vector) / determinant for row in cofactors] for vector in (right, sight))
        scatter, value = np.maximum(squares - _dot(plane, right), 0), _dot(plane, sight)
        deviation = np.sqrt((scatter + (0.2 * LEAST_ERROR * value) ** 2) * np.maximum(_dot(spread, sight), 1))
        relative = np.where(value > 0, np.maximum(deviation / np.maximum(value, 1e-12), LEAST_ERROR), np.inf)
        good = relative < best[rows, columns]
        rows, columns, value, relative = rows[good], columns[good], value[good], relative[good]
        best[rows, columns] = relative
        extended[rows, columns] = scale * np.stack([value, relative * value], -1)
    return extended


def _dot(a: Sequence[NDArray[np.float64]], b: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def is_lone(posed: PosedImages, i: int, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether at most ``MOST_OTHERS`` images near image i may see each of its points [P, 3]. [P]"""
    count, lone = np.zeros(len(points), np.int64), np.arange(len(points))
    for j in nearest_views(posed.camera_to_worlds, i, NEAREST):
        if not len(lone):
            break
        at = project(posed, j, points[lone])
        count[lone] += ((at >= 0) & (at <= posed.sizes[j])).all(-1)
        lone = lone[count[lone] <= MOST_OTHERS]
    return count <= MOST_OTHERS
