"""Rays through baked multi-plane images: what each shows, front to back, until it is opaque, and its colour.

Both are defined by ``reader.py``, in float64.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.baked import reader
from mmpi_ns.ops.composite import median_inverse_distance, winning_heads
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import OPAQUE_BAKED
from mmpi_ns.ops.march.rays import Rays, Shown
from mmpi_ns.scene.baked import BakedMpis, Shader


@operation("cpu")
def show_baked(scene: BakedMpis, rays: Rays, threshold: float, peaks: Float[Tensor, "B 8 8"] | None = None) -> Shown:
    """What each ray gathers, front to back.

    Args:
        scene: the bricks.
        rays: R rays; all MPIs answer them.
        threshold: samples of less weight are left out of the sums.
        peaks: of every texel, raised to the largest weight of a sample that reads it.
    """
    window: reader.Window = {  # as the reader has it from a file
        "mpis": [
            vars(mpi)
            | {"far": None if math.isinf(mpi.far) else mpi.far}
            | {"interval": interval, "first_column": scene.first_column(k)}
            for k, (mpi, interval) in enumerate(zip(scene.mpis, scene.intervals, strict=True))
        ],
        "density": vars(scene.density_codes),
        "channels": [vars(c) for c in scene.channel_codes],
        "columns_array": scene.columns.numpy().view("uint32"),
        "density_array": scene.density.numpy(),
        "texels_array": scene.texels.numpy(),
    }
    samples = reader.march(window, *(x.double().numpy() for x in rays[:4]))
    inverse_t, weights, heads, texels, _, light = map(torch.from_numpy, samples)
    if peaks is not None and len(scene.density):
        each = weights[..., None].expand(texels.shape)
        peaks.view(-1).scatter_reduce_(0, texels.flatten(), each.flatten().to(peaks), "amax")
    kept = weights > threshold
    weights = torch.where(kept, weights, 0.0)
    mass, transmittance = weights.sum(-1, keepdim=True), torch.where(light > OPAQUE_BAKED, light, 0.0)
    shown = (
        torch.from_numpy(reader.gather(window, samples, kept.numpy())),
        mass,
        transmittance,
        1 - transmittance,
        median_inverse_distance(weights, inverse_t, kept),
        winning_heads(weights, heads, len(scene.mpis)),
        (1 - transmittance - mass).clamp(min=0),
    )
    return Shown(*(x.to(rays.origins) for x in shown))


@operation("cpu")
def shade_baked(
    shader: Shader,
    gathered: Float[Tensor, "R C"],
    mass: Float[Tensor, "R 1"],
    directions: Float[Tensor, "R 3"],
) -> Float[Tensor, "R 3"]:
    """Colours of rays from what they gathered.

    Args:
        shader: the network.
        gathered: see ``Shown``.
        mass: likewise.
        directions: unit, world axes.
    """
    numbers = torch.cat([x.flatten() for layer in shader.layers for x in layer])
    layers = [tuple(weights.shape) for weights, _ in shader.layers]
    network = {"direction_octaves": shader.direction_octaves, "layers": layers, "bound": shader.bound}
    mean = (gathered / mass.clamp(min=1e-6)).double().numpy()
    window = {"shader": network, "network_array": numbers.detach().numpy()}
    return torch.from_numpy(reader.shade(window, mean, directions.double().numpy())).to(gathered)
