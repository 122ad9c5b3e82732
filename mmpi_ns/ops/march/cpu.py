"""Sample and merge, compiled: ``march.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.blending import BlendForm
from mmpi_ns.ops.build import address, addresses, in_parts, library, sizes
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march.reference import MergedSamples
from mmpi_ns.scene.geometry import PlaneHits

NO_BLENDING, PAPERS_FORM, BAKED_SHARES = range(3)
"""How the compiled marches are told in which form reliability enters."""
_FLAT = (torch.int32, torch.int32, *[torch.float32] * 4)
_SLOTS = (torch.int64, torch.int64, *[torch.float32] * 4, torch.bool)


class _Rays(ctypes.Structure):
    _fields_ = [
        (n, ctypes.c_void_p)
        for n in ("origins", "directions", "local_origins", "local_directions", "u", "v", "first", "counts")
    ]


def march(
    layout: SceneLayout,
    tables: Tables,
    origins: Tensor,
    directions: Tensor,
    hits: PlaneHits,
    first: Tensor,
    counts: Tensor,
    threshold: float,
    fair_share: float,
    form: BlendForm | None,
    baked: bool,
) -> MergedSamples:
    """See ``ops.march``."""
    parts = (origins, directions, hits.local_origins, hits.local_directions, hits.u, hits.v, first, counts)
    held = [x.contiguous() for x in parts]  # alive until the rays are marched
    scene, rays, lib = CpuScene.of(layout).with_tables(tables), _Rays(*addresses(held)), library()
    total = counts.sum(-1)
    starts = total.cumsum(0) - total
    num_rays, size = len(total), int(total.sum())
    flat = [torch.empty((size, 3) if i == 2 else size, dtype=t) for i, t in enumerate(_FLAT)]
    kept, left = torch.empty(num_rays, dtype=torch.int64), torch.empty(2, num_rays, 1)
    bounds = (ctypes.c_float(threshold), ctypes.c_float(fair_share))
    blends = NO_BLENDING if form is None else BAKED_SHARES if baked else PAPERS_FORM
    made = addresses((kept, left[0], left[1], *flat))

    def part(begin: int, end: int) -> None:
        given = (ctypes.byref(scene), ctypes.byref(rays), address(starts, torch.int64), *sizes(begin, end))
        lib.mmpi_march(*given, *bounds, blends, *made)

    in_parts(part, num_rays)
    return MergedSamples(*_pack(starts, kept, flat), skipped_total=left[0], dropped_mass=left[1])


def _pack(starts: Tensor, kept: Tensor, flat: list[Tensor]) -> list[Tensor]:
    """Flat samples in slots, packed to the left."""
    num_rays, width, lib = len(kept), max(1, int(kept.max())) if kept.numel() else 1, library()
    slots = [torch.empty((num_rays, width, 3) if i == 2 else (num_rays, width), dtype=t) for i, t in enumerate(_SLOTS)]
    given, made = addresses((starts, kept)), addresses((*flat, *slots))
    in_parts(lambda a, b: lib.mmpi_pack(*given, *sizes(a, b, width), *made), num_rays)
    return slots
