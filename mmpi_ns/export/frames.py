"""Rendering of rays of a baked scene, without nerfstudio's models or a checkpoint."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.export.files import BakedScene
from mmpi_ns.rendering.baked import BakedWindow
from mmpi_ns.rendering.windows import mix_windows
from mmpi_ns.scene.windows import window_shares


def render_scene(
    scene: BakedScene, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]
) -> dict[str, Tensor]:
    """Renders rays by the windows that they start in, mixed as in the model."""
    if len(scene.windows) == 1:
        return _render_window(scene.windows[0][1], origins, directions)
    shares = window_shares(origins, tuple(place for place, _ in scene.windows))
    parts = {}
    for w in (shares > 0).any(0).nonzero()[:, 0].tolist():
        rays = (shares[:, w] > 0).nonzero()[:, 0]
        parts[w] = (rays, _render_window(scene.windows[w][1], origins[rays], directions[rays]))
    return mix_windows(shares, parts)


def _render_window(window: BakedWindow, origins: Tensor, directions: Tensor) -> dict[str, Tensor]:
    """Renders rays by one window, to infinity."""
    nears = torch.full_like(origins[:, :1], window.ray_near)
    background = torch.full((3,), window.background)
    return window.render(origins, directions, nears, torch.full_like(nears, torch.inf), background)
