"""The individual phase: which MPI renders a training ray (paper sec. III-C, first stage)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.scene.plan import ScenePlan


def individual_rays(
    bundle: RayBundle, plan: ScenePlan, rays_per_mpi: Literal["split", "all"], g: torch.Generator
) -> tuple[RayBundle, Bool[Tensor, "R H"] | None, Float[Tensor, "R K"] | None]:
    """Assigns each ray to one of the MPIs it meets, or to every MPI in turn; the cube is added to each.

    Returns:
        The rays, (all) the heads that each may meet, and (split) priorities of the MPIs.
    """
    num_mpis, device = len(plan.mpis), bundle.origins.device
    if num_mpis == 1:
        return bundle, None, None
    if rays_per_mpi == "split":
        return bundle, None, torch.rand(len(bundle), num_mpis, generator=g, device=device)
    own = torch.arange(num_mpis, device=device).repeat_interleave(len(bundle))
    mask = torch.arange(plan.num_heads, device=device) == own[:, None]
    mask[:, num_mpis:].fill_(True)
    return repeat_rays(bundle, num_mpis), mask, None


def repeat_rays(bundle: RayBundle, times: int) -> RayBundle:
    """All rays, ``times`` times one after the other."""

    def repeat(x: Tensor | None) -> Any:
        return None if x is None else x.repeat(times, *([1] * (x.ndim - 1)))

    return RayBundle(
        origins=repeat(bundle.origins),
        directions=repeat(bundle.directions),
        pixel_area=repeat(bundle.pixel_area),
        camera_indices=repeat(bundle.camera_indices),
        nears=repeat(bundle.nears),
        fars=repeat(bundle.fars),
        metadata={k: repeat(v) for k, v in bundle.metadata.items()},
    )
