"""Where rays cross planes, compiled; the reference is ``geometry.plane_hits``."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.scene.geometry import FACING_EPS, Frames, PlaneHits


def pack_frames(frames: Frames) -> Float[Tensor, "K 19"]:
    """Frames as the kernels read them: origin, axes, extent, disparity step, last disparity, last plane."""
    last = (frames.num_planes - 1).to(frames.nears.dtype)
    columns = (frames.disparity_steps, frames.last_disparities, last)
    parts = (frames.origins, frames.axes.flatten(1), frames.extents, torch.stack(columns, -1))
    return torch.cat(parts, -1).float().contiguous()


def plane_hits(
    lib: ctypes.CDLL,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    frames: Float[Tensor, "K 19"],
) -> PlaneHits:
    """``geometry.plane_hits``, in float32.

    Args:
        lib: the compiled kernels.
        frames: what ``pack_frames`` made of the MPIs' frames.
        others: as for ``geometry.plane_hits``.
    """
    held = [x.contiguous() for x in (origins, directions, nears, fars, frames)]
    shape = (len(origins), len(frames))
    ranges = [torch.empty(shape, dtype=torch.int64) for _ in range(2)]
    parts = [torch.empty(*shape, width) for width in (2, 2, 3, 3)]
    places = [native.address(x, x.dtype) for x in (*ranges, *parts)]

    def hit(begin: int, end: int) -> None:
        lib.mmpi_plane_hits(
            *(native.address(x) for x in held),
            ctypes.c_int64(len(frames)),
            ctypes.c_float(FACING_EPS),
            *map(ctypes.c_int64, (begin, end)),
            *places,
        )

    native.in_parts(hit, len(origins))
    return PlaneHits(*ranges, *parts)
