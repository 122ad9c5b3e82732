"""Where rays cross planes, compiled: ``hits.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import FACING_EPS, PlaneHits


def plane_hits(origins: Tensor, directions: Tensor, nears: Tensor, fars: Tensor, layout: SceneLayout) -> PlaneHits:
    """See ``ops.hits``."""
    shape = (len(origins), len(layout.mpis))
    made = [torch.empty(shape, dtype=torch.int64) for _ in range(2)] + [torch.empty(*shape, n) for n in (2, 2, 3, 3)]
    given = [x.contiguous() for x in (origins, directions, nears, fars, layout.frame_rows())]
    call_in_parts("mmpi_plane_hits", shape[0], (*given, shape[1], FACING_EPS), made)
    return PlaneHits(*made)
