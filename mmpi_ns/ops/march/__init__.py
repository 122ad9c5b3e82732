"""Sample and merge (paper sec. III-B): all heads of a ray at once, front to back, to the samples that matter.

Free of gradients: the field differentiates through the samples that are kept. The compiled forms take the nearest of
all heads' next samples at each step, and end a ray where less than 1e-5 of its light is left (and less than a sample
must weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march.rays import MarchOptions, MergedSamples, Rays, Shown

__all__ = ["MarchOptions", "MergedSamples", "Rays", "Shown", "march", "show_rays"]


def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    """The samples of each ray that matter.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        rays: R rays.
        options: which samples are kept, and how they are blended.
    """
    return dispatch.run("march", layout, tables, rays, options)


def show_rays(
    layout: SceneLayout, tables: Tables, features: Float[Tensor, "T C"], rays: Rays, options: MarchOptions
) -> Shown:
    """What rays gather of colours and features, how much light they let through, and where: pictures, in one pass.

    On a GPU nothing is waited for. The compiled form on a CPU takes sixteen rays abreast and passes over tiles that are
    not stored, also where the threshold is 0.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        features: colours and features of all texels (``ops.gather``).
        rays: R rays.
        options: which samples are kept, and how they are blended.
    """
    return dispatch.run("show_rays", layout, tables, features, rays, options)
