"""Rays of a long capture: each asks the windows that it starts in, and their renderings are mixed."""

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
        render: what one window, by its place among them, shows of some rays.
        shown: the window, by its place among them, that answers all rays; None: those that they start in.
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
    """One rendering of several windows': colours by their shares, depth and winner of the window of most share.

    Args:
        shares: of each ray and window.
        parts: for each window that was asked, which rays, and what it shows of them.
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
