"""Rays of a long capture: each is rendered by the windows that it starts in, and the renderings are mixed."""

from __future__ import annotations

from collections.abc import Callable, Collection

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
    in_memory: Collection[int] = (),
) -> dict[str, Tensor]:
    """Outputs of rays from all windows that they start in, one window after the other.

    Args:
        bundle: rays [R].
        windows: those that are trained.
        render: outputs of some rays from one window, given its index. Called once for each window, so that a window is
            read from disk once at most, however many rays there are.
        shown: index of the window that renders all rays; None: those that they start in.
        in_memory: windows to render first, before the reading of another one evicts them.
    """
    shares = window_shares(bundle.origins, windows)
    if shown is not None:
        shares = torch.zeros_like(shares).index_fill_(1, torch.tensor([shown], device=shares.device), 1.0)
    parts = {}
    for w in sorted((shares > 0).any(0).nonzero()[:, 0].tolist(), key=lambda w: w not in in_memory):
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
    for w, (rays, outputs) in sorted(parts.items()):  # sums do not depend on the order of rendering
        own = (most[rays] == w)[:, None]
        for name, values in outputs.items():
            whole = mixed.setdefault(name, values.new_zeros(len(shares), *values.shape[1:]))
            chooses = name in ("depth", "winning_mpi")
            whole[rays] += values * (own if chooses else shares[rays, w][:, None])
    return mixed
