"""A baked window: a field as bricks of 8-bit codes, the network that shades its rays, and its rendering.

Blending looks up, for every sample, the reliability of each head that covers its position (paper sec. III-C). The
resulting share depends on the position alone, so a baked texel stores the blended optical depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.blending import blended_optical_depth, log_shares
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import CHANGE, MOST_CHANGE, RayShader
from mmpi_ns.ops.ends import NEGLIGIBLE
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.march import Rays
from mmpi_ns.rendering.rendered import BACKGROUNDS
from mmpi_ns.scene import geometry
from mmpi_ns.scene.bricks import columns_from
from mmpi_ns.scene.texels import BRICK, TexelGrid
from mmpi_ns.scene.texels import SIDE as TILE
from mmpi_show.ops.baked import render_baked
from mmpi_show.scene import CELLS, MOST_CHANNELS, SIDE, BakedMpis, Codes, Shader

if TYPE_CHECKING:
    from mmpi_ns.model import MMPIModel

THINNEST = -12.0
"""Lower bound on the raw density of code 0; its softplus is 6e-6."""
HIGHEST_COLOR, HIGHEST_FEATURE = 191, 96
"""Largest codes of a colour channel and of a feature. These lose 0.0007 of SSIM; 255 for both loses 0.0003 and is a
fifth larger, 127 for both loses 0.0011."""
AT_ONCE_BRICKS = 2**13
"""Bricks that are baked together."""
AT_ONCE = 2**18
"""Rays whose weights are computed together: all of a 12-megapixel photo would take gigabytes."""


@dataclass(frozen=True, eq=False)
class BakedWindow:
    """One baked window, ready to render."""

    mpis: BakedMpis
    shader: Shader
    ray_near: float
    threshold: float
    """Weight below which samples are not shaded."""
    background: float = 0.5
    """Grey level of the background."""
    farthest: float = 1e3
    """Distance that stands for infinity in depth images."""
    exposure: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Exposure of images relative to the texels' colours."""
    seen: Float[Tensor, "B"] | None = None
    """Sum of the largest weights of each brick's texels in training views; None: not computed."""

    def render(self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]) -> dict[str, Tensor]:
        """rgb, accumulation, depth, winning MPI and dropped mass of rays, like those of the model.

        Args:
            origins: of the rays, on the CPU.
            directions: of the rays, unit vectors.
        """
        marched = render_baked(self.mpis, self.rays(origins, directions), self.threshold)
        shaded = self.shader.shade(marched.gathered, marched.mass, directions)
        rgb = torch.where(marched.mass > 0, shaded * shaded.new_tensor(self.exposure), 0.0)
        return {
            "rgb": (rgb * marched.accumulation + self.background * marched.transmittance).clamp(0, 1),
            "accumulation": marched.accumulation,
            "depth": 1 / marched.inverse_t.clamp(min=1 / self.farthest),
            "winning_mpi": marched.winner,
            "dropped_mass": marched.dropped_mass,
        }

    def rays(self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]) -> Rays:
        """Rays from ``ray_near`` to infinity."""
        nears = torch.full_like(origins[:, :1], self.ray_near)
        return Rays(origins, directions, nears, torch.full_like(nears, torch.inf))

    def peaks(self, views: Iterable[tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]]) -> Float[Tensor, "B 8 8"]:
        """Largest weight of each texel among the samples of some views, given by origins and unit directions of their
        rays."""
        peaks = torch.zeros(self.mpis.density.shape)
        for view in views:
            for part in zip(*(x.split(AT_ONCE) for x in view), strict=True):
                render_baked(self.mpis, self.rays(*part), self.threshold, peaks)
        return peaks

    def keep(self, kept: Bool[Tensor, "B"]) -> BakedWindow:
        """The same window with only some of the bricks."""
        mpis, columns, first = self.mpis, [], 0
        for numbers in mpis.brick_numbers():
            columns_here, places = columns_from((numbers >= 0) & kept[numbers.clamp(min=0)], first)
            columns.append(columns_here)
            first += len(places)
        tables = {"columns": torch.cat(columns), "density": mpis.density[kept], "texels": mpis.texels[kept]}
        seen = None if self.seen is None else self.seen[kept]
        return replace(self, mpis=replace(mpis, **tables, packed={}), seen=seen)


@torch.no_grad()
def bake(model: MMPIModel, field: MMPIField) -> BakedWindow:
    """A window of a model as bricks of 8-bit codes: all that are not empty.

    Args:
        model: with the settings of rendering, and the exposures of its training images.
        field: of the window.

    Raises:
        ValueError: the field has a cube, too many channels, or a network for every sample.
    """
    plan, network, grids = field.plan, field.networks, field.grids
    if not isinstance(network, RayShader):
        raise ValueError(
            "A model whose samples are coloured one by one cannot be baked: train with "
            "--pipeline.model.colour.shading ray."
        )
    if plan.cube is not None:
        raise ValueError("A model with a cube cannot be baked: train one of MPIs alone (placement.cube-voxels 0).")
    if (count := field.feature_channels) > MOST_CHANNELS:
        raise ValueError(f"A model of {count} channels a texel cannot be baked: {MOST_CHANNELS} is the most.")
    shares = bake_shares(field) if field.blends else None
    reached = [_reached(grid) for grid in grids]
    parts = [(k, part) for k, tiles in enumerate(reached) for part in tiles.nonzero().split(AT_ONCE_BRICKS)]
    highest = max((float(_raw(field, k, part, shares).max()) for k, part in parts), default=THINNEST)
    density_codes = Codes.spanning(THINNEST, max(highest, THINNEST + 1))
    for k, part in parts:  # bricks without stored texels are dropped
        reached[k][tuple(part.T)] = density_codes.encode(_raw(field, k, part, shares)).amax((-1, -2)) > 0
    features = field.features.data
    most = [HIGHEST_COLOR] * COLORS + [HIGHEST_FEATURE] * (features.shape[1] - COLORS)
    ranges = zip(features.amin(0).tolist(), features.amax(0).tolist(), most, strict=True)
    channels = tuple(Codes.spanning(*each) for each in ranges)
    columns, density, texels, count = [], [], [], 0
    for k, grid in enumerate(grids):
        stored, places = columns_from(reached[k], count)
        columns, count = [*columns, stored], count + len(places)
        for part in places.split(AT_ONCE_BRICKS):
            density.append(density_codes.encode(_raw(field, k, part, shares)))
            rows, exists = _rows(grid, part)
            codes = torch.stack([c.encode(features[rows, i]) for i, c in enumerate(channels)], -1)
            texels.append((codes * exists[..., None]).cpu())
    tables = torch.cat(columns), torch.cat(density).contiguous(), torch.cat(texels).contiguous()
    mpis = BakedMpis(plan.mpis, tuple(map(field.layout.interval, range(len(grids)))), *tables, density_codes, channels)
    numbers = [x.detach().cpu() for x in network.layers(0)]
    numbers[-2:] = [CHANGE * x for x in numbers[-2:]]
    shader = Shader(tuple(zip(numbers[::2], numbers[1::2], strict=True)), network.frequencies[0], MOST_CHANGE)
    rendering, mean = model.config.rendering, model.exposures.mean
    exposure = (1.0, 1.0, 1.0) if mean is None else tuple(mean.tolist())
    background = BACKGROUNDS[rendering.background]
    return BakedWindow(mpis, shader, plan.ray_near, rendering.threshold, background, plan.farthest, exposure)


def _reached(grid: TexelGrid) -> Bool[Tensor, "P Y X"]:
    """Baked bricks of a head that contain a stored texel."""
    stored = grid.own_tiles.cpu() > 0
    for axis, size in ((1, grid.height), (2, grid.width)):
        first = torch.arange(-(-(size - 1) // CELLS)) * CELLS
        ends = [x.clamp(max=size - 1) // TILE for x in (first, first + CELLS)]
        stored = stored.index_select(axis, ends[0]) | stored.index_select(axis, ends[1])
    return stored


def _rows(grid: TexelGrid, places: Int[Tensor, "B 3"]) -> tuple[Int[Tensor, "B 8 8"], Bool[Tensor, "B 8 8"]]:
    """Rows of the texels of baked bricks at (plane, row, column), and which exist: bricks extend beyond planes."""
    plane, row, column = (x[:, None, None].to(grid.tiles.device) for x in places.unbind(-1))
    steps = torch.arange(SIDE, device=plane.device)
    y, x = row * CELLS + steps[:, None], column * CELLS + steps
    rows = grid.row(plane, y.clamp(max=grid.height - 1), x.clamp(max=grid.width - 1))
    return rows, (y < grid.height) & (x < grid.width)


def _raw(
    field: MMPIField, k: int, places: Int[Tensor, "B 3"], shares: Float[Tensor, "N 1"] | None
) -> Float[Tensor, "B 8 8"]:
    """Raw densities including the biases of the planes, whose softplus gives the blended optical depth; those of
    texels that do not exist have code 0."""
    rows, exists = _rows(field.grids[k], places)
    biases = field.layout.biases[k]
    raw = field.density.data[rows, 0] + biases[places[:, 0].to(biases.device), None, None]
    if shares is not None:
        interval, share = field.layout.interval(k), shares[rows, 0].clamp(0, 1)
        tau = torch.nn.functional.softplus(raw) * interval
        blended = blended_optical_depth(tau, share.log(), torch.log1p(-share))
        tau = torch.where(tau > NEGLIGIBLE, blended, tau / len(field.grids)) / interval
        raw = tau + torch.log(-torch.expm1(-tau.clamp(min=1e-12)))
    return torch.where(exists, raw, THINNEST).cpu()


@torch.no_grad()
def bake_shares(field: MMPIField) -> Float[Tensor, "N 1"]:
    """Shares P of the rows of a field of MPIs, among those that cover the position of the texel; 1 elsewhere."""
    shares, frames = torch.ones_like(field.density), field.layout.frames
    rows = torch.arange(BRICK, len(shares), device=shares.device)
    for k, (grid, mpi) in enumerate(zip(field.grids, field.plan.mpis, strict=True)):
        stored = rows[grid.holds(rows)]
        _, y, x = grid.texel(stored)
        stored = stored[(y < grid.height) & (x < grid.width)]  # tiles extend beyond the borders of a plane
        for part in stored.split(AT_ONCE):
            plane, y, x = (i.to(shares.dtype) for i in grid.texel(part))
            u0, u1, v0, v1 = mpi.extent
            tangents = u0 + x / (grid.width - 1) * (u1 - u0), v0 + y / (grid.height - 1) * (v1 - v0)
            # Rays from the MPI's own origin, to keep precision far from the world's.
            directions = geometry.rotate(frames.axes[k].T, torch.stack([*tangents, torch.ones_like(x)], -1))
            disparity = (mpi.planes - 1 - plane) * mpi.disparity_step + 1 / mpi.far
            samples = (frames.origins[k].expand_as(directions), directions, disparity, torch.full_like(part, k))
            log_share, _ = log_shares(field.layout, field.tables, *samples)
            shares[part, 0] = log_share.exp()
    return shares
