"""Rays through baked multi-plane images, compiled (``baked.cpp``)."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts, structs
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.layout import dense, frame_rows, shaped
from mmpi_ns.ops.march.cpu import shown
from mmpi_ns.ops.march.rays import Rays, Shown
from mmpi_ns.scene.baked import FINENESS, MOST_CHANNELS, SIDE, BakedMpis, Shader, columns_of, tiles_of


def _pack(baked: BakedMpis) -> ctypes.Array:
    """A scene as the kernel reads it."""
    count, bricks, channels = len(baked.mpis), baked.num_bricks, len(baked.channel_codes)
    assert channels <= MOST_CHANNELS
    codes = torch.arange(255 * FINENESS + 1, dtype=torch.float64) / FINENESS
    # Light that passes a sample of each MPI, at codes 0, 1/8, 2/8, ... 255.
    through = [torch.exp(-baked.optical_depth(k, codes)).float().contiguous() for k in range(count)]
    stacks = []
    for k, mpi in enumerate(baked.mpis):
        u0, u1, v0, v1 = mpi.extent
        scales = ((mpi.width - 1) / (u1 - u0), (mpi.height - 1) / (v1 - v0))
        sizes = (mpi.planes, mpi.height, mpi.width, *tiles_of(mpi)[1:], baked.first_column(k))
        places = map(float, (mpi.disparity_step, mpi.last_disparity, u0, v0, *scales))
        stacks.append((*places, *map(ctypes.c_int32, sizes)))
    density = shaped(baked.density, bricks, SIDE, SIDE, dtype=torch.uint8)
    texels = shaped(baked.texels, bricks, SIDE, SIDE, channels, dtype=torch.uint8)
    low, step = (torch.tensor([getattr(c, name) for c in baked.channel_codes]) for name in ("low", "step"))
    doubled = torch.tensor([1.0] * COLORS + [2.0] * (channels - COLORS))  # tanh x = 2 sigmoid(2 x) - 1
    tables = [
        shaped(baked.columns, sum(columns_of(m) for m in baked.mpis), 2, dtype=torch.int32),
        # Sixteen channels are read at once, also those of the last texel, and four densities.
        *(pad(x.reshape(-1), (0, MOST_CHANNELS)) for x in (density, texels)),
        *(pad(doubled * x, (0, MOST_CHANNELS - channels)) for x in (low, step)),
    ]
    frames = shaped(frame_rows(baked.frames), count, 19)
    return structs((count, channels, frames, structs(*stacks), structs(through), *tables))


def show_baked(scene: BakedMpis, rays: Rays, threshold: float, peaks: Tensor | None = None) -> Shown:
    if "cpu" not in scene.packed:
        scene.packed["cpu"] = _pack(scene)
    if peaks is not None:
        assert dense(peaks)[0] is peaks, "peaks are written in place"
    walk = (scene.packed["cpu"], structs(rays.dense()), float(threshold), peaks)
    return shown("mmpi_show_baked", len(rays.origins), len(scene.channel_codes), *walk)


def shade_baked(shader: Shader, gathered: Tensor, mass: Tensor, directions: Tensor) -> Tensor:
    num_rays, channels = gathered.shape
    numbers, inputs = [], channels + 3 * (1 + 2 * shader.direction_octaves)
    for weights, biases in shader.layers:  # alive until the kernel has run
        numbers.append((shaped(weights, len(biases), inputs), shaped(biases, len(biases))))
        inputs = len(biases)
    assert inputs == COLORS, f"a network of {inputs} outputs where a colour is read"
    rgb, sizes = torch.empty(num_rays, 3), (len(numbers), channels, shader.direction_octaves, float(shader.bound))
    layers = structs(*((*weights.shape, weights, biases) for weights, biases in numbers))
    call_in_parts("mmpi_shade_baked", num_rays, layers, *sizes, *dense(gathered, mass, directions), rgb)
    return rgb
