"""Where rays cross planes, compiled: ``hits.cpp``."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.build import addresses, in_parts, library, sizes
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import FACING_EPS, PlaneHits


def _frames(layout: SceneLayout) -> Float[Tensor, "K 19"]:
    """As the kernel reads them: origin, axes, extent, disparity step, last disparity, last plane."""
    frames = layout.frames
    columns = (frames.disparity_steps, frames.last_disparities, frames.num_planes - 1)
    parts = (frames.origins, frames.axes.flatten(1), frames.extents, *(x[:, None] for x in columns))
    return torch.cat([x.float() for x in parts], -1).contiguous()


def plane_hits(origins: Tensor, directions: Tensor, nears: Tensor, fars: Tensor, layout: SceneLayout) -> PlaneHits:
    """See ``ops.hits``."""
    held = [x.contiguous() for x in (origins, directions, nears, fars, layout.once("frames", _frames))]
    shape, lib = (len(origins), len(layout.mpis)), library()
    made = [torch.empty(shape, dtype=torch.int64) for _ in range(2)] + [torch.empty(*shape, n) for n in (2, 2, 3, 3)]
    given, to = (*addresses(held), *sizes(shape[1]), ctypes.c_float(FACING_EPS)), addresses(made)
    in_parts(lambda a, b: lib.mmpi_plane_hits(*given, *sizes(a, b), *to), shape[0])
    return PlaneHits(*made)
