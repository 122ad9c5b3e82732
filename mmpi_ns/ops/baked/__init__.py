"""Rays through baked multi-plane images: what each gathers, front to back, until it is opaque, and its colour."""

from __future__ import annotations

from jaxtyping import Float, Int
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


def spread_baked(
    scene: BakedMpis,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    nears: Float[Tensor, "R 1"],
    fars: Float[Tensor, "R 1"],
    threshold: float,
    changes: Float[Tensor, "R 3"],
    groups: Int[Tensor, "B 8 8"],
    moments: Float[Tensor, "G 22"],
) -> None:
    """Adds what rays show at their samples to moments of colour over direction, from which a fit is solved.

    With w the weight of a sample times the share that a texel has in it, b = (1, direction), and t the sample's colour
    with its odds changed as its ray's are, the texel's group receives w b_i b_j (i <= j, row by row: ten sums), then
    w b_i t_c (i before c: twelve).

    Args:
        scene: the bricks.
        origins: as for ``march_baked``, with the four arguments after it.
        directions: likewise.
        nears: likewise.
        fars: likewise.
        threshold: likewise.
        changes: logarithm of what the network multiplies the odds c / (1 - c) of each ray's colour by.
        groups: of every texel; -1 for none. int32.
        moments: what is added to.
    """
    dispatch.run("spread_baked", scene, origins, directions, nears, fars, threshold, changes, groups, moments)


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
