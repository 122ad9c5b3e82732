"""Baked multi-plane images: bricks of 8-bit codes, and the columns that index them (format: docs/export.md).

A baked brick contains 8 x 8 texels of one plane and shares its border texels with its neighbours, so that it covers 7 x
7 cells and a lookup reads only one brick. A column consists of the bricks of one tile in ``WORD`` consecutive planes: a
bit for each occupied plane, and the number of the first brick; the others follow it. One word thus gives the empty
planes that a ray can skip.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from mmpi_ns.field.shading import LEAST_MASS, positional_encoding
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.scene.bricks import WORD
from mmpi_ns.scene.plan import MPIPlan
from mmpi_show import reader

SIDE = 8
"""Texels along each side of a baked brick."""
CELLS = SIDE - 1
"""Cells (squares between four texels) along each side of a baked brick."""
FINENESS = 8
"""Subdivisions between two codes in the table of optical depths of interpolated codes."""
MOST_CHANNELS = 16
"""Maximum channels of a texel."""


@dataclass(frozen=True)
class Codes:
    """Values of 8-bit codes: low + step code."""

    low: float
    step: float

    @staticmethod
    def spanning(low: float, high: float, highest: int = 255) -> Codes:
        """Codes 0 to ``highest`` for values from low to high."""
        return Codes(float(low), max(high - low, 1e-6) / highest)

    def encode(self, values: Tensor) -> UInt8[Tensor, "..."]:
        return ((values - self.low) / self.step).round().clamp(0, 255).to(torch.uint8)


@dataclass(frozen=True, eq=False)
class Shader:
    """The network evaluated once a ray: mean colour, mean features, encoded direction -> change of the colour."""

    layers: tuple[tuple[Float[Tensor, "O I"], Float[Tensor, "O"]], ...]
    """Weights and biases, with max(0, .) between them."""
    direction_octaves: int
    """Frequencies of the direction's positional encoding."""
    bound: float
    """The network's output x changes the odds c / (1 - c) of the mean colour by e^(bound tanh(x / bound))."""

    def shade(
        self, gathered: Float[Tensor, "R C"], mass: Float[Tensor, "R 1"], directions: Float[Tensor, "R 3"]
    ) -> Float[Tensor, "R 3"]:
        """Colours of rays from their sums and masses (``RayOutputs``), and their directions: unit, world axes."""
        mean = gathered / mass.clamp(min=LEAST_MASS)
        x, color = torch.cat([mean, positional_encoding(directions, self.direction_octaves)], -1), mean[:, :COLORS]
        for number, (weights, biases) in enumerate(self.layers):
            x = torch.nn.functional.linear(x.relu_() if number else x, weights, biases)
        return color / (color + (1 - color) * torch.exp(-self.bound * torch.tanh(x / self.bound)))


@dataclass(frozen=True, eq=False)
class BakedMpis:
    """The bricks of K MPIs.

    Args:
        mpis: frames and sizes, at the resolution that was baked.
        intervals: factor on softplus of each MPI.
        columns: of all MPIs one after the other, each [words, down, across]: bits of the planes, and the first brick.
        density: codes of raw densities with the plane's bias.
        texels: codes of the channels of a ray: logits of the diffuse colour, then arguments of the features. They
            are interpolated before the sigmoid and the hyperbolic tangent, as in the exact renderer.
        density_codes: values of the codes of ``density``.
        channel_codes: values of the codes of ``texels``.
    """

    mpis: tuple[MPIPlan, ...]
    intervals: tuple[float, ...]
    columns: Int[Tensor, "N 2"]
    density: UInt8[Tensor, "B 8 8"]
    texels: UInt8[Tensor, "B 8 8 C"]
    density_codes: Codes
    channel_codes: tuple[Codes, ...]
    packed: dict[str, Any] = field(default_factory=dict)
    """Cache of the scene in the layout of the compiled operation."""

    @property
    def num_bricks(self) -> int:
        return len(self.density)

    def first_column(self, k: int) -> int:
        """First column of MPI k; for k = K, the number of columns."""
        return sum(math.prod(tiles_of(m)) for m in self.mpis[:k])

    def brick_numbers(self) -> Iterator[Int[Tensor, "P Y X"]]:
        """Brick of every tile of each MPI; -1 if it is empty."""
        return map(torch.from_numpy, reader.brick_numbers(self.columns.numpy(), list(map(vars, self.mpis))))

    def neighbours(self) -> Int[np.ndarray, "2 B"]:
        """The bricks to the right of each brick and below it, in its plane; -1 if there is none."""
        return reader.neighbours(self.columns.numpy(), list(map(vars, self.mpis)))

    def optical_depth(self, k: int, codes: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """tau of head k from interpolated codes."""
        raw = self.density_codes.low + self.density_codes.step * codes
        return torch.nn.functional.softplus(raw) * self.intervals[k]


def tiles_of(mpi: MPIPlan) -> tuple[int, int, int]:
    """Words of planes, and rows and columns of tiles, of an MPI."""
    return -(-mpi.planes // WORD), -(-(mpi.height - 1) // CELLS), -(-(mpi.width - 1) // CELLS)


def most_of_copies(values: Float[Tensor, "B 8 8"], beside: Int[np.ndarray, "2 B"]) -> Float[Tensor, "B 8 8"]:
    """The largest value among the bricks that share each texel; values are not negative."""
    texels = torch.arange(values.numel()).view(values.shape)
    reader.take_borders(texels.numpy(), beside)
    return torch.zeros(values.numel()).scatter_reduce_(0, texels.flatten(), values.flatten(), "amax")[texels]
