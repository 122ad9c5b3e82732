"""The two-phase training of reliability, from its first step to its last (paper sec. III-C).

``individual``: every MPI is trained alone. A ray is rendered by one of the MPIs that it intersects, or by each in turn,
and by the cube (``assign_heads``). Training rays mark the texels that they read: a head covers points whose nearest
texel is marked.

``blend``: before its first step, texels that no ray has trained are emptied, so that they have no share
(``TexelTables.release_untouched``). Then all heads render each ray, blended by reliability (``mmpi_ns/blending.py``),
and only reliability trains. Texels are no longer marked, so that P is continuous in time.

``finetune``: all parameters train together, rendered likewise (not in the paper).

``joint`` training has one phase of that name, in which all heads render each ray, each MPI with 1/K of the optical
depth, without blending. A scene of one head trains like this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.utils.random_draws import Generators

TRAINS: dict[str, frozenset[str]] = {
    "individual": frozenset({"density", "features", "colour", "camera_opt"}),
    "joint": frozenset({"density", "features", "colour", "camera_opt"}),
    "blend": frozenset({"reliability"}),
    "finetune": frozenset({"density", "features", "colour", "reliability", "camera_opt"}),
}
"""Trainable kinds of parameters of each phase; everything else is frozen bit for bit."""


def phase_lengths(total_steps: int, blend_share: float, finetune_share: float) -> dict[str, int]:
    """Steps of the phases in their order. The first has one, even if rounding up the others would take them all."""
    blend = min(round(total_steps * blend_share), total_steps - 1)
    finetune = min(round(total_steps * finetune_share), total_steps - 1 - blend)
    return {"individual": total_steps - blend - finetune, "blend": blend, "finetune": finetune}


def prepare_parameters(field: MMPIField, groups: Mapping[str, Sequence[Parameter]], phase: str) -> None:
    """Freezes the parameters, by kind, that a phase does not train, before each step. While MPIs train alone, the field
    marks the texels that training rays read."""
    field.marks_texels = phase == "individual"
    for kind, params in groups.items():
        params[0].requires_grad_(kind in TRAINS[phase])


def assign_heads(
    ray_bundle: RayBundle,
    plan: ScenePlan,
    phase: str,
    rays_per_mpi: Literal["split", "all"],
    draws: Generators,
    step: int,
) -> tuple[RayBundle, Bool[Tensor, "R H"] | None, Float[Tensor, "R K"] | None]:
    """Rays of a training batch as its phase renders them.

    While the K MPIs, of H heads, train alone, each ray is for one of them (``split``) or for every one in turn
    (``all``).

    Returns:
        The rays, all of them again for every MPI where each renders all; heads that may render each ray, None for all;
        and priorities of the MPIs: the highest among those that a ray intersects renders it, None for all.
    """
    count, num_mpis, device = len(ray_bundle), len(plan.mpis), ray_bundle.origins.device
    if phase != "individual" or num_mpis == 1:
        return ray_bundle, None, None
    if rays_per_mpi == "split":
        priorities = torch.rand(count, num_mpis, generator=draws.of(step, "assignment"), device=device)
        return ray_bundle, None, priorities
    heads = torch.arange(num_mpis, device=device).repeat_interleave(count)
    head_mask = torch.arange(plan.num_heads, device=device) == heads[:, None]
    head_mask[:, num_mpis:].fill_(True)  # the cube
    return ray_bundle.broadcast_to((num_mpis, count)).flatten(), head_mask, None


def blends_in(phase: str, field: MMPIField) -> bool:
    """Whether a phase blends the heads of a field by reliability."""
    return "reliability" in TRAINS[phase] and field.blends
