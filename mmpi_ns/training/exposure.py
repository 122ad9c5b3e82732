"""Exposure of training images: a gain and a bias for each image and colour channel.

Driving captures change exposure on the way; a model that must explain one wall in two brightnesses makes up fog.
Affine colours per image as in Urban Radiance Fields (Rematas et al. 2022), with a gauge instead of a network.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mmpi_ns.field.shading import RayColors


def gains_and_biases(settings: Float[Tensor, "I 2 3"]) -> tuple[Float[Tensor, "I 3"], Float[Tensor, "I 3"]]:
    """What images do to colours: gain = I softmax(settings_0) > 0 and bias = settings_1 - mean, over the images.

    Gains have mean 1 and biases mean 0 whatever the settings, so the model itself keeps the mean exposure.
    """
    gains = len(settings) * settings[:, 0].softmax(0)
    return gains, settings[:, 1] - settings[:, 1].mean(0)


def departure(gains: Float[Tensor, "I 3"], biases: Float[Tensor, "I 3"]) -> Float[Tensor, ""]:
    """Mean squared distance from the identity."""
    return ((gains - 1) ** 2 + biases**2).mean()


class Exposure(nn.Module):
    """Gains and biases of all training images; those of the images in use share a gauge.

    Args:
        num_images: training images of the whole capture.
    """

    def __init__(self, num_images: int) -> None:
        super().__init__()
        self.settings = nn.Parameter(torch.zeros(num_images, 2, 3))
        self.images: Int[Tensor, "I"] | None = None
        """Those whose pixels are drawn (a window's); None for all."""

    @torch.no_grad()
    def reset(self) -> None:
        """Every image as it is: another window begins."""
        self.settings.zero_()

    def gains_and_biases(self) -> tuple[Float[Tensor, "I 3"], Float[Tensor, "I 3"]]:
        """Of the images in use."""
        return gains_and_biases(self.settings if self.images is None else self.settings[self.images])

    def forward(self, colors: RayColors, accumulation: Float[Tensor, "R 1"], images: Int[Tensor, "R"]) -> RayColors:
        """Colours as each ray's training image shows them: gain c + bias for every colour c, so gain C + bias A.

        What lies behind (a random background, an observed colour) is not changed, and a ray that gathers nothing is
        given nothing.
        """
        gains, biases = self.gains_and_biases()
        if self.images is not None:
            gains = torch.ones_like(self.settings[:, 0]).index_copy(0, self.images, gains)
            biases = torch.zeros_like(self.settings[:, 1]).index_copy(0, self.images, biases)
        return colors.exposed(accumulation, gains.index_select(0, images), biases.index_select(0, images))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of images from the checkpoint: a capture looked at elsewhere may hold fewer."""
        stored = state_dict.get(prefix + "settings")
        if stored is not None and stored.shape != self.settings.shape:
            self.settings.data = torch.zeros_like(stored, device=self.settings.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
