"""Shading: the colour of a ray from the texels along it.

``ray``: a texel stores a diffuse colour and features for view dependence; both are composited along the ray, and one
network shades the ray once. ``sample``: a network gives every sample its colour (the paper).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.field.color_network import Networks
from mmpi_ns.ops.composite import Composite
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.shade import positional_encoding, run_layers

Shading = Literal["ray", "sample"]
"""Whether the network is evaluated once a ray or for every sample."""


CHANGE = 4.0
"""Change of the log odds of a colour for each unit of network output: a middle grey then changes by one unit."""
MOST_CHANGE = 8.0
"""Bound of that change."""
LEAST_MASS = 1e-6
"""Rays with less accumulated weight are almost invisible, whatever their colour."""


@dataclass(frozen=True)
class RayColors:
    """Colours of rays without a background, and of the samples along them."""

    rgb: Float[Tensor, "R 3"]
    mass: Float[Tensor, "R 1"]
    """Sum of the weights of the samples below. No gradient reaches the weights from here on."""
    first: Float[Tensor, "R 3"]
    """Sum of weight times colour of each sample."""
    second: Float[Tensor, "R 3"]
    """Sum of weight times squared colour."""

    @staticmethod
    def of_samples(composite: Composite, rgb: Float[Tensor, "R 3"], colors: Float[Tensor, "R S 3"]) -> RayColors:
        """The sums for samples with a colour each."""
        weights = composite.weights.detach()[..., None]
        first, second = (weights * colors).sum(1), (weights * colors**2).sum(1)
        return RayColors(rgb, weights.sum(1), first, second)

    def of_rays(self, rays: Int[Tensor, "P"]) -> RayColors:
        """The sums of the chosen rays."""
        return RayColors(*(x.index_select(0, rays) for x in (self.rgb, self.mass, self.first, self.second)))


class RayShader(Networks):
    """One network (colour, features, PE(direction)) -> view-dependent change of the composited colour of a ray.

    Args:
        channels: of a texel: three of the diffuse colour, the others features.
        width: of the hidden layers.
        direction_frequencies: octaves of the positional encoding of directions in world axes.
    """

    def __init__(self, channels: int, width: int, direction_frequencies: int) -> None:
        super().__init__(1, channels + 3 * (1 + 2 * direction_frequencies), width)
        self.direction_frequencies = direction_frequencies

    def shade(
        self,
        gathered: Float[Tensor, "R C"],
        mass: Float[Tensor, "R 1"],
        accumulation: Float[Tensor, "R 1"],
        directions: Float[Tensor, "R 3"],
    ) -> Float[Tensor, "R 3"]:
        """Colours of rays, without a background.

        Args:
            gathered: colours and features of the samples, times their weights.
            mass: the sum of those weights.
            accumulation: of the rays, including the dropped samples.
            directions: unit, world axes.
        """
        mean = gathered / mass.clamp(min=LEAST_MASS)
        encoded = positional_encoding(directions, self.direction_frequencies)
        said = run_layers(self.layers(0), torch.cat([mean, encoded], -1))
        return accumulation * change_odds(mean[:, :COLORS], said)


def change_odds(color: Float[Tensor, "R 3"], said: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Colours whose odds c / (1 - c) are multiplied by e^change: sigmoid(logit(c) + change), without the logit.

    Black and white need no special case, and gradients do not vanish as with a clipped sum. The change is ``CHANGE``
    times the network output, and bounded, because larger factors would amplify the rounding of the colour.
    """
    factor = torch.exp(-MOST_CHANGE * torch.tanh(said * (CHANGE / MOST_CHANGE)))
    return color / (color + (1 - color) * factor)
