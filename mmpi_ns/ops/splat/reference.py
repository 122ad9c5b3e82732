"""Gaussians seen by a camera, in plain torch: every Gaussian at every pixel. Source: Kerbl et al. (2023), sec. 4."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

BLUR = 0.3
"""Variance that is added to a projected Gaussian, square pixels."""
FAINTEST, STRONGEST, OPAQUE = 1 / 255, 0.99, 1e-4
"""Alphas below the first are left out, those above the second are that; a pixel with less light left is done."""
NEAREST = 0.01
"""Depth from which Gaussians are seen."""
ASIDE = 1.3
"""Beyond this multiple of the image's tangents a Gaussian is projected as if it were there."""


class Gaussians(NamedTuple):
    """N Gaussians."""

    means: Float[Tensor, "N 3"]
    covariances: Float[Tensor, "N 3 3"]
    alphas: Float[Tensor, "N"]


class View(NamedTuple):
    """A pinhole."""

    to_world: Float[Tensor, "3 4"]
    """From camera axes (x right, y up, looking along -z)."""
    size: tuple[int, int]
    """Width and height, pixels."""
    focal: tuple[float, float]
    center: tuple[float, float]


def splat_image(gaussians: Gaussians, view: View, colors: Tensor) -> Tensor:
    """See ``ops.splat``."""
    weights, passing = _weights(gaussians, view)
    return torch.cat([weights @ colors.to(weights), passing], -1).view(*view.size[::-1], 4).to(colors)


def splat_sums(gaussians: Gaussians, view: View, image: Tensor) -> Tensor:
    """See ``ops.splat``."""
    weights, _ = _weights(gaussians, view)
    pixels = torch.cat([image.reshape(-1, 3), torch.ones(weights.shape[0], 1)], -1)
    return (weights.T @ pixels.to(weights)).to(image)


def splat_opacities(gaussians: Gaussians, view: View, colors: Tensor, shown: Tensor, errors: Tensor) -> Tensor:
    """See ``ops.splat``."""
    weights, passing = _weights(gaussians, view)
    behind = (shown.reshape(-1, 3).double() - weights @ colors.double()) / passing

    def image(logits: Tensor) -> Tensor:
        weights, passing = _weights(gaussians._replace(alphas=torch.sigmoid(logits)), view)
        return weights @ colors.double() + passing * behind

    slopes = torch.autograd.functional.jacobian(image, torch.logit(gaussians.alphas.double()))  # [P, 3, N]
    assert isinstance(slopes, Tensor)
    total = slopes.abs().sum(-1, keepdim=True).clamp(min=1e-6)
    parts = slopes * errors.reshape(-1, 3, 1).double() / total
    return torch.stack([parts.sum((0, 1)), slopes.abs().sum((0, 1))], -1).to(errors)


def _weights(gaussians: Gaussians, view: View) -> tuple[Float[Tensor, "P N"], Float[Tensor, "P 1"]]:
    """Weight of each Gaussian in each pixel, and the light that passes all, in double precision."""
    means, covariances, alphas, to_world = (x.double() for x in (*gaussians, view.to_world))
    turn = to_world[:, :3] * torch.tensor([1.0, -1.0, -1.0])  # x right, y down, z ahead
    x, y, z = ((means - to_world[:, 3]) @ turn).unbind(-1)
    (width, height), (fx, fy), (cx, cy) = view.size, view.focal, view.center
    u, v = fx * x / z + cx, fy * y / z + cy
    limits = [ASIDE * width / (2 * fx), ASIDE * height / (2 * fy)]
    tx, ty = ((p / z).clamp(-limit, limit) for p, limit in zip((x, y), limits, strict=True))
    none = torch.zeros_like(z)
    bend = torch.stack([fx / z, none, -fx * tx / z, none, fy / z, -fy * ty / z], -1).view(-1, 2, 3) @ turn.T
    spread = bend @ covariances @ bend.mT + BLUR * torch.eye(2)
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = torch.stack([columns.reshape(-1, 1) - u, rows.reshape(-1, 1) - v], -1)  # [P, N, 2]
    alpha = alphas * torch.exp(-0.5 * torch.einsum("pni,nij,pnj->pn", away, torch.linalg.inv(spread), away))
    alpha = torch.where((z > NEAREST) & (alpha >= FAINTEST), alpha.clamp(max=STRONGEST), 0.0)
    order = torch.sort(z, stable=True).indices
    after = (1 - alpha[:, order]).cumprod(-1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    seen = after > OPAQUE
    weights = torch.empty_like(alpha)
    weights[:, order] = torch.where(seen, alpha[:, order] * before, 0.0)
    nothing = weights.new_ones(len(weights), 1)
    return weights, torch.cat([nothing, torch.where(seen, after, 1.0)], -1).amin(-1, keepdim=True)
