"""Priors of a capture: the record that training, placement and evaluation read.

Here it is made from the cameras alone; ``mmpi_priors`` computes the rest from the images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, Int16, UInt8
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.base_config import InstantiateConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from numpy import ndarray
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.data.posed_images import camera_observations
from mmpi_ns.data.rays import Rays
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.random_draws import random_numbers

Codes = NDArray[np.int16]
UNKNOWN, OCTAVE = -(2**15), 1024
"""Code of a number that is 0, and codes in an octave."""
STRIP = 1 << 16
"""Number of values coded at once."""
AGREEMENT = 0.8
"""Gains are used if they lower the median error of held-out pairs to less than this fraction,"""
SPAN, SPAN_ERRORS = 0.03, 6.0
"""and if 80 % of the log gains span at least this, and this many of their errors."""
MOST_HEADROOM = 0.5
"""Smallest factor of the field's reference exposure."""


@dataclass(frozen=True)
class DepthPriors:
    """Depth priors of every training image: inverse distance from the camera, 0 where there is none, and its expected
    error.

    Stored in 16 bits each; the relative rounding error of a distance is at most 0.034 %.
    """

    codes: Sequence[Codes]
    """[H, W, 2] each, by ``packed``; mapped from a file or computed when read, so that they take no memory."""

    def image(self, i: int) -> NDArray[np.float32]:
        """The numbers of one image. [H, W, 2]"""
        return unpacked(torch.from_numpy(np.require(self.codes[i], requirements="W"))).numpy()

    @cached_property
    def share(self) -> float:
        """Share of all pixels with a distance."""
        count = sum(int((m[..., 0] != UNKNOWN).sum()) for m in self.codes)
        return count / max(1, sum(m[..., 0].size for m in self.codes))


def packed(values: ArrayLike) -> Codes:
    """Logarithms of positive numbers in steps of 1/1024 of an octave, for 1/t and errors from 2^-31 to 2^31; 0 is kept.

    Steps are relative, as the error of a distance is.
    """
    values = np.asarray(values, np.float32)
    codes, flat = np.empty(values.shape, np.int16), values.reshape(-1)
    for first in range(0, flat.size, STRIP):
        part = flat[first : first + STRIP]
        logarithms = np.log2(np.where(part > 0, part, 1))
        coded = np.where(part > 0, np.rint(OCTAVE * logarithms.clip(-31, 31)), UNKNOWN)
        codes.reshape(-1)[first : first + STRIP] = coded
    return codes


def unpacked(codes: Int16[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """The inverse of ``packed``."""
    return torch.exp2(codes.float() / OCTAVE).masked_fill_(codes == UNKNOWN, 0.0)


@dataclass(frozen=True)
class Gains:
    """Factors between the colours of images and of a reference exposure."""

    factors: Float[ndarray, "N 3"]
    """Colour in the image over colour at the reference exposure, each channel's geometric mean 1."""
    errors: Float[ndarray, "N"]
    """Expected errors of their logarithms."""
    falloff: Float[ndarray, "2 3"]
    """Log colour per r^2 and r^4, towards the corners."""
    disagreement: float
    """Median difference of log colours in held-out pairs of images, without gains,"""
    corrected: float
    """and with them."""

    @property
    def span(self) -> float:
        """Ratio of the factors that bound 80 % of the images, in the channel that varies most."""
        low, high = np.quantile(self.factors, [0.1, 0.9], axis=0)
        return float((high / low).max())

    def describe(self) -> str:
        """Whether and how much exposure varies, in one sentence."""
        before, after, error = (100 * x for x in (self.disagreement, self.corrected, float(np.median(self.errors))))
        differ = f"where images show the same, colours differ by {before:.1f} %"
        if self.matter:
            varies = f"Exposure or white balance varies {self.span:.2f}-fold between images and is corrected"
            return f"{varies}: {differ}, and by {after:.1f} % after that."
        factors = f"by {after:.1f} % with a factor for each image, known to {error:.1f} %"
        return f"Exposure is not corrected: {differ}, and {factors}."

    @property
    def from_field(self) -> Float[ndarray, "N 3"]:
        """Factors from the colours of a field, which are at most 1, to those of the images: the field has the exposure
        of the darkest image, or half of the reference, so that it can represent colours that only dark images do not
        clip."""
        return self.factors / np.clip(self.factors.min(), MOST_HEADROOM, 1)

    @property
    def matter(self) -> bool:
        """Whether images differ by more than the errors of the gains, and held-out pairs agree better with the gains
        than without."""
        confirmed = self.corrected < AGREEMENT * self.disagreement
        return bool(confirmed and np.log(self.span) > max(SPAN, SPAN_ERRORS * float(np.median(self.errors))))


@dataclass(frozen=True)
class SharedPoints:
    """Points that two training images see at the same depth, each as a pixel of the first."""

    pixels: Int[Tensor, "P 3"]
    """Image, row and column in the first."""
    other: Int[Tensor, "P"]
    """The second image."""
    colors: UInt8[Tensor, "P 2 C"]
    """Colour in the first and the second image."""
    depths: Float[Tensor, "P 2"]
    """Inverse distance from the first camera, and its expected error."""
    centers: Float[Tensor, "M 3"]
    """Positions of all training cameras."""
    cover: float
    """Number of points divided by the number of pixels; limits how often each point is drawn."""

    def of_images(self, images: Int[Tensor, "I"], share: float) -> SharedPoints | None:
        """The points shared by two of the given images, which have a share of all pixels; None if there is none."""
        images, cover = images.to(self.pixels), self.cover / len(self.pixels) / share
        shared = (torch.isin(self.pixels[:, 0], images) & torch.isin(self.other, images)).nonzero()[:, 0]
        pixels, other, colors, depths = (x[shared] for x in (self.pixels, self.other, self.colors, self.depths))
        return SharedPoints(pixels, other, colors, depths, self.centers, cover * len(shared)) if len(shared) else None

    def draw(
        self,
        count: int,
        rays: Rays,
        generators: Sequence[torch.Generator],
        exposures: Float[Tensor, "M 3"] | None = None,
    ) -> tuple[RayBundle, Float[Tensor, "R C"], Float[Tensor, "R 2"]]:
        """``count`` random rays of each generator from between cameras, with their colours and the inverse distances of
        their points with errors.

        Colours are divided by the ``exposures`` of all training images; None: they are equal.
        """
        device = self.pixels.device
        chosen = random_numbers(len(self.pixels), count, generators).to(device)
        share = torch.cat([torch.rand(count, 1, generator=g, device=g.device) for g in generators]).to(device)
        first = rays(self.pixels[chosen].long())
        depths, colors = self.depths[chosen], self.colors[chosen].float() / 255
        if exposures is not None:
            images = torch.stack([self.pixels[chosen, 0], self.other[chosen]], -1).long()
            colors[..., :3] /= exposures[images]
        origins = torch.lerp(first.origins, self.centers[self.other[chosen].long()], share)
        # Relative to the first camera, so that the direction of distant points stays exact.
        offsets = (first.origins - origins) * depths[:, :1] + first.directions
        length = offsets.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        bundle = RayBundle(origins, offsets / length, torch.ones_like(share), camera_indices=first.camera_indices)
        # The error of a distance along the ray is about that from the first camera.
        return bundle, torch.lerp(colors[:, 0], colors[:, 1], share), depths / torch.cat([length, length**2], -1)


@dataclass(frozen=True)
class Priors:
    """Priors of M training images."""

    observations: Observations
    """Cameras, SfM points and their keypoints."""
    placement: Observations
    """The same with one depth of each image cell, for placement."""
    depths: DepthPriors | None = None
    """Depth and expected error of pixels; None if they were not computed."""
    masks: Sequence[NDArray[np.bool_]] | None = None
    """Masks of moving objects in each image [H, W]; None without any."""
    movers: str = ""
    """Share of moving pixels, in a sentence; empty if it was not computed."""
    gains: Gains | None = None
    """Exposures of the images; None if they are equal."""
    new_views: Callable[..., SharedPoints | None] | None = None
    """Points that two of some images see at the same depth, if any, for images, a device and exposures; None if they
    were not computed."""


@dataclass
class PriorsConfig(InstantiateConfig):
    """Settings of the priors of a capture: here, cameras alone."""

    _target: type = field(default_factory=lambda: PriorsMaker)


class PriorsMaker:
    """Maker of the record from the cameras alone. ``mmpi_priors`` has one that uses the images. ``outputs`` and
    ``dataset`` are the training images', ``rays`` makes rays through their pixels."""

    def __init__(
        self,
        config: PriorsConfig,
        outputs: DataparserOutputs,
        dataset: MMPIDataset,
        parser: DataParserConfig,
        rays: Rays,
        seed: int,
    ) -> None:
        self.outputs, self.dataset, self.parser, self.rays, self.seed = outputs, dataset, parser, rays, seed

    def observe(self, find_points: bool) -> Observations:
        """Training cameras and SfM points. Without ``find_points``, images are not read and may be absent."""
        return camera_observations(self.dataset.cameras, self.dataset.image_filenames)

    def make(self) -> Priors:
        """All priors. Raises InputError naming an image, mask or depth image that cannot be used."""
        observations = self.observe(find_points=True)
        return Priors(observations, observations)
