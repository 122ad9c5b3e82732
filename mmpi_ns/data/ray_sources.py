"""Sources of the rays of a training step: pixels, points that two images see, and SfM keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Int, Int16, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.data.priors import DepthPriors, SharedPoints, unpacked
from mmpi_ns.data.rays import Rays, TrainingRays
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.parallel import in_order
from mmpi_ns.utils.random_draws import generator, random_numbers


@dataclass(frozen=True)
class PixelPool:
    """The P pixels of I images, image by image, on the device.

    If all pixels of an image are here, row and column of a pixel follow from its index.
    """

    colors: UInt8[Tensor, "P C"]
    """C = 3 or 4."""
    images: Int[Tensor, "I"]
    """Numbers of the images in the data set."""
    widths: Int[Tensor, "I"]
    begins: Int[Tensor, "I"]
    """Index of each image's first pixel."""
    ends: Int[Tensor, "I"]
    places: Int[Tensor, "P"] | None
    """row * width + column of each pixel; None if all pixels are here."""
    depths: Int16[Tensor, "P 2"] | None
    """Inverse distance of each pixel and its expected error, by ``priors.packed``; None without any."""

    @staticmethod
    def from_dataset(
        dataset: MMPIDataset,
        device: str | torch.device,
        images: Sequence[int],
        depth_priors: DepthPriors | None,
        most: int,
        seed: int,
    ) -> PixelPool:
        """The pool of some training images, which are read once, without masked pixels.

        Of more than ``most`` pixels, unless that is 0, a random subset is read, the same fraction of each image. Raises
        InputError naming an image or mask that cannot be used, or if the masks leave nothing.
        """
        widths, heights = (x.reshape(-1).tolist() for x in (dataset.cameras.width, dataset.cameras.height))
        sizes = [widths[i] * heights[i] for i in images]
        share = min(1.0, most / sum(sizes)) if most else 1.0
        whole = share == 1.0 and not dataset.has_masks
        room = sum(int(share * size) for size in sizes)
        colors = torch.empty(room, 4 if dataset.has_alpha else 3, dtype=torch.uint8)
        places = None if whole else torch.empty(room, dtype=torch.int32)
        depths = None if depth_priors is None else torch.empty(room, 2, dtype=torch.int16)
        starts = [0]
        read = in_order(lambda i: _pixels_of(dataset, i, share, seed), images)
        for i, (image, kept) in zip(images, read, strict=True):
            starts.append(starts[-1] + len(kept))
            rows = slice(*starts[-2:])
            colors[rows, : image.shape[1]] = image[kept]
            colors[rows, image.shape[1] :] = 255  # opaque where the image has no alpha and another one has
            if places is not None:
                places[rows] = kept.int()
            if depths is not None and depth_priors is not None:
                codes = torch.from_numpy(np.require(depth_priors.codes[i], requirements="W"))
                depths[rows] = codes.reshape(-1, 2)[kept]
        if not starts[-1]:
            raise InputError("The masks leave no training pixel: white (non-zero) mask pixels are the ones used.")
        rows = slice(starts[-1])
        places, depths = (None if x is None else x[rows].to(device) for x in (places, depths))
        columns = images, [widths[i] for i in images], starts[:-1], starts[1:]
        numbers, image_widths, begins, ends = (torch.tensor(column, device=device) for column in columns)
        return PixelPool(colors[rows].to(device), numbers, image_widths, begins, ends, places, depths)

    @cached_property
    def count(self) -> int:
        """Number of pixels in the pool; read from the device once, not in every step."""
        return int((self.ends - self.begins).sum())

    @cached_property
    def _of_images(self) -> tuple[Int[Tensor, "I"], Int[Tensor, "I 4"]]:
        """Of each image: pixels up to its last; what to add to their index, its first pixel, width and number."""
        after = (self.ends - self.begins).cumsum(0)
        return after, torch.stack([self.ends - after, self.begins, self.widths, self.images], -1)

    def draw(
        self, count: int, *generators: torch.Generator
    ) -> tuple[Float[Tensor, "R C"], Int[Tensor, "R 3"], Float[Tensor, "R 2"]]:
        """Colours, (image, row, column) and depths of ``count`` random pixels of each generator."""
        after, of_images = self._of_images
        drawn = random_numbers(self.count, count, generators).to(self.colors.device)
        offset, begin, width, image = of_images[torch.searchsorted(after, drawn, right=True)].unbind(-1)
        chosen = drawn + offset
        place = chosen - begin if self.places is None else self.places[chosen].long()
        indices = torch.stack([image, place // width, place % width], -1)
        depths = drawn.new_zeros(len(drawn), 2).float() if self.depths is None else unpacked(self.depths[chosen])
        return self.colors[chosen] / 255, indices, depths


def _pixels_of(dataset: MMPIDataset, i: int, share: float, seed: int) -> tuple[UInt8[Tensor, "N C"], Int[Tensor, "n"]]:
    """The pixels of an image, and the indices to keep: a share of the pixels outside the mask."""
    data = dataset.get_data(i, image_type="uint8")
    image = data["image"].reshape(-1, data["image"].shape[-1])
    kept = torch.arange(len(image))
    if share < 1:
        chosen = torch.randperm(len(image), generator=generator(seed, i, "resident"))[: int(share * len(image))]
        kept = torch.zeros(len(image), dtype=torch.bool).index_fill_(0, chosen, True).nonzero()[:, 0]
    if "mask" in data:
        kept = kept[data["mask"].reshape(-1).bool()[kept]]
    return image, kept


def rays_to_keypoints(
    observations: Observations, device: str | torch.device, images: Sequence[int]
) -> TrainingRays | None:
    """Rays from some training cameras to the SfM points that they see; None if there are none.

    A ray ends at the point itself, a fraction of a pixel from the keypoint, so no lens model is needed.
    """
    cameras, points = observations.tracked
    chosen = np.isin(cameras, images)
    if not chosen.any():
        return None
    cameras, points = cameras[chosen], points[chosen]
    origins = observations.centers[cameras]
    distance = np.maximum(np.linalg.norm(points - origins, axis=-1, keepdims=True), 1e-12)
    parts = origins, (points - origins) / distance, 1 / distance
    origins, directions, inverse = (torch.from_numpy(x).float().to(device) for x in parts)
    numbers = torch.from_numpy(cameras)[:, None].to(device)
    return TrainingRays(origins, directions, torch.ones_like(inverse), numbers, keypoint_disparities=inverse)


@dataclass(frozen=True)
class RaySources:
    """Sources of the rays of a step, for all training cameras or for one window's."""

    pixels: PixelPool
    new_views: SharedPoints | None
    keypoints: TrainingRays | None
    """By ``rays_to_keypoints``."""
    rays: Rays
    """Generator of rays through pixel centres (image, row, column)."""
    new_view_share: float
    """Rays of new views for each pixel ray."""
    keypoint_rays: int
    """Keypoint rays of a step without new views."""
    exposures: Float[Tensor, "M 3"] | None = None
    """Colour in each training image over colour in the field; None if all have the same exposure."""

    def of_images(self, images: NDArray[np.int64]) -> RaySources:
        """The sources of some images. Raises InputError if masks leave them no pixel."""
        numbers, keypoints, pool = torch.from_numpy(images), self.keypoints, self.pixels
        left = (torch.isin(pool.images, numbers.to(pool.images)) & (pool.ends > pool.begins)).nonzero()[:, 0]
        if not len(left):
            raise InputError("The masks leave no training pixel in one stretch of the capture: use longer windows.")
        if keypoints is not None and keypoints.camera_indices is not None:
            cameras = keypoints.camera_indices[:, 0]
            kept = torch.isin(cameras, numbers.to(cameras)).nonzero()[:, 0]
            keypoints = keypoints[kept] if len(kept) else None
        pixels = replace(pool, **{n: getattr(pool, n)[left] for n in ("images", "widths", "begins", "ends")})
        return replace(
            self,
            pixels=pixels,
            new_views=self.new_views and self.new_views.of_images(numbers, pixels.count / pool.count),
            keypoints=keypoints,
        )

    def counts(self, pixel_rays: int) -> tuple[int, int, int]:
        """Rays of pixels, new views and keypoints in a step."""
        cover = 0.0 if self.new_views is None else min(1.0, self.new_views.cover)
        new_view_rays = round(cover * round(self.new_view_share * pixel_rays))
        # Points shared by two images are more informative than keypoints, which replace the missing ones.
        keypoint_rays = 0 if self.keypoints is None else round((1 - cover) * self.keypoint_rays)
        return pixel_rays, new_view_rays, keypoint_rays

    def draw(
        self, pixel_rays: int, *generators: torch.Generator, pixels_alone: bool = False, jitter: float = 0.0
    ) -> tuple[TrainingRays, dict[str, Tensor]]:
        """Rays of pixels, new views and keypoints, in this order, or of pixels alone, and their batch, for S steps with
        a generator each. ``jitter``: standard deviation of the rays of pixels from the centres, in pixels.

        Returns:
            The rays [S, R]. The batches: ``image``, colours of the rays of pixels and new views, at the exposure of the
            field [S, I, C], and ``indices``, image, row and column of the pixels [S, N, 3].
        """
        steps = len(generators)
        colors, indices, depths = self.pixels.draw(pixel_rays, *generators)
        if self.exposures is not None:
            colors[:, :3] /= self.exposures[indices[:, 0]]
        bundles, images, device = [self.rays(indices)], [colors], colors.device
        if jitter:
            (pixels,) = bundles
            shifts = torch.cat([torch.randn(pixel_rays, 3, generator=g, device=g.device) for g in generators])
            shifts = jitter * pixels.pixel_area.sqrt() * shifts.to(device)
            pixels.directions = torch.nn.functional.normalize(pixels.directions + shifts, dim=-1)
        priors = [pad(depths, (1, 0))]  # of keypoints, and of other surfaces
        _, new_view_rays, keypoint_rays = (0, 0, 0) if pixels_alone else self.counts(pixel_rays)
        if self.new_views is not None and new_view_rays:
            views, seen, depths = self.new_views.draw(new_view_rays, self.rays, generators, self.exposures)
            bundles.append(views)
            images.append(seen)
            priors.append(pad(depths, (1, 0)))
        if self.keypoints is not None and keypoint_rays:
            drawn = self.keypoints[random_numbers(len(self.keypoints), keypoint_rays, generators).to(device)]
            bundles.append(drawn)
            priors.append(pad(cast(Tensor, drawn.keypoint_disparities), (0, 2)))

        def joined(parts: list[Tensor]) -> Tensor:
            return torch.cat([part.view(steps, -1, part.shape[-1]) for part in parts], 1)

        fields = ("origins", "directions", "pixel_area", "camera_indices")
        columns: dict[str, Any] = {name: joined([getattr(bundle, name) for bundle in bundles]) for name in fields}
        keypoints, depths = joined(priors).split([1, 2], -1)
        rays = TrainingRays(
            **columns,
            keypoint_disparities=keypoints,
            disparities=depths,
            exposures=None if self.exposures is None else self.exposures[columns["camera_indices"][..., 0]],
            through_pixel=(torch.arange(keypoints.shape[1], device=device) < pixel_rays)[:, None].repeat(steps, 1, 1),
        )
        return rays, {"image": joined(images), "indices": indices.view(steps, -1, 3)}
