"""Rays of a long capture: each is rendered by the windows that it starts in, and the renderings are mixed."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.scene.windows import Window, window_shares


def render_windows(
    bundle: RayBundle,
    windows: tuple[Window, ...],
    render: Callable[[int, RayBundle], dict[str, Tensor]],
    shown: int | None = None,
) -> dict[str, Tensor]:
    """Renders rays by all windows that they start in.

    Args:
        bundle: rays.
        windows: those that are trained.
        render: renders some rays by one window, given its index.
        shown: index of the window that renders all rays; None: those that they start in.
    """
    shares = window_shares(bundle.origins, windows)
    if shown is not None:
        shares = torch.zeros_like(shares).index_fill_(1, torch.tensor([shown], device=shares.device), 1.0)
    parts = {}
    for w in (shares > 0).any(0).nonzero()[:, 0].tolist():
        rays = (shares[:, w] > 0).nonzero()[:, 0]
        parts[w] = rays, render(w, bundle[rays])
    return mix_windows(shares, parts)


def mix_windows(
    shares: Float[Tensor, "R W"], parts: dict[int, tuple[Int[Tensor, "P"], dict[str, Tensor]]]
) -> dict[str, Tensor]:
    """Mixes the renderings of several windows: colours by shares; depth and winner from the one with the largest share.

    Args:
        shares: of each ray and window.
        parts: for each window used, its rays and their outputs.
    """
    mixed: dict[str, Tensor] = {}
    most = shares.argmax(-1)
    for w, (rays, outputs) in parts.items():
        own = (most[rays] == w)[:, None]
        for name, values in outputs.items():
            whole = mixed.setdefault(name, values.new_zeros(len(shares), *values.shape[1:]))
            chooses = name in ("depth", "winning_mpi")
            whole[rays] += values * (own if chooses else shares[rays, w][:, None])
    return mixed
