"""Colours of samples by a network of each head, without gradients: what rendering asks for with ``shading sample``."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shade.reference import SampleNetworks


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
    return dispatch.run("shade", layout, table, networks, axes, directions, places)
