"""Shading: what a ray shows, from the texels along it.

``ray``: a texel holds a diffuse colour and features of what it shows from elsewhere; both are gathered along the ray by
rendering weights, and one network shades the ray once. ``sample``: a network colours every sample (the paper).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.field.color_network import Networks
from mmpi_ns.ops.composite import Composite
from mmpi_ns.ops.gather import COLORS, RaySums
from mmpi_ns.ops.shade.reference import positional_encoding

Shading = Literal["ray", "sample"]
"""Whether a network is asked once a ray or for every sample."""


CHANGE = 4.0
"""Change of the logarithm of a colour's odds for each unit that the network says: a middle grey then changes by one."""
MOST_CHANGE = 8.0
"""Bound of that change."""
LEAST_MASS = 1e-6
"""Rays whose samples weigh less show next to nothing, whatever colour that is."""


@dataclass(frozen=True)
class RayColors:
    """What rays show without a background, and the colours of the samples along them."""

    rgb: Float[Tensor, "R 3"]
    mass: Float[Tensor, "R 1"]
    """Sum of the weights of the samples below. No gradient reaches the weights from here on."""
    first: Float[Tensor, "R 3"]
    """Sum of weight times colour of each sample."""
    second: Float[Tensor, "R 3"]
    """Sum of weight times squared colour."""

    @staticmethod
    def of_samples(composite: Composite, rgb: Float[Tensor, "R 3"], colors: Float[Tensor, "R S 3"]) -> RayColors:
        """Those of samples with a colour each."""
        weights = composite.weights.detach()[..., None]
        first, second = (weights * colors).sum(1), (weights * colors**2).sum(1)
        return RayColors(rgb, weights.sum(1), first, second)

    def of_rays(self, rays: Int[Tensor, "P"]) -> RayColors:
        """Those of the chosen rays."""
        return RayColors(*(x.index_select(0, rays) for x in (self.rgb, self.mass, self.first, self.second)))


class RayShader(Networks):
    """One network (colour, features, PE(direction)) -> what the view changes in the colour that a ray has gathered.

    Args:
        channels: of a texel: three of the diffuse colour, the others features.
        width: of the hidden layers.
        direction_frequencies: octaves of the positional encoding of directions in world axes.
    """

    def __init__(self, channels: int, width: int, direction_frequencies: int) -> None:
        super().__init__(1, channels + 3 * (1 + 2 * direction_frequencies), width)
        self.direction_frequencies = direction_frequencies

    def forward(self, sums: RaySums, composite: Composite, directions: Float[Tensor, "R 3"]) -> RayColors:
        """What rays show.

        Args:
            sums: what they gathered.
            composite: the weights that it was gathered by.
            directions: unit, world axes.
        """
        mass = composite.weights.sum(-1, keepdim=True)
        rgb = self.shade(sums.gathered, mass, composite.accumulation, directions)
        return RayColors(rgb, sums.mass, sums.first, sums.second)

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
            accumulation: what the rays hold back, with the samples that were dropped.
            directions: unit, world axes.
        """
        mean = gathered / mass.clamp(min=LEAST_MASS)
        encoded = positional_encoding(directions, self.direction_frequencies)
        return accumulation * change_odds(mean[:, :COLORS], self.run(0, torch.cat([mean, encoded], -1)))


def change_odds(color: Float[Tensor, "R 3"], said: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Colours whose odds c / (1 - c) are e^change times those given: sigmoid(logit(c) + change), without the logit.

    So black and white are colours like others, and gradients pass where a clipped sum would end them. The change is
    ``CHANGE`` times what the network says, and bounded: larger factors would magnify the rounding of the colour.
    """
    factor = torch.exp(-MOST_CHANGE * torch.tanh(said * (CHANGE / MOST_CHANGE)))
    return color / (color + (1 - color) * factor)
