"""Rays of a long capture: each is rendered by the windows that it starts in, and the renderings are mixed."""

from __future__ import annotations

from collections.abc import Callable, Collection

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.scene.windows import Window, window_shares


def render_windows(
    origins: Float[Tensor, "R 3"],
    windows: tuple[Window, ...],
    render: Callable[[int, Int[Tensor, "P"]], dict[str, Tensor]],
    shown: int | None = None,
    in_memory: Collection[int] = (),
) -> dict[str, Tensor]:
    """Outputs of rays from all windows that they start in: colours by shares, depth and winner of the largest share.

    Args:
        origins: of the rays.
        windows: those that are trained.
        render: outputs [P, C] of one window, given its index and the numbers of its rays. Called once for each window,
            so that a window is read from disk once at most, however many rays there are.
        shown: index of the window that renders all rays; None: those that they start in.
        in_memory: windows to render first, before the reading of another one evicts them.
    """
    shares = window_shares(origins, windows)
    if shown is not None:
        shares = torch.zeros_like(shares).index_fill_(1, torch.tensor([shown], device=shares.device), 1.0)
    parts = {}
    for w in sorted((shares > 0).any(0).nonzero()[:, 0].tolist(), key=lambda w: w not in in_memory):
        rays = (shares[:, w] > 0).nonzero()[:, 0]
        parts[w] = rays, render(w, rays)
    mixed: dict[str, Tensor] = {}
    largest = shares.argmax(-1)
    for w, (rays, outputs) in sorted(parts.items()):  # sums do not depend on the order of rendering
        wins = (largest[rays] == w)[:, None]
        for name, values in outputs.items():
            image = mixed.setdefault(name, values.new_zeros(len(shares), *values.shape[1:]))
            image[rays] += values * (wins if name in ("depth", "winning_mpi") else shares[rays, w][:, None])
    return mixed
