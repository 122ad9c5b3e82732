"""Sample and merge (paper sec. III-B): all heads of a ray at once, front to back, to the samples that matter.

Free of gradients: the field differentiates through the samples that are kept. The compiled forms look up every head's
live samples a few at a time, take the nearest at each step, and end a ray where less than 1e-5 of its light is left
(and less than a sample must weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march.reference import Crossings, MarchOptions, MergedSamples

__all__ = ["Crossings", "MarchOptions", "MergedSamples", "march"]


def march(layout: SceneLayout, tables: Tables, rays: Crossings, options: MarchOptions) -> MergedSamples:
    """The samples of each ray that matter.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        rays: where R rays cross it.
        options: which samples are kept, and how they are blended.
    """
    return dispatch.run("march", layout, tables, rays, options)
