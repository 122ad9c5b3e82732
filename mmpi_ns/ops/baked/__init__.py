"""Rays through baked multi-plane images: what each gathers, front to back, until it is opaque, and its colour."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.baked.reference import Gathered
from mmpi_ns.scene.baked import BakedMpis, Shader


def march_baked(
    scene: BakedMpis,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    threshold: float,
    peaks: Float[Tensor, "B 8 8"] | None = None,
) -> Gathered:
    """What each ray gathers, front to back.

    Args:
        scene: the bricks.
        origins: ray origins, world axes.
        directions: unit ray directions.
        nears: distance at which rays start.
        fars: distance at which rays end; may be inf.
        threshold: samples of less weight are left out of the sums.
        peaks: of every texel, raised to the largest weight of a sample that reads it.
    """
    return dispatch.run("march_baked", scene, origins, directions, nears, fars, threshold, peaks)


def shade_baked(
    shader: Shader,
    sums: Float[Tensor, "R C"],
    mass: Float[Tensor, "R 1"],
    directions: Float[Tensor, "R 3"],
) -> Float[Tensor, "R 3"]:
    """Colours of rays from what they gathered.

    Args:
        shader: the network.
        sums: see ``Gathered``.
        mass: likewise.
        directions: unit, world axes.
    """
    return dispatch.run("shade_baked", shader, sums, mass, directions)
