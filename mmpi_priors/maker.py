"""All priors of a capture by one call, for ``ns-train`` and ``mmpi-plan``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray
from PIL import ExifTags, Image
from torch import Tensor

from mmpi_ns.data.dataset import image_and_mask
from mmpi_ns.data.exif import SHOT, positive_number, tags_of
from mmpi_ns.data.posed_images import at_full_size, posed_images
from mmpi_ns.data.priors import DepthPriors, Gains, Priors, PriorsMaker, SharedPoints
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.errors import InputError, log
from mmpi_priors.depth_priors import make_depth_priors, of_cells
from mmpi_priors.moving import moving_masks, share_of_moving
from mmpi_priors.new_views import find_shared_points
from mmpi_priors.observe import drop_masked, observe
from mmpi_priors.photometry import color_ratios, exposure_of_image, image_gains
from mmpi_priors.settings import CapturePriorsConfig


class CapturePriors(PriorsMaker):
    """Computes the priors of a capture that its settings ask for. ``make`` sets the ``moving`` masks of the data
    set."""

    def __init__(self, config: CapturePriorsConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self.config = config

    def observe(self, find_points: bool) -> Observations:
        return observe(
            self.outputs, self.dataset, self.parser, self.config.sfm_path,
            find_points=find_points, triangulates=self.config.triangulate,
            trusts=self.config.trust_cameras,
        )  # fmt: skip

    def make(self) -> Priors:
        config, dataset, observations, movers = self.config, self.dataset, self.observe(find_points=True), ""
        if config.mask_moving and None in dataset.mask_files:
            # A mask file of the user takes precedence.
            masks, doubt = self._moving(observations)
            masks = [mask & (file is None) for mask, file in zip(masks, dataset.mask_files, strict=True)]
            is_masked = any(mask.any() for mask in masks)
            if is_masked or not doubt:
                movers = share_of_moving(masks)
                log(movers + (" (--pipeline.datamanager.priors.mask-moving False keeps them)." if is_masked else "."))
            if doubt:
                log(doubt, "yellow")
            if is_masked:
                dataset.moving = masks
                observations = drop_masked(observations, dataset)
        depths, observations = make_depth_priors(
            self.outputs, observations, dataset, self.rays, dense=config.dense_depth, sensor=config.depth_images
        )
        placement = observations if depths is None else of_cells(observations, depths, dataset)
        gains = self.gains(observations, depths) if config.correct_exposure else None
        gains = gains if gains and gains.matter else None
        priors = Priors(observations, placement, depths, dataset.moving, movers, gains)
        return Priors(**{**vars(priors), "new_views": lambda *chosen: self._new_views(priors, *chosen)})

    def _moving(self, observations: Observations) -> tuple[Sequence[NDArray[np.bool_]], str]:
        """Masks of moving objects in each image, and why they are doubtful; none where lenses cannot be undistorted."""
        shapes = [(int(h), int(w)) for w, h in observations.sizes]
        posed = posed_images(observations, self.dataset)
        if posed is None:
            doubt = "Moving objects are not searched for: a camera is neither perspective nor fisheye, or has a k4."
            return [np.zeros(shape, bool) for shape in shapes], doubt
        return moving_masks(at_full_size(posed), shapes, *observations.tracked)

    def gains(self, observations: Observations, depths: DepthPriors | None) -> Gains | None:
        """Exposures of the training images; None if they are equal."""
        posed = posed_images(observations, self.dataset)
        if depths is None or posed is None or len(posed.files) < 2:
            return None
        ratios = color_ratios(posed, depths, self.rays, lambda i: image_and_mask(self.dataset, i), self.seed)
        if ratios is None:
            return None
        light = np.array([light_of(file) for file in at_full_size(posed).files])
        gains = image_gains(ratios, len(posed.files), light)
        log(gains.describe())
        return gains

    def _new_views(
        self,
        priors: Priors,
        images: Sequence[int],
        device: str | torch.device,
        exposures: Float[Tensor, "M 3"] | None,
    ) -> SharedPoints | None:
        """Points that two of the images, by number, see at the same depth; None without any."""
        posed = posed_images(priors.observations, self.dataset)
        if posed is None or priors.depths is None or priors.depths.share == 0:
            return None
        chosen = images, self.seed, device, exposures
        return find_shared_points(self.dataset, posed, priors.depths, self.rays, *chosen)

    def exposure_of(
        self,
        observations: Observations,
        factors: Float[Tensor, "M 3"],
        falloff: Float[Tensor, "2 3"],
        camera: Cameras,
        observed: Float[Tensor, "H W 3"],
        outputs: dict[str, Tensor],
    ) -> Float[Tensor, "3"] | None:
        """Exposure of an evaluated image, by surfaces that training images near it see too (``exposure_of_image``);
        None without any, or if the images are missing."""
        posed = posed_images(observations, self.dataset)
        if posed is None:
            return None
        try:
            return exposure_of_image(posed, self.dataset, factors, falloff, camera, observed, outputs)
        except (InputError, OSError):  # the training images are gone
            return None


def light_of(file: Path) -> float:
    """Exposure of an image by its EXIF, in arbitrary units: time * sensitivity / aperture squared.

    NaN without an exposure time, as in frames of videos, or if the file is damaged, which is reported when its pixels
    are read.

    Source: CIPA DC-008 (Exif 2.32), tags ExposureTime, PhotographicSensitivity and FNumber.
    """
    try:
        with Image.open(file) as image:
            tags = tags_of(image).get_ifd(ExifTags.IFD.Exif)
    except OSError:
        return float("nan")
    time, aperture, sensitivity = (positive_number(tags.get(tag)) for tag in SHOT[:3])
    return (time or float("nan")) * (sensitivity or 100.0) / (aperture or 1.0) ** 2
