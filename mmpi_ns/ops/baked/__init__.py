"""Rays through baked multi-plane images: what each shows, front to back, until it is opaque, and its colour."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march.rays import Rays, Shown
from mmpi_ns.scene.baked import BakedMpis, Shader


def show_baked(scene: BakedMpis, rays: Rays, threshold: float, peaks: Float[Tensor, "B 8 8"] | None = None) -> Shown:
    """What each ray gathers, front to back.

    Args:
        scene: the bricks.
        rays: R rays; all MPIs answer them.
        threshold: samples of less weight are left out of the sums.
        peaks: of every texel, raised to the largest weight of a sample that reads it.
    """
    return dispatch.run("show_baked", scene, rays, threshold, peaks)


def shade_baked(
    shader: Shader,
    gathered: Float[Tensor, "R C"],
    mass: Float[Tensor, "R 1"],
    directions: Float[Tensor, "R 3"],
) -> Float[Tensor, "R 3"]:
    """Colours of rays from what they gathered.

    Args:
        shader: the network.
        gathered: see ``Shown``.
        mass: likewise.
        directions: unit, world axes.
    """
    return dispatch.run("shade_baked", shader, gathered, mass, directions)
