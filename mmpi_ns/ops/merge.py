"""Merge the samples of all heads by distance (paper sec. III-B, "sample and merge")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops.compositing import exclusive_cumsum


@dataclass(frozen=True)
class Merged:
    """Samples of R rays, nearest first, in S slots a ray."""

    order: Int[Tensor, "R S"]
    """Index of each slot's sample in the flat list it came from (0 in empty slots)."""
    valid: Bool[Tensor, "R S"]


def merge(
    slots: Int[Tensor, "N"],
    inverse_t: Float[Tensor, "N"],
    counts: Int[Tensor, "R"],
    presorted: bool,
) -> Merged:
    """Sort flat samples along their rays, nearest first.

    Ties keep the order of the slots, which run over (head, plane), so the result does not depend on the batch.

    Args:
        slots: for each flat sample ray * S + position, positions counting (head, plane) within the ray.
        inverse_t: inverse distance of each flat sample.
        counts: samples of each ray; S = counts.max().
        presorted: every ray met one head only, whose planes already come near to far.
    """
    width = max(1, int(counts.max())) if counts.numel() else 1
    num_rays = counts.shape[0]
    index = torch.zeros(num_rays * width, dtype=torch.int64, device=slots.device)
    index[slots] = torch.arange(slots.shape[0], device=slots.device)
    index = index.view(num_rays, width)
    valid = torch.arange(width, device=slots.device) < counts[:, None]
    if presorted:
        return Merged(index, valid)
    keys = torch.full((num_rays * width,), -1.0, dtype=inverse_t.dtype, device=slots.device)
    keys[slots] = inverse_t
    _, permutation = torch.sort(keys.view(num_rays, width), dim=-1, descending=True, stable=True)
    return Merged(index.gather(-1, permutation), valid)


@dataclass(frozen=True)
class Survivors:
    """The samples that matter, packed to the left, and what the dropped ones leave behind."""

    order: Int[Tensor, "R S"]
    """Index into the flat list (0 in empty slots)."""
    valid: Bool[Tensor, "R S"]
    skipped_before: Float[Tensor, "R S"]
    """Optical depth of the dropped samples in front of each survivor."""
    skipped_total: Float[Tensor, "R 1"]
    dropped_mass: Float[Tensor, "R 1"]
    """Sum of the weights of the dropped samples."""


def keep_survivors(merged: Merged, tau: Float[Tensor, "N"], threshold: float, fair_share: float) -> Survivors:
    """Keep the samples whose weight exceeds min(threshold, fair_share / samples on the ray).

    The second bound matters at the start, when all weights are 1/L: a fixed threshold would keep nothing, and what is
    not kept never learns.

    Args:
        merged: all samples, nearest first.
        tau: blended optical depth of the flat samples.
        threshold: weight below which a sample is dropped once the field has sharpened; 0 keeps all.
        fair_share: the bound relative to equal weights; inf for the threshold alone.
    """
    depth = torch.where(merged.valid, tau[merged.order] if tau.numel() else 0.0, 0.0)
    weights = torch.exp(-exclusive_cumsum(depth)) * -torch.expm1(-depth)
    count = merged.valid.sum(-1, keepdim=True).clamp(min=1)
    bound = (fair_share / count).clamp(max=threshold)
    kept = merged.valid & (weights > bound) if threshold > 0 else merged.valid
    skipped = torch.where(kept, torch.zeros_like(depth), depth)
    before = exclusive_cumsum(skipped)

    number = kept.sum(-1)
    width = max(1, int(number.max())) if number.numel() else 1
    rays, positions = kept.nonzero(as_tuple=True)
    target = rays * width + torch.arange(rays.shape[0], device=rays.device) - (number.cumsum(0) - number)[rays]
    order = torch.zeros(kept.shape[0] * width, dtype=torch.int64, device=tau.device)
    order[target] = merged.order[rays, positions]
    skipped_before = torch.zeros(kept.shape[0] * width, dtype=depth.dtype, device=tau.device)
    skipped_before[target] = before[rays, positions]
    return Survivors(
        order=order.view(-1, width),
        valid=torch.arange(width, device=tau.device) < number[:, None],
        skipped_before=skipped_before.view(-1, width),
        skipped_total=skipped.sum(-1, keepdim=True),
        dropped_mass=torch.where(kept, 0.0, weights).sum(-1, keepdim=True),
    )
