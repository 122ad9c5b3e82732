"""Where rays cross the planes of a scene's MPIs (paper sec. III-B), in closed form."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import PlaneHits


def plane_hits(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    layout: SceneLayout,
) -> PlaneHits:
    """``geometry.plane_hits``, which says how, in the MPIs of a scene."""
    return dispatch.run("plane_hits", origins, directions, nears, fars, layout)
