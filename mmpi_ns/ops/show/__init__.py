"""What rays show of a scene whose texels hold colours and features, without gradients: images, from march to sums."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import Crossings, MarchOptions
from mmpi_ns.ops.show.reference import Shown

__all__ = ["Shown", "show_rays"]


def show_rays(
    layout: SceneLayout, tables: Tables, features: Float[Tensor, "T C"], rays: Crossings, options: MarchOptions
) -> Shown:
    """What rays gather, how much light they let through, and where. On a GPU nothing is waited for.

    The compiled form on a CPU takes sixteen rays side by side and passes over tiles that are not stored, also where the
    threshold is 0.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        features: colours and features of all texels (``ops.gather``).
        rays: where R rays cross the scene.
        options: see ``ops.march``.
    """
    return dispatch.run("show_rays", layout, tables, features, rays, options)
