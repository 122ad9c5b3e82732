"""Where rays cross the planes of a scene's MPIs, in plain torch: ``geometry.plane_hits``, some eighty operations."""

from __future__ import annotations

from torch import Tensor

from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene import geometry
from mmpi_ns.scene.geometry import PlaneHits


def plane_hits(origins: Tensor, directions: Tensor, nears: Tensor, fars: Tensor, layout: SceneLayout) -> PlaneHits:
    """See ``ops.hits``."""
    return geometry.plane_hits(origins, directions, nears, fars, layout.frames)
