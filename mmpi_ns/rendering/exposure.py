"""Exposures of the training images in a model: what images are shown at, and what a test image was taken at."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.scene.near_views import nearest_views
from mmpi_ns.utils.errors import InputError
from mmpi_priors.new_views import image_and_mask
from mmpi_priors.observe import posed_images
from mmpi_priors.photometry import MAX_ANGLE, NEIGHBOURS, SAMPLES, ExposedView, Gains, exposure_of_view

OPAQUE = 0.9
"""Accumulation from which a pixel's depth is that of a surface."""


class Exposures(torch.nn.Module):
    """Colours of each training image over those of the field; empty where all have the same exposure.

    Args:
        gains: of the training images, if they differ.
        centers: positions of the training cameras; None without gains.
    """

    factors: Float[Tensor, "N 3"]
    falloff: Float[Tensor, "2 3"]
    centers: Float[Tensor, "N 3"]

    def __init__(self, gains: Gains | None, centers: Float[Tensor, "N 3"] | None) -> None:
        super().__init__()
        factors, falloff = (np.zeros((0, 3)), np.zeros((2, 3))) if gains is None else (gains.from_field, gains.falloff)
        self.register_buffer("factors", torch.from_numpy(factors).float())
        self.register_buffer("falloff", torch.from_numpy(falloff).float())
        self.register_buffer("centers", torch.zeros(0, 3) if gains is None or centers is None else centers.float())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of images from the checkpoint; what a dictionary lacks stays, as in older checkpoints and
        where nerfstudio loads the rest of a pipeline after its model."""
        state_dict.setdefault(f"{prefix}falloff", self.falloff)
        for name in ("factors", "centers"):
            current = getattr(self, name)
            stored = state_dict.setdefault(prefix + name, current)
            setattr(self, name, torch.empty_like(stored, device=current.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def shown(self, mode: Literal["mean", "nearest"], bundle: RayBundle) -> Float[Tensor, "3"] | None:
        """Exposure that an image is shown at, the mean one or that of the training image taken nearest; None where all
        have the field's."""
        if self.mean is None or mode == "mean" or not len(bundle):
            return self.mean
        return self.factors[(self.centers - bundle.origins.reshape(-1, 3)[0]).norm(dim=-1).argmin()]

    @property
    def mean(self) -> Float[Tensor, "3"] | None:
        """Mean exposure of the training images; None where all have the field's."""
        return self.factors.log().mean(0).exp() if len(self.factors) else None


def exposure_of_image(
    exposures: Exposures, manager: MMPIDataManager, camera: Cameras, observed: Tensor, outputs: dict[str, Tensor]
) -> Float[Tensor, "3"] | None:
    """Exposure of an evaluated image, by surfaces that training images near it show too; None if they show nothing.

    Args:
        exposures: of the training images.
        manager: holds the training images.
        camera: of the evaluated image.
        observed: its colours. [H, W, 3]
        outputs: its rendering, for the depths.
    """
    dataset, posed = manager.train_dataset, posed_images(manager.observations, manager.train_dataset)
    if posed is None:
        return None
    pose = camera.camera_to_worlds.reshape(1, 3, 4).double().cpu().numpy()
    poses, count = np.concatenate([posed.camera_to_worlds, pose]), len(dataset)
    nearest = nearest_views(poses, count, NEIGHBOURS, MAX_ANGLE, apart=False)
    try:
        others = [ExposedView.of(*image_and_mask(dataset, j), None, j) for j in nearest]
    except (InputError, OSError):  # the training images are gone
        return None
    image = (observed.cpu().numpy() * 255).round().astype(np.uint8)
    view = ExposedView.of(image, np.ones(image.shape[:2], np.uint8), None, count)
    seen = view.exposed & (outputs["accumulation"][..., 0] > OPAQUE).cpu().numpy()
    pixels = np.argwhere(seen)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(SAMPLES, len(pixels))).astype(int)]
    coords = torch.from_numpy(pixels + 0.5).float()
    rays = camera.to("cpu").generate_rays(torch.zeros(len(pixels), 1, dtype=torch.long), coords=coords)
    depths = outputs["depth"].cpu()[pixels[:, 0], pixels[:, 1]]
    points = (rays.origins + rays.directions * depths).double().numpy()
    factors, falloff = (x.double().cpu().numpy() for x in (exposures.factors, exposures.falloff))
    exposure = exposure_of_view(view, others, posed, pixels, points, factors, falloff)
    return None if exposure is None else torch.from_numpy(exposure).float().to(exposures.factors)
