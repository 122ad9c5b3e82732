"""Sample and merge (paper sec. III-B): all heads of a ray at once, front to back, to the samples that matter.

Free of gradients: the field differentiates through the samples that are kept. The compiled forms look up every head's
live samples a few at a time, take the nearest at each step, and end a ray where less than 1e-5 of its light is left
(and less than a sample must weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.blending import BlendForm
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import reference
from mmpi_ns.ops.march.reference import MergedSamples
from mmpi_ns.scene.geometry import PlaneHits


def march(
    layout: SceneLayout,
    tables: Tables,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    hits: PlaneHits,
    first: Int[Tensor, "R H"],
    counts: Int[Tensor, "R H"],
    threshold: float,
    fair_share: float,
    form: BlendForm | None,
    baked: bool = False,
) -> MergedSamples:
    """The samples of each ray that matter.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        origins: ray origins, world axes.
        directions: unit ray directions.
        hits: where the rays cross the planes.
        first: m of each head's nearest live plane; the cube's first sample in the last column, where there is a cube.
        counts: live samples of each head.
        threshold: weight below which a sample is dropped; 0 keeps all and ends no ray early.
        fair_share: bound on the threshold relative to equal weights (``reference.prune``).
        form: how reliability enters; None for not at all. The opacity-keeping form is for ablations: plain torch.
        baked: ``tables.reliability`` holds shares (``baking.bake_shares``).
    """
    given = (layout, tables, origins, directions, hits, first, counts, threshold, fair_share, form, baked)
    if form == "opacity":
        return reference.march(*given)
    return dispatch.run("march", *given)
