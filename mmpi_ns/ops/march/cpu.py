"""Sample and merge, compiled: ``march.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.build import arguments, call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march.reference import Crossings, MarchOptions, MergedSamples

_FLAT = (torch.int32, torch.int32, *[torch.float32] * 4)
_SLOTS = (torch.int64, torch.int64, *[torch.float32] * 4, torch.bool)


class Rays(ctypes.Structure):
    """``Crossings`` (``cpp/rays.h``)."""

    _fields_ = [
        (n, ctypes.c_void_p)
        for n in ("origins", "directions", "local_origins", "local_directions", "u", "v", "first", "counts")
    ]
    held: list[Tensor]
    """What it points to."""

    @staticmethod
    def of(rays: Crossings) -> Rays:
        origins, directions, hits, first, counts = rays
        parts = (origins, directions, hits.local_origins, hits.local_directions, hits.u, hits.v, first, counts)
        held = [x.contiguous() for x in parts]
        made = Rays(*arguments(held))
        made.held = held
        return made


def how(options: MarchOptions) -> tuple[float, float, ctypes.c_bool]:
    """Threshold, fair share, and whether reliability enters, as the compiled marches take them."""
    return float(options.threshold), float(options.fair_share), ctypes.c_bool(options.blends)


def march(layout: SceneLayout, tables: Tables, rays: Crossings, options: MarchOptions) -> MergedSamples:
    """See ``ops.march``."""
    scene, packed, total = CpuScene.of(layout).with_tables(tables), Rays.of(rays), rays.counts.sum(-1)
    starts = total.cumsum(0) - total
    num_rays, size = len(total), int(total.sum())
    flat = [torch.empty((size, 3) if i == 2 else size, dtype=t) for i, t in enumerate(_FLAT)]
    kept, skipped, dropped = torch.empty(num_rays, dtype=torch.int64), *torch.empty(2, num_rays, 1)
    given = (ctypes.byref(scene), ctypes.byref(packed), starts)
    call_in_parts("mmpi_march", num_rays, given, (*how(options), kept, skipped, dropped, *flat))
    return MergedSamples(*_pack(starts, kept, flat), skipped_total=skipped, dropped_mass=dropped)


def _pack(starts: Tensor, kept: Tensor, flat: list[Tensor]) -> list[Tensor]:
    """Flat samples in slots, packed to the left."""
    shape = (len(kept), max(1, int(kept.max())) if kept.numel() else 1)
    slots = [torch.empty((*shape, 3) if i == 2 else shape, dtype=t) for i, t in enumerate(_SLOTS)]
    call_in_parts("mmpi_pack", len(kept), (starts, kept), (shape[1], *flat, *slots))
    return slots
