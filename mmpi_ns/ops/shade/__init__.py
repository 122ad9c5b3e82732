"""Colours of samples by a network of each head, without gradients: what rendering asks for with ``shading sample``."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shade.reference import SampleNetworks
from mmpi_ns.ops.shapes import check_shapes
from mmpi_ns.scene.texels import BRICK


def shade(
    layout: SceneLayout,
    table: Float[Tensor, "T C"],
    networks: SampleNetworks,
    axes: Float[Tensor, "H 3 3"],
    directions: Float[Tensor, "R 3"],
    places: Places,
) -> Float[Tensor, "R S 3"]:
    """Colours of the valid samples; empty slots are black.

    Args:
        layout: of the scene.
        table: colour features of all texels.
        networks: of all heads.
        axes: of each head, as rows.
        directions: of each ray, world axes.
        places: of the samples.
    """
    encoded = [3 * (1 + 2 * n) for n in (networks.position_frequencies, networks.direction_frequencies)]
    sizes = check_shapes(
        "table T C, axes H 3 3, directions R 3, heads R S, planes R S, ndc R S 3, valid R S",
        *(table, axes, directions, *places),
        T=len(layout.grids[0].places) * BRICK,
        H=layout.num_heads,
    )
    for layers in networks.layers:
        check_shapes("w1 W I, b1 W, w2 W W, b2 W, w3 3 W, b3 3", *layers, I=sizes["C"] + sum(encoded))
    if len(networks.layers) != layout.num_heads:
        raise ValueError(f"networks of {len(networks.layers)} heads where the scene has {layout.num_heads}")
    return dispatch.run("shade", layout, table, networks, axes, directions, places)
