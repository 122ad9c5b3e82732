"""Networks and shading: the colour of a ray from the texels along it.

``ray``: a texel stores a diffuse colour and features for view dependence; both are composited along the ray, and one
network shades the ray once. ``sample``: a network gives every sample its colour (paper, eq. 7 and 10).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mmpi_ns.field.tables import replace_data
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.shade import Layers, SampleNetworks, positional_encoding, run_layers

CHANGE = 4.0
"""Change of the log odds of a colour for each unit of network output: a middle grey then changes by one unit."""
MOST_CHANGE = 8.0
"""Maximum of that change."""
LEAST_MASS = 1e-6
"""Rays with less accumulated weight are almost invisible, whatever their colour."""


class Networks(nn.Module):
    """``count`` networks of two hidden layers, inputs -> three numbers, in one pooled parameter.

    Their last layer starts at zero, so the tables learn at their own rate from the first step.

    Args:
        count: of the networks.
        channels: of a texel: three of the diffuse colour, the others features.
        width: of the hidden layers.
        frequencies: octaves of the positional encodings of what follows the channels; of directions last.
    """

    def __init__(self, count: int, channels: int, width: int, *frequencies: int) -> None:
        super().__init__()
        self.width, self.frequencies = width, frequencies
        inputs = channels + sum(3 * (1 + 2 * octaves) for octaves in frequencies)
        self.shapes = [(width, inputs), (width,), (width, width), (width,), (3, width), (3,)]
        self.weights = nn.Parameter(torch.empty(0, sum(math.prod(s) for s in self.shapes)))
        self.resize(count)

    def resize(self, count: int) -> None:
        """Initialises ``count`` equal networks, with PyTorch's default initialisation from a fixed seed."""
        generator = torch.Generator().manual_seed(0)
        parts = []
        for fan_in, shape in zip((s[-1] for s in self.shapes[::2] for _ in range(2)), self.shapes, strict=True):
            bound = 0.0 if shape[0] == 3 else 1 / math.sqrt(fan_in)
            parts.append((torch.rand(math.prod(shape), generator=generator) * 2 - 1) * bound)
        replace_data(self.weights, torch.cat(parts).repeat(count, 1).to(self.weights.device))

    def layers(self, head: int) -> Layers:
        """Three layers of one head's network."""
        parts = self.weights[head].split([math.prod(s) for s in self.shapes])
        return Layers(*(p.view(s) for p, s in zip(parts, self.shapes, strict=True)))


class ColorNetworks(Networks):
    """Networks (features, PE(position), PE(direction)) -> rgb for every sample, one for each head.

    The first three features are colour logits, to which the network adds the view-dependent part.
    """

    def of_heads(self, numbers: Sequence[int]) -> SampleNetworks:
        """Networks of heads, given the number of each head's network."""
        return SampleNetworks(tuple(self.layers(k) for k in numbers), *self.frequencies)


class RayShader(Networks):
    """One network (colour, features, PE(direction in world axes)) -> view-dependent change of the composited colour of
    a ray."""

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
        encoded = positional_encoding(directions, self.frequencies[0])
        said = run_layers(self.layers(0), torch.cat([mean, encoded], -1))
        return accumulation * change_odds(mean[:, :COLORS], said)


def change_odds(color: Float[Tensor, "R 3"], said: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Colours whose odds c / (1 - c) are multiplied by e^change: sigmoid(logit(c) + change), without the logit.

    Black and white need no special case, and gradients do not vanish as with a clipped sum. The change is ``CHANGE``
    times the network output, and bounded, because larger factors would amplify the rounding of the colour.
    """
    factor = torch.exp(-MOST_CHANGE * torch.tanh(said * (CHANGE / MOST_CHANGE)))
    return color / (color + (1 - color) * factor)
