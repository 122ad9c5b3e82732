"""Depths of a view at a low resolution by PatchMatch stereo: slanted patches that agree with its neighbours.

Dense matching (``dense.py``) starts from rough depths. Between the SfM points of a capture of few images these errors
are too large for optical flow: a wall beside the path is twice as large in one image as in the previous one. A plane
through a patch predicts its appearance in a neighbour, magnified and slanted. Random planes are compared at a small
size, good ones spread from pixel to pixel, and larger sizes refine them (``ops/patches``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mmpi_priors.ops.patches import GRAZING, OFFSETS, Patches, compare_planes, others_of, spread_planes
from mmpi_priors.views import Map, Parallax, View

PIXELS = 220.0**2
"""Pixels of a view in the search, at most."""
LEAST_SIDE = 2
"""Pixels of its shorter side at the smallest size, at least."""
LEVELS = ((4, 6, 1.0), (2, 4, 0.5), (1, 3, 0.3))
"""Each level's divisor of the size, its rounds, and how much planes change in the first, which halves in each: octaves
of the inverse depth, and parts of the unit normal."""
RANDOM, BEYOND = 8, 4.0
"""Random planes per pixel at the smallest size, and factor by which their range exceeds that of the points."""
FASTEST, SLOWEST = 0.35, 1.0
"""Their range without points: from a displacement by this part of the width in the nearest neighbour to one by so many
pixels in the farthest."""
STRIDE = 2
"""Pixels between the pixels of a patch."""
MIN_ALIKE = 0.7
"""Minimum correlation of a plane that is kept (``ops/patches.Patches``)."""
NOISE, MAX_RELATIVE = 0.75, 0.15
"""Standard deviation of a depth as a motion in the second best neighbour, pixels; largest relative error."""
SAME = 1.1
"""Inverse depths differ by at most this factor from the median around them, and those of one surface from pixel to
pixel."""
SPECK, MARGIN = 100, 3
"""Minimum number of pixels of a surface, and width of the gap about a step in depth."""


@dataclass(frozen=True)
class Surfaces:
    """Planes through the pixels of a view at a low resolution."""

    planes: NDArray[np.float32]
    """Inverse depth at the pixel's centre, and its change for a pixel to the right and for one down. [h, w, 3]"""
    error: Map
    """Expected error of the inverse depth; 0 where no plane is certain. [h, w]"""

    @property
    def inverse(self) -> Map:
        """Inverse depths where a plane is certain, else 0. [h, w]"""
        return np.where(self.error > 0, self.planes[..., 0], 0).astype(np.float32)

    def enlarged(self, shape: tuple[int, ...]) -> tuple[Map, Map]:
        """Inverse depths and errors of an image of another size; both 0 where no plane is certain, and next to a step
        in depth, across which patches reach. [H, W] each"""
        inverse, kernel = self.inverse, np.ones((3, 3), np.uint8)
        farthest = cv2.erode(np.where(inverse > 0, inverse, np.inf).astype(np.float32), kernel)
        steps = (inverse > 0) & (cv2.dilate(inverse, kernel) / SAME > farthest)
        near = cv2.dilate(steps.astype(np.uint8), np.ones((MARGIN, MARGIN), np.uint8))
        certain = np.where(near > 0, 0, self.error)
        layers = cv2.resize(np.dstack([self.planes, certain]), shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        inverse, across, along, error = cv2.split(layers)
        # From the middles of the small pixels.
        down, right = (
            ((np.arange(to) + 0.5) * n / to % 1 - 0.5).astype(np.float32)
            for n, to in zip(self.error.shape, shape, strict=True)
        )
        inverse = inverse + across * right + along * down[:, None]
        is_known = (error > 0) & (inverse > 0)
        return np.where(is_known, inverse, 0), np.where(is_known, error, 0)


def search_surfaces(
    view: View, others: Sequence[View], rough: Map, max_relative: float = MAX_RELATIVE
) -> Surfaces | None:
    """Planes through the pixels of a view at a low resolution; None if it is too small, or has no parallax to others.
    ``rough`` are initial inverse depths, of which the range matters most, 0 where there are none. [H, W]"""
    height, width = view.gray.shape
    smallest = max(1.0, (height * width / PIXELS) ** 0.5)
    apart = np.array([np.linalg.norm(other.pose[:, 3] - view.pose[:, 3]) for other in others])
    if not apart.any() or min(height, width) < LEAST_SIDE * LEVELS[0][0] * smallest:
        return None
    random, patches, small = torch.Generator().manual_seed(0), None, view
    for divisor, rounds, change in LEVELS:
        factor = divisor * smallest
        small = view.reduced(factor)
        shape, gray = small.gray.shape, torch.from_numpy(small.gray)
        parallax = [Parallax.between(small, other.reduced(factor)).tensors for other in others]
        linear, b = (torch.stack(parts) for parts in zip(*parallax, strict=True))
        sizes = (max(1.0, factor / 2), factor, 2 * factor)
        grays = [[torch.from_numpy(other.reduced(size).gray) for size in sizes] for other in others]
        compared, pinhole = others_of(grays, linear, b), torch.from_numpy(small.pinhole).float()
        if patches is None:
            start = torch.zeros(*shape, 3)
            start[..., 0] = torch.from_numpy(cv2.resize(rough, shape[::-1]))
            # And planes of any depth in the range of rough ones, facing the camera.
            if (rough > 0).any():
                near, far = np.percentile(rough[rough > 0], [99, 1]) * [BEYOND, 1 / BEYOND]
            else:  # on a walk, only the nearest neighbours still see near content
                near = FASTEST * width / view.pinhole[0] / max(apart.min(), 0.1 * apart.max())
                far = SLOWEST * smallest / view.pinhole[0] / apart.max()
            size, (fx, fy, cx, cy) = (RANDOM, *shape), pinhole
            q = far * (near / far) ** torch.rand(size, generator=random)
            ahead, turn = torch.rand(size, generator=random), 2 * np.pi * torch.rand(size, generator=random)
            aside = (1 - ahead * ahead).sqrt()
            right, down = aside * turn.cos(), aside * turn.sin()
            x, y = torch.arange(shape[1]) + 0.5 - cx, torch.arange(shape[0])[:, None] + 0.5 - cy
            towards = right * x / fx + down * y / fy + ahead
            scale = q / torch.where(towards < 0, towards.clamp(max=-GRAZING), towards.clamp(min=GRAZING))
            guesses = [start, *torch.stack([q, scale * right / fx, scale * down / fy], -1)]
        else:
            guesses = [_resized(patches.planes, shape)]
        patches = Patches(guesses[0], torch.full(shape, -1.0))
        for planes in guesses:
            patches = compare_planes(gray, patches, planes, compared, STRIDE)
        for n in range(rounds):
            changes = (2 * torch.rand(*shape, 4, generator=random) - 1) * change / 2**n
            offset = OFFSETS[n % len(OFFSETS)]
            patches = spread_planes(gray, patches, changes, pinhole, compared, STRIDE, offset)
    assert patches is not None
    return _certain(small, [other.reduced(smallest) for other in others], patches, max_relative)


def _resized(planes: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Planes [h, w, 3] of an image at another size [H, W, 3]: those through the nearest pixels."""
    (rows, down, height), (columns, right, width) = (
        (at.long().clamp(max=n - 1), at, n / to)
        for n, to in zip(planes.shape[:2], shape, strict=True)
        for at in [(torch.arange(to) + 0.5) * n / to]
    )
    q, across, along = planes[rows[:, None], columns].unbind(-1)
    q = q + across * (right - columns - 0.5) + along * (down - rows - 0.5)[:, None]
    return torch.stack([q, across * width, along * height], -1)


def _certain(view: View, others: Sequence[View], patches: Patches, max_relative: float) -> Surfaces:
    """Planes with a high correlation, close to those around them, and precise enough."""
    planes = patches.planes.numpy()
    inverse: Map = np.ascontiguousarray(planes[..., 0])
    # Displacement per unit of inverse depth in the second best view that sees it, or in the only one.
    change: Map = np.maximum(1e-3 * inverse, 1e-12)
    best, second = np.zeros((2, *inverse.shape), np.float32)
    for other in others:
        parallax = Parallax.between(view, other)
        x, y, _ = parallax.pixels(inverse)
        moved_x, moved_y, _ = parallax.pixels(inverse + change)
        height, width = other.gray.shape
        visible = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        moved = np.where(visible, np.hypot(moved_x - x, moved_y - y) / change, 0)
        second = np.maximum(second, np.minimum(best, moved))
        best = np.maximum(best, moved)
    error = NOISE / np.maximum(np.where(second > 0, second, best), 1e-12)
    middle = cv2.medianBlur(inverse, 5)
    kept = (patches.alike.numpy() > MIN_ALIKE) & view.inside & (error < max_relative * inverse)
    kept &= (inverse < SAME * middle) & (middle < SAME * inverse)
    # OpenCV's filter takes integers; one step of depth is 16.
    octaves = np.log(np.maximum(inverse, 1e-30)) / np.log(SAME)
    octaves -= octaves[kept].min(initial=0) - 1
    steps = np.where(kept, (16 * octaves).clip(16, 32000), -16).astype(np.int16)
    cv2.filterSpeckles(steps, -16, SPECK, 16)
    return Surfaces(planes, np.where(steps > 0, error, 0).astype(np.float32))
