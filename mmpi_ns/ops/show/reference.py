"""What rays show, one operation after the other: march, compositing, and sums of what the samples hold."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.composite import composite_weights, median_inverse_distance, winning_heads
from mmpi_ns.ops.gather import gather_places
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import Crossings, MarchOptions, march


@dataclass(frozen=True)
class Shown:
    """Of every ray."""

    gathered: Float[Tensor, "R C"]
    """Sums of weight times colour and features."""
    mass: Float[Tensor, "R 1"]
    """Sum of weight."""
    transmittance: Float[Tensor, "R 1"]
    accumulation: Float[Tensor, "R 1"]
    inverse_t: Float[Tensor, "R 1"]
    """Inverse distance at half the mass (``ops.composite.median_inverse_distance``)."""
    winner: Float[Tensor, "R 1"]
    """The head that gives most of the mass."""
    dropped_mass: Float[Tensor, "R 1"]


def show_rays(layout: SceneLayout, tables: Tables, features: Tensor, rays: Crossings, options: MarchOptions) -> Shown:
    """See ``ops.show``."""
    m = march(layout, tables, rays, options)
    composite = composite_weights(m.tau, m.valid, m.skipped_before, m.skipped_total)
    sums = gather_places(layout, features, m.places, composite.weights)
    return Shown(
        gathered=sums.gathered,
        mass=composite.weights.sum(-1, keepdim=True),
        transmittance=composite.transmittance,
        accumulation=composite.accumulation,
        inverse_t=median_inverse_distance(composite.weights, m.inverse_t, m.valid),
        winner=winning_heads(composite.weights, m.heads, layout.num_heads),
        dropped_mass=m.dropped_mass,
    )
