"""Total variation of the texels that a batch touched (paper sec. III-E, L_TV)."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.ops.shapes import check_shapes
from mmpi_ns.ops.variation.reference import Scales
from mmpi_ns.scene.texels import BRICK


def total_variation(
    values: Float[Tensor, "U C"],
    table: Float[Tensor, "T C"],
    rows: Int[Tensor, "U"],
    layout: SceneLayout,
    scales: Scales,
) -> Float[Tensor, ""]:
    """Huber loss of the differences of distinct texels with their stored neighbours in the same head.

    Args:
        values: the texels, gathered from the table; with gradients.
        table: the pooled table (held fixed).
        rows: where they came from; those of a brick together.
        layout: of the scene.
        scales: weight of a difference along x, y and z, of each head.
    """
    check_shapes("values U C, table T C, rows U", values, table, rows, T=len(layout.grids[0].places) * BRICK)
    if len(scales) != layout.num_heads:
        raise ValueError(f"scales of {len(scales)} heads where the scene has {layout.num_heads}")
    return dispatch.run("total_variation", values, table, rows, layout, scales)
