"""Check that the compiled operations agree with plain torch on this device: values and gradients of a small batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering.rendered import RenderedRays, render_rays

RAYS = 256
"""Rays of the batch."""
CLOSE = 1e-2
"""Maximum difference, as a norm relative to plain torch's. A sample whose weight equals the threshold up to rounding
may be kept by one form alone; a wrong kernel differs by more."""


Losses = Callable[[RenderedRays], dict[str, Tensor]]


def disagreement(field: MMPIField, bundle: RayBundle, options: MarchOptions, losses: Losses) -> str:
    """Description of the differences between compiled operations and plain torch, for rays with nears and fars; empty
    if they agree. ``losses`` are those of rendered rays, means over them."""
    results = {}
    for route in ("auto", "torch"):
        with dispatch.chosen(route), torch.enable_grad():
            results[route] = _values_and_gradients(field, bundle, options, losses)
    return ", ".join(differences(results["torch"], results["auto"]))


Rows = tuple[Int[Tensor, "U"], Float[Tensor, "U C"]]


def _values_and_gradients(
    field: MMPIField, bundle: RayBundle, options: MarchOptions, losses: Losses
) -> dict[str, Rows]:
    """Colours, accumulation, losses and gradients of a fixed linear function of all three, by rows."""
    rays = render_rays(bundle, field, options)
    values, costs = torch.cat([rays.rgb, rays.composite.accumulation], -1), torch.stack([*losses(rays).values()])
    slopes = torch.linspace(-1, 1, values.numel(), device=values.device).view_as(values)
    ((values * slopes).sum() + len(values) * costs.sum()).backward()
    by_rows = {
        name: (torch.arange(len(x), device=x.device), x.detach().double())
        for name, x in (("colours", values), ("losses", costs[:, None]))
    }
    gradients = gradients_of(field)
    for parameter in field.parameters():
        parameter.grad = None
    return by_rows | gradients


def gradients_of(field: MMPIField) -> dict[str, Rows]:
    """Copies of a field's gradients, by rows."""
    gradients = {}
    for name, parameter in field.named_parameters():
        gradient, rows = parameter.grad, parameter.grad_rows if isinstance(parameter, Table) else None
        if gradient is not None:
            rows = torch.arange(len(gradient), device=gradient.device) if rows is None else rows.long().clone()
            gradients[f"gradients of {name}"] = rows, gradient.detach().double().flatten(1)
    return gradients


def differences(reference: dict[str, Rows], others: dict[str, Rows]) -> list[str]:
    """Descriptions of the values that differ by more than ``CLOSE``."""
    wrong = []
    for name, rows in reference.items():
        first, second = _on_same_rows(rows, others[name])
        difference = float((first - second).norm() / first.norm().clamp(min=1e-12))
        if not difference <= CLOSE:  # NaN too
            wrong.append(f"{name} by {difference:.1%}")
    return wrong


def _on_same_rows(first: Rows, second: Rows) -> tuple[Tensor, Tensor]:
    """Values of the rows of either, 0 where one has none."""
    rows = torch.cat([first[0], second[0]]).unique()
    parts = []
    for numbers, values in (first, second):
        whole = values.new_zeros(len(rows), values.shape[1])
        parts.append(whole.index_add(0, torch.searchsorted(rows, numbers), values))
    return parts[0], parts[1]
