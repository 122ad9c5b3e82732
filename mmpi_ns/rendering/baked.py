"""A baked window: a field as bricks of 8-bit codes with the network that shades its rays, and its rendering.

Blending looks up, for every sample, the reliability of each head that covers its position (paper sec. III-C). The
resulting share depends on the position alone, so a baked texel stores the optical depth that is left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import CHANGE, MOST_CHANGE, RayShader
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.baked import shade_baked, show_baked
from mmpi_ns.ops.blending import blended_optical_depth, log_shares
from mmpi_ns.ops.ends import NEGLIGIBLE
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.march import Rays
from mmpi_ns.scene import geometry
from mmpi_ns.scene.baked import (
    CELLS,
    MOST_CHANNELS,
    SIDE,
    BakedMpis,
    Codes,
    Shader,
    brick_numbers,
    columns_from,
    columns_of,
)
from mmpi_ns.scene.bricks import read_planes, stored_texels
from mmpi_ns.scene.texels import BRICK

Item = TypeVar("Item")

THINNEST = -12.0
"""Lower bound on the raw density of code 0; its softplus is 6e-6."""
HIGHEST_COLOR, HIGHEST_FEATURE = 191, 96
"""Largest codes of a colour channel and of a feature. These lose 0.0007 of SSIM; 255 for both loses 0.0003 and is a
fifth larger, 127 for both loses 0.0011 (docs/export.md)."""
AT_ONCE = 2**18
"""Rays whose weights are looked at together: all of a photo of 12 megapixels would take gigabytes."""

_measuring: ContextVar[bool] = ContextVar("measuring", default=False)


@contextmanager
def exact_images() -> Iterator[None]:
    """Inside, ``render auto`` uses the exact renderer for images of this thread."""
    token = _measuring.set(True)
    try:
        yield
    finally:
        _measuring.reset(token)


def suits_bricks(model_field: MMPIField) -> bool:
    """Decision of ``render auto`` for a field that is not training: bricks if compiled, on a CPU, not for metrics."""
    if _measuring.get() or torch.is_grad_enabled() or why_not_baked(model_field):
        return False
    return dispatch.form_of("show_baked", model_field.features.data) == "cpu"


@dataclass(frozen=True, eq=False)
class BakedWindow:
    """One baked window, ready to render."""

    mpis: BakedMpis
    shader: Shader
    ray_near: float
    threshold: float
    """Samples of less weight are not shaded."""
    background: float = 0.5
    """Grey level behind everything."""
    farthest: float = 1e3
    """Distance that stands for infinity in depth images."""
    exposure: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Colours shown over those of the texels."""

    def render(
        self,
        origins: Float[Tensor, "R 3"],
        directions: Float[Tensor, "R 3"],
        bounds: tuple[Float[Tensor, "R 1"], Float[Tensor, "R 1"]] | None = None,
        background: Float[Tensor, "3"] | None = None,
    ) -> dict[str, Tensor]:
        """rgb, accumulation, depth, winning MPI and dropped mass of rays, like those of the model.

        Args:
            origins: of the rays.
            directions: of the rays, unit vectors.
            bounds: nears and fars of the rays; None: from ``ray_near`` to infinity.
            background: colour behind everything; None: the window's own.
        """
        shown = show_baked(self.mpis, Rays(origins, directions, *(bounds or self.unbounded(origins))), self.threshold)
        shaded = shade_baked(self.shader, shown.gathered, shown.mass, directions)
        rgb = torch.where(shown.mass > 0, shaded * shaded.new_tensor(self.exposure), 0.0)
        behind = self.background if background is None else background
        return {
            "rgb": (rgb * shown.accumulation + behind * shown.transmittance).clamp(0, 1),
            "accumulation": shown.accumulation,
            "depth": 1 / shown.inverse_t.clamp(min=1 / self.farthest),
            "winning_mpi": shown.winner,
            "dropped_mass": shown.dropped_mass,
        }

    def unbounded(self, origins: Float[Tensor, "R 3"]) -> tuple[Float[Tensor, "R 1"], Float[Tensor, "R 1"]]:
        """Nears and fars of rays that see everything."""
        nears = torch.full_like(origins[:, :1], self.ray_near)
        return nears, torch.full_like(nears, torch.inf)

    def peaks(
        self, views: Sequence[Item], rays_of: Callable[[Item], tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]]
    ) -> Float[Tensor, "B 8 8"]:
        """Largest weight of any sample of some views in each texel.

        Args:
            views: whatever ``rays_of`` takes.
            rays_of: origins and unit directions of a view's rays.
        """
        peaks = torch.zeros(self.mpis.density.shape)
        for view in views:
            for o, d in zip(*(x.split(AT_ONCE) for x in rays_of(view)), strict=True):
                show_baked(self.mpis, Rays(o, d, *self.unbounded(o)), self.threshold, peaks)
        return peaks

    def outputs(self, bundle: RayBundle, background: Float[Tensor, "3"]) -> dict[str, Tensor]:
        """The same for a bundle with nears and fars on any device; bricks are read on the CPU."""
        assert bundle.nears is not None and bundle.fars is not None
        bounds = bundle.nears.cpu(), bundle.fars.cpu()
        outputs = self.render(bundle.origins.cpu(), bundle.directions.cpu(), bounds, background.cpu())
        return {name: values.to(bundle.origins.device) for name, values in outputs.items()}

    def keep(self, kept: Bool[Tensor, "B"]) -> BakedWindow:
        """The same window with only some of the bricks."""
        mpis, columns, first = self.mpis, [], 0
        for k, mpi in enumerate(mpis.mpis):
            start = mpis.first_column(k)
            numbers = brick_numbers(mpis.columns[start : start + columns_of(mpi)], mpi)
            columns_here, places = columns_from((numbers >= 0) & kept[numbers.clamp(min=0)], first)
            columns.append(columns_here)
            first += len(places)
        tables = {"columns": torch.cat(columns), "density": mpis.density[kept], "texels": mpis.texels[kept]}
        return replace(self, mpis=replace(mpis, **tables, packed={}))


def why_not_baked(model_field: MMPIField) -> str:
    """Reason why a field cannot be baked, with the remedy; empty if it can."""
    if not isinstance(model_field.networks, RayShader):
        return (
            "A model whose samples are coloured one by one cannot be baked: train with "
            "--pipeline.model.colour.shading ray."
        )
    if model_field.plan.cube is not None:
        return "A model with a cube cannot be baked: train one of MPIs alone (placement.cube-voxels 0)."
    channels = model_field.feature_channels
    if channels > MOST_CHANNELS:
        return f"A model of {channels} channels a texel cannot be baked: {MOST_CHANNELS} is the most."
    return ""


@torch.no_grad()
def bake(
    model_field: MMPIField,
    threshold: float,
    background: float,
    blends: bool = False,
    exposure: tuple[float, ...] = (1.0, 1.0, 1.0),
) -> BakedWindow:
    """A field as bricks of 8-bit codes: all that are not empty.

    Args:
        model_field: what to bake.
        threshold: samples of less weight will not be shaded.
        background: grey level behind everything.
        blends: texels keep the optical depths that blending by reliability leaves at them.
        exposure: of images, relative to the field's.

    Raises:
        ValueError: the field has a cube, too many channels, or a network for every sample.
    """
    if refusal := why_not_baked(model_field):
        raise ValueError(refusal)
    plan, network = model_field.plan, model_field.networks
    assert isinstance(network, RayShader)
    shares, heads = bake_shares(model_field) if blends else None, range(len(plan.mpis))
    highest = max(float(_raw(model_field, k, p, shares).max()) for k in heads for p in _planes(model_field, k))
    density_codes = Codes.spanning(THINNEST, max(highest, THINNEST + 1))
    features = model_field.features.data
    most = [HIGHEST_COLOR] * COLORS + [HIGHEST_FEATURE] * (features.shape[1] - COLORS)
    ranges = zip(features.amin(0).tolist(), features.amax(0).tolist(), most, strict=True)
    channels = tuple(Codes.spanning(*each) for each in ranges)
    columns, density, texels, count = [], [], [], 0
    for k in heads:
        raw = torch.cat([_raw(model_field, k, p, shares) for p in _planes(model_field, k)])
        codes = density_codes.encode(raw)
        blocks = _tiled(codes[..., None])[..., 0]
        holds_texels = _tiled(stored_texels(model_field.grids[k], slice(None)).byte())[..., 0].amax((-1, -2)) > 0
        columns_here, places = columns_from(holds_texels.cpu() & (blocks.amax((-1, -2)) > 0), count)
        columns.append(columns_here)
        density.append(blocks[tuple(places.T)])
        texels.append(_texel_codes(model_field, k, channels, places))
        count += len(places)
    mpis = BakedMpis(
        plan.mpis,
        tuple(model_field.layout.interval(k) for k in heads),
        torch.cat(columns),
        torch.cat(density).contiguous(),
        torch.cat(texels).contiguous(),
        density_codes,
        channels,
    )
    farthest = 10 * max(m.farthest for m in plan.mpis)
    numbers = [x.detach().cpu() for x in network.layers(0)]
    numbers[-2:] = [CHANGE * x for x in numbers[-2:]]
    layers = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    shader = Shader(layers, network.direction_frequencies, MOST_CHANGE)
    return BakedWindow(mpis, shader, plan.ray_near, threshold, background, farthest, exposure)


def _planes(model_field: MMPIField, k: int) -> Iterator[slice]:
    """A few planes at a time."""
    for start in range(0, model_field.plan.mpis[k].planes, 16):
        yield slice(start, min(start + 16, model_field.plan.mpis[k].planes))


def _raw(model_field: MMPIField, k: int, planes: slice, shares: Tensor | None) -> Float[Tensor, "P H W"]:
    """Raw densities including the biases of the planes, whose softplus gives the blended optical depth."""
    grid = model_field.grids[k]
    raw = read_planes(model_field.density.data, grid, planes)[..., 0] + model_field.layout.biases[k][planes, None, None]
    if shares is None:
        return raw.cpu()
    interval = model_field.layout.interval(k)
    share = read_planes(shares, grid, planes)[..., 0].clamp(0, 1)
    tau = torch.nn.functional.softplus(raw) * interval
    blended = blended_optical_depth(tau, share.log(), torch.log1p(-share))
    tau = torch.where(tau > NEGLIGIBLE, blended, tau / len(model_field.grids)) / interval
    return (tau + torch.log(-torch.expm1(-tau.clamp(min=1e-12)))).cpu()


def _texel_codes(
    model_field: MMPIField, k: int, channels: tuple[Codes, ...], places: Tensor
) -> UInt8[Tensor, "B 8 8 C"]:
    """Codes of the channels in some bricks of one MPI."""
    bricks = torch.empty(len(places), SIDE, SIDE, len(channels), dtype=torch.uint8)
    for planes in _planes(model_field, k):
        chosen = ((places[:, 0] >= planes.start) & (places[:, 0] < planes.stop)).nonzero()[:, 0]
        values = read_planes(model_field.features.data, model_field.grids[k], planes).cpu()
        codes = torch.stack([c.encode(values[..., i]) for i, c in enumerate(channels)], -1)
        plane, row, column = places[chosen].unbind(-1)
        bricks[chosen] = _tiled(codes)[plane - planes.start, row, column]
    return bricks


def _tiled(images: Tensor) -> Tensor:
    """Planes [P, H, W, C] in baked bricks [P, Y, X, 8, 8, C], neighbours sharing their border texels."""
    _, height, width, _ = images.shape
    below, right = -(height - 1) % CELLS, -(width - 1) % CELLS
    padded = pad(images, (0, 0, 0, right, 0, below))
    return padded.unfold(1, SIDE, CELLS).unfold(2, SIDE, CELLS).permute(0, 1, 2, 4, 5, 3)


@torch.no_grad()
def bake_shares(field: MMPIField) -> Float[Tensor, "N 1"]:
    """Shares P of all rows of a field's tables, among the heads that cover the position of the texel; 1 elsewhere."""
    shares = torch.ones_like(field.density)
    rows = torch.arange(BRICK, len(shares), device=shares.device)
    for k, grid in enumerate(field.grids):
        stored = rows[grid.holds(rows)]
        z, y, x = grid.texel(stored)
        exists = (y < grid.height) & (x < grid.width)  # tiles extend beyond the borders of a plane
        sizes = torch.tensor([grid.width, grid.height, grid.depth], device=stored.device)
        ndc = (2 * torch.stack([x, y, z], -1)[exists] / (sizes - 1) - 1).to(shares.dtype)
        for part, places in zip(stored[exists].split(AT_ONCE), ndc.split(AT_ONCE), strict=True):
            origins, directions, inverse_t = rays_to(field, k, places)
            local = geometry.LocalRays.of(origins, directions, field.layout.frames)
            numbers = torch.arange(len(part), device=part.device)
            samples = (numbers, local, inverse_t, torch.full_like(numbers, k))
            log_share, _ = log_shares(field.layout, field.reliability, field.touched, *samples)
            shares[part, 0] = log_share.exp()
    return shares


def rays_to(
    field: MMPIField, k: int, ndc: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Rays from a head's own origin to positions in it, to keep precision far from the world origin.

    Args:
        field: of the head.
        k: its number.
        ndc: positions in it.

    Returns:
        Origins, directions (not of unit length), and inverse distances in units of those.
    """
    cube = field.layout.cube
    if k == len(field.plan.mpis):
        assert cube is not None
        return cube.lower.expand_as(ndc), (ndc + 1) / 2 * (cube.upper - cube.lower), torch.ones_like(ndc[:, 0])
    mpi, frames = field.plan.mpis[k], field.layout.frames
    u0, u1, v0, v1 = mpi.extent
    u, v = u0 + (ndc[:, 0] + 1) / 2 * (u1 - u0), v0 + (ndc[:, 1] + 1) / 2 * (v1 - v0)
    disparity = (1 - ndc[:, 2]) / 2 / mpi.near * mpi.depth_share + mpi.last_disparity
    directions = geometry.rotate(frames.axes[k].T, torch.stack([u, v, torch.ones_like(u)], -1))
    return frames.origins[k].expand_as(ndc), directions, disparity
