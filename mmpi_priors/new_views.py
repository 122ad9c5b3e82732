"""Rays of new views: from positions between two training cameras that see the same point.

A point that two images see with the same colour and depth is visible from every position between their cameras, unless
an object between them occludes it. Its colour there lies between those of the two images. Such rays supervise the
colour of a new view and, since they end at the point, the empty space in front of it, which removes floaters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from mmpi_ns.data.dataset import MMPIDataset, image_and_mask
from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.data.priors import DepthPriors, SharedPoints
from mmpi_ns.data.rays import Rays
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.host import give_back_freed_memory
from mmpi_ns.utils.parallel import in_order
from mmpi_priors.cache import held
from mmpi_priors.dense import TRIMMED
from mmpi_priors.views import look_up, project

NEIGHBOURS = 4
"""Number of cameras, the nearest facing the same way, into which a point of an image is projected."""
MAX_ANGLE = 60.0
"""Maximum angle in degrees between the viewing directions of two cameras with new views between them."""
CERTAIN = 0.03
"""Maximum relative error of a depth used for new views."""
SAME_DEPTH = 0.03
"""Maximum relative difference between the distances of a point in two images."""
SAME_COLOR = 24
"""Tolerance, in levels, beyond the range of colours within a pixel of the projection in the other image."""
BYTES_OF_IMAGE = 18
"""Of a pixel of an image with the range of colours around, its mask and depths."""
MOST = 2_000_000
"""Maximum number of pixel pairs (30 bytes each), spread over the images."""


@dataclass(frozen=True)
class SourceImage:
    """An image prepared for comparison with others."""

    image: UInt8[ndarray, "H W C"]
    darkest: UInt8[ndarray, "H W C"]
    """Of the pixels around,"""
    brightest: UInt8[ndarray, "H W C"]
    """and the brightest."""
    usable: UInt8[ndarray, "H W"]
    depth: Float[ndarray, "H W 2"]

    @staticmethod
    def of(
        image: UInt8[ndarray, "H W C"], usable: UInt8[ndarray, "H W"], depth: Float[ndarray, "H W 2"]
    ) -> SourceImage:
        around = np.ones((3, 3), np.uint8)
        darkest, brightest = (np.asarray(bound(image, around), np.uint8) for bound in (cv2.erode, cv2.dilate))
        return SourceImage(image, darkest, brightest, usable, depth)

    def shows(
        self, posed: PosedImages, j: int, points: Float[ndarray, "P 3"], colors: Float[ndarray, "P C"]
    ) -> tuple[Int[ndarray, "S"], UInt8[ndarray, "S C"]]:
        """Indices and colours of the points that this image, j, sees at their distance and with their colour."""
        at = project(posed, j, points)
        maps = self.depth[..., 0], self.usable, self.darkest, self.brightest
        inverse, may, darkest, brightest = (look_up(m, *at.T, nearest=True) for m in maps)
        expected = 1 / np.maximum(np.linalg.norm(points - posed.camera_to_worlds[j, :, 3], axis=-1), 1e-12)
        same_depth = (inverse > 0) & (np.abs(inverse - expected) < SAME_DEPTH * expected)
        low, high = darkest.astype(int) - SAME_COLOR, brightest.astype(int) + SAME_COLOR
        seen = np.nonzero(same_depth & ((colors >= low) & (colors <= high)).all(-1) & (may > 0))[0]
        return seen, look_up(self.image, *at[seen].T)


def find_shared_points(
    dataset: MMPIDataset,
    posed: PosedImages,
    depths: DepthPriors,
    rays: Rays,
    images: Sequence[int],
    seed: int,
    device: str | torch.device = "cpu",
    exposures: Float[Tensor, "M 3"] | None = None,
) -> SharedPoints | None:
    """The points that two of the training ``images``, by number, see at the same depth; None if there are none.

    ``seed`` chooses among more than ``MOST`` pixels. ``exposures`` are those of all training images, by which colours
    are divided; None: they are equal. Raises InputError naming an image or mask that cannot be used.
    """
    # Neighbouring cameras mostly have neighbouring numbers.
    show = held(
        lambda i: SourceImage.of(*image_and_mask(dataset, i), depths.image(i)),
        posed.sizes, BYTES_OF_IMAGE, NEIGHBOURS + 1,
    )  # fmt: skip
    budget = max(1, MOST // (NEIGHBOURS * max(1, len(images))))
    parts, matches = [], 0.0
    shared = in_order(lambda i: _matches(i, images, show, posed, rays, budget, seed, exposures), images)
    for n, (some, number) in enumerate(shared):
        parts, matches = parts + some, matches + number
        if n % TRIMMED == 0:
            give_back_freed_memory()
    if matches == 0:
        return None
    joined = (torch.cat(column).to(device) for column in zip(*parts, strict=True))
    centers = torch.from_numpy(posed.camera_to_worlds[:, :, 3]).float().to(device)
    cover = matches / sum(depths.codes[i][..., 0].size for i in images)
    return SharedPoints(*joined, centers=centers, cover=cover)


def _matches(
    i: int,
    images: Sequence[int],
    show: Callable[[int], SourceImage],
    posed: PosedImages,
    rays: Rays,
    most: int,
    seed: int,
    exposures: Float[Tensor, "M 3"] | None,
) -> tuple[list[tuple[Tensor, ...]], float]:
    """Points that image i shares with its neighbours among ``others``, as the first four fields of ``SharedPoints``.

    At most ``most`` of its pixels with a certain depth are compared. The second result is the estimated number of
    matches of all of them.
    """
    source = show(i)
    inverse, error = source.depth[..., 0], source.depth[..., 1]
    rows, columns = np.nonzero((inverse > 0) & (error < CERTAIN * inverse) & (source.usable > 0))
    count, parts, matches = len(rows), [], 0.0
    if count > most:
        chosen = np.sort(np.random.default_rng((seed, i)).choice(count, most, replace=False))
        rows, columns = rows[chosen], columns[chosen]
    if not count:
        return parts, matches
    pixels = torch.from_numpy(np.stack([np.full(len(rows), i), rows, columns], -1))
    depths, colors = source.depth[rows, columns], source.image[rows, columns]
    directions = rays(pixels).directions.double().cpu().numpy()
    points = posed.camera_to_worlds[i, :, 3] + directions / depths[:, :1]
    for j in nearest_views(posed.camera_to_worlds, i, NEIGHBOURS, MAX_ANGLE, images):
        expected = colors.astype(np.float32)
        if exposures is not None:
            expected[:, :3] *= (exposures[j] / exposures[i]).cpu().numpy()
        seen, theirs = show(j).shows(posed, j, points, expected.clip(0, 255))
        matches += len(seen) * count / len(rows)
        other, both = torch.full((len(seen),), j, dtype=torch.int32), np.stack([colors[seen], theirs], 1)
        parts.append((pixels[seen].int(), other, torch.from_numpy(both), torch.from_numpy(depths[seen])))
    return parts, matches
