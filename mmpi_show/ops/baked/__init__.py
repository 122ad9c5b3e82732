"""Rays through baked multi-plane images, front to back until they are opaque, as ``mmpi_show/reader.py`` in float64."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import structs
from mmpi_ns.ops.composite import median_inverse_distance, winning_heads
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import OPAQUE_BAKED
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.layout import dense, dense_fields, frame_rows
from mmpi_ns.ops.march import RayOutputs, Rays, ray_outputs
from mmpi_ns.scene.geometry import Frames
from mmpi_show import reader
from mmpi_show.ops import OPS
from mmpi_show.scene import FINENESS, MOST_CHANNELS, BakedMpis, tiles_of


@operation()
def render_baked(
    scene: BakedMpis, rays: Rays, threshold: float, peaks: Float[Tensor, "B 8 8"] | None = None
) -> RayOutputs:
    """Sums of each ray's samples, front to back.

    Args:
        scene: the bricks.
        rays: R rays, rendered by all MPIs.
        threshold: weight below which samples are not summed.
        peaks: of every texel, raised to the largest weight of a sample that reads it.
    """
    window: reader.Window = {  # as the reader has it from a file
        "mpis": [vars(mpi) | {"interval": interval} for mpi, interval in zip(scene.mpis, scene.intervals, strict=True)],
        "density": vars(scene.density_codes),
        "channels": [vars(c) for c in scene.channel_codes],
        "columns_array": scene.columns.numpy().view("uint32"),
        "density_array": scene.density.numpy(),
        "texels_array": scene.texels.numpy(),
    }
    samples = reader.march(window, *(x.double().numpy() for x in rays[:4]))
    inverse_t, weights, heads, texels, _, transmittance = map(torch.from_numpy, samples)
    if peaks is not None and len(scene.density):
        each = weights[..., None].expand(texels.shape)
        peaks.view(-1).scatter_reduce_(0, texels.flatten(), each.flatten().to(peaks), "amax")
    kept = weights > threshold
    weights = torch.where(kept, weights, 0.0)
    starts = torch.arange(len(weights) + 1) * weights.shape[1]
    mass, transmittance = weights.sum(-1, keepdim=True), torch.where(transmittance > OPAQUE_BAKED, transmittance, 0.0)
    outputs = (
        torch.from_numpy(reader.gather(window, samples, kept.numpy())),
        mass,
        transmittance,
        1 - transmittance,
        median_inverse_distance(weights.flatten(), inverse_t.flatten(), starts),
        winning_heads(weights.flatten(), heads.flatten(), starts, len(scene.mpis)),
        (1 - transmittance - mass).clamp(min=0),
    )
    return RayOutputs(*(x.to(rays.origins) for x in outputs))


@render_baked.on_cpu
def render_baked_on_cpu(scene: BakedMpis, rays: Rays, threshold: float, peaks: Tensor | None = None) -> RayOutputs:
    if "cpu" not in scene.packed:
        count, channels = len(scene.mpis), len(scene.channel_codes)
        codes = torch.arange(255 * FINENESS + 1, dtype=torch.float64) / FINENESS
        # Transmittance of a sample of each MPI, at codes 0, 1/8, 2/8, ... 255.
        through = [torch.exp(-scene.optical_depth(k, codes)).float().contiguous() for k in range(count)]
        stacks = []
        for k, mpi in enumerate(scene.mpis):
            u0, u1, v0, v1 = mpi.extent
            scales = ((mpi.width - 1) / (u1 - u0), (mpi.height - 1) / (v1 - v0))
            sizes = (mpi.planes, mpi.height, mpi.width, *tiles_of(mpi)[1:], scene.first_column(k))
            places = map(float, (mpi.disparity_step, 1 / mpi.far, u0, v0, *scales))
            stacks.append((*places, *map(ctypes.c_int32, sizes)))
        low, step = (torch.tensor([getattr(c, name) for c in scene.channel_codes]) for name in ("low", "step"))
        doubled = torch.tensor([1.0] * COLORS + [2.0] * (channels - COLORS))  # tanh x = 2 sigmoid(2 x) - 1
        tables = [
            *dense(scene.columns, dtype=torch.int32),
            # Sixteen channels are read at once, also those of the last texel, and four densities.
            *(pad(x.reshape(-1), (0, MOST_CHANNELS)) for x in dense(scene.density, scene.texels, dtype=torch.uint8)),
            *(pad(doubled * x, (0, MOST_CHANNELS - channels)) for x in (low, step)),
        ]
        # Nothing is read of the rest of ``SceneLayout.constants``.
        mpis = pad(frame_rows(Frames.pack(scene.mpis)), (0, 7))
        scene.packed["cpu"] = structs((count, channels, mpis, structs(*stacks), structs(through), *tables))
    walk = (scene.packed["cpu"], structs(dense_fields(rays)), float(threshold), peaks)
    return ray_outputs("mmpi_render_baked", len(rays.origins), len(scene.channel_codes), *walk, folder=OPS)
