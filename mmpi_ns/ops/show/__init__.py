"""What rays show of a scene whose texels hold colours and features, without gradients: images, from march to sums."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.blending import BlendForm
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.show import reference
from mmpi_ns.ops.show.reference import Shown
from mmpi_ns.scene.geometry import PlaneHits

__all__ = ["Shown", "show_rays"]


def show_rays(
    layout: SceneLayout,
    tables: Tables,
    features: Float[Tensor, "T C"],
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    hits: PlaneHits,
    first: Int[Tensor, "R H"],
    counts: Int[Tensor, "R H"],
    threshold: float,
    form: BlendForm | None,
    baked: bool = False,
) -> Shown:
    """What rays gather, how much light they let through, and where. On a GPU nothing is waited for.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        features: colours and features of all texels (``ops.gather``).
        origins: as for ``ops.march``, like all that follow.
    """
    given = (layout, tables, features, origins, directions, hits, first, counts, threshold, form, baked)
    if form == "opacity":
        return reference.show_rays(*given)
    return dispatch.run("show_rays", *given)
