"""Networks and shading: the colour of a ray from the texels along it.

``ray``: a texel stores a diffuse colour and features for view dependence; both are composited along the ray, and one
network shades the ray once. ``sample``: a network gives every sample its colour (paper, eq. 7 and 10).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mmpi_ns.field.tables import replace_data
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.network import layer_shapes, layers, network
from mmpi_ns.ops.shading import CHANGE, LEAST_MASS, MOST_CHANGE


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
        self.shapes = layer_shapes(inputs, width)
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

    def layers(self, number: int) -> list[Tensor]:
        """Weights and biases of the three layers of one network."""
        return layers(self.weights[number], self.shapes)

    def run(self, number: int, inputs: Float[Tensor, "N I"]) -> Float[Tensor, "N 3"]:
        """Outputs of one network."""
        return network(self.weights[number], inputs, self.width)


def positional_encoding(x: Float[Tensor, "N 3"], frequencies: int) -> Float[Tensor, "N E"]:
    """(x, sin 2^i pi x, cos 2^i pi x) for i < frequencies (NeRF eq. 4)."""
    angles = torch.cat([x[:, :0], *(x * (math.pi * 2.0**i) for i in range(frequencies))], -1)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


class ColorNetworks(Networks):
    """Networks (features, PE(position), PE(direction)) -> rgb for every sample, one for each head."""

    def shade(
        self,
        numbers: Sequence[int],
        sizes: Sequence[int],
        features: Float[Tensor, "N C"],
        ndc: Float[Tensor, "N 3"],
        directions: Float[Tensor, "M 3"],
        rows: Int[Tensor, "N"],
    ) -> Float[Tensor, "N 3"]:
        """Colours in [0, 1] of samples, head behind head: the first three features are their logits, to which a network
        adds the view-dependent part.

        Args:
            numbers: of the heads' networks.
            sizes: samples of each head.
            features: of each sample.
            ndc: position of each sample.
            directions: of each ray in the axes of each head; encoded once.
            rows: direction of each sample.
        """
        position = positional_encoding(ndc, self.frequencies[0])
        direction = positional_encoding(directions, self.frequencies[1]).index_select(0, rows)
        # Split, not sliced: the gradient of a slice is as large as the whole.
        inputs = torch.cat([features, position, direction], -1).split(list(sizes))
        offsets = [self.run(number, x) for number, x in zip(numbers, inputs, strict=True)]
        return torch.sigmoid(features[:, :3] + torch.cat(offsets))


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
        inputs = shader_inputs(gathered, mass, directions, self.frequencies[0])
        return shaded(inputs, self.run(0, inputs), accumulation)


@operation("gpu", kernels="mmpi_ns.ops.shading")
def shader_inputs(
    gathered: Float[Tensor, "R C"], mass: Float[Tensor, "R 1"], directions: Float[Tensor, "R 3"], frequencies: int
) -> Float[Tensor, "R I"]:
    """Mean colours and features of rays, and their encoded directions."""
    return torch.cat([gathered / mass.clamp(min=LEAST_MASS), positional_encoding(directions, frequencies)], -1)


@operation("gpu", kernels="mmpi_ns.ops.shading")
def shaded(
    inputs: Float[Tensor, "R I"], offset: Float[Tensor, "R 3"], accumulation: Float[Tensor, "R 1"]
) -> Float[Tensor, "R 3"]:
    """Colours of rays from their mean ones, the first inputs, and the network's output."""
    return accumulation * change_odds(inputs[:, :COLORS], offset)


def change_odds(color: Float[Tensor, "R 3"], offset: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Colours whose odds c / (1 - c) are multiplied by e^change: sigmoid(logit(c) + change), without the logit.

    Black and white need no special case, and gradients do not vanish as with a clipped sum. The change is ``CHANGE``
    times the network output, and bounded, because larger factors would amplify the rounding of the colour.
    """
    factor = torch.exp(-MOST_CHANGE * torch.tanh(offset * (CHANGE / MOST_CHANGE)))
    return color / (color + (1 - color) * factor)
