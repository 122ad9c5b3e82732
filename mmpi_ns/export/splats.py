"""A baked window as flat Gaussians ("splats"), in the file that every viewer of 3D Gaussian splatting reads.

A texel that training rays see becomes a Gaussian in its plane. Neighbours that agree become one. A splat's colour is
fitted to what rays show at it, as a linear function of the direction: spherical harmonics of degree 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.baked import march_baked, shade_baked, spread_baked
from mmpi_ns.ops.gather.reference import COLORS, activate
from mmpi_ns.rendering.baked import BakedWindow
from mmpi_ns.scene.baked import CELLS, SIDE, brick_numbers, columns_of
from mmpi_ns.utils.files import write_atomically

Rays = tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]

WIDTH = 0.5
"""Standard deviation of a splat, in texels."""
BLUR = 0.3
"""Variance, in square pixels, that rasterisers add to every splat."""
THICKNESS = 0.01
"""Of a splat, in its width."""
LARGEST = 3
"""Most often that four neighbours become one."""
AGREEING_COLOR, AGREEING_FEATURE, AGREEING_ALPHA = 0.04, 0.2, 0.1
"""Neighbours whose colours, features and alphas differ by less are one splat."""
STEADY = 0.02
"""Weight, as a share of a splat's, by which its colour is held to be the same from everywhere."""
SH0, SH1 = 0.28209479177387814, 0.4886025119029199
"""Spherical harmonics: the constant one, and the factor of those of degree 1, -y, z and -x."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians."""

    means: Float[Tensor, "N 3"]
    """World axes, scene units."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations along their own axes."""
    rotations: Float[Tensor, "N 4"]
    """Unit quaternions (w, x, y, z): own axes to the world's."""
    alphas: Float[Tensor, "N"]
    """At their middle."""
    colors: Float[Tensor, "N 4 3"]
    """Red, green and blue seen in direction d are these times (1, d)."""


@dataclass(frozen=True)
class _Texels:
    """Texels of a window, each once though two bricks may share it."""

    places: Int[Tensor, "T 4"]
    """MPI, plane, row, column."""
    alphas: Float[Tensor, "T"]
    depths: Float[Tensor, "T"]
    """Optical depths."""
    channels: Float[Tensor, "T C"]
    """Colours and features."""
    peaks: Float[Tensor, "T"]
    own: Int[Tensor, "B 8 8"]
    """Which of these each texel of the bricks is; -1 for those outside the plane."""


def splats_of(window: BakedWindow, views: Sequence[Callable[[], Rays]], focal: float, least: float, most: int) -> Splats:
    """A window as splats.

    Args:
        window: baked.
        views: the rays of each training camera.
        focal: of those cameras, pixels: opacities are right where a pixel is as large as theirs.
        least: texels whose samples weigh less in all views are left out.
        most: number of splats; those of least weight are left out.
    """
    peaks = torch.zeros(window.mpis.density.shape)
    changes = [_march(window, view(), peaks) for view in views]
    texels = _texels(window, peaks)
    group, level = _merged(texels, texels.peaks >= least)
    weight = texels.peaks.new_zeros(int(group.max()) + 1).scatter_reduce(0, group[group >= 0], texels.peaks[group >= 0], "amax")
    kept = torch.full((len(weight),), -1)
    chosen = weight.argsort(descending=True)[:most].sort().values
    kept[chosen] = torch.arange(len(chosen))
    group = torch.where(group >= 0, kept[group.clamp(min=0)], -1)
    of_bricks = torch.where(texels.own >= 0, group[texels.own.clamp(min=0)], -1).to(torch.int32)
    moments = torch.zeros(len(chosen), 22)
    for view, change in zip(views, changes, strict=True):
        origins, directions = view()
        nears = torch.full_like(origins[:, :1], window.ray_near)
        fars = torch.full_like(nears, torch.inf)
        spread_baked(window.mpis, origins, directions, nears, fars, window.threshold, change, of_bricks, moments)
    inside = group >= 0
    return _placed(window, texels, group[inside], level[inside], inside, focal, _colors(moments))


def _march(window: BakedWindow, rays: Rays, peaks: Tensor) -> Float[Tensor, "R 3"]:
    """Raises the texels' peaks; returns how the network changes the logarithm of the odds of each ray's colour."""
    origins, directions = rays
    nears = torch.full_like(origins[:, :1], window.ray_near)
    fars = torch.full_like(nears, torch.inf)
    found = march_baked(window.mpis, origins, directions, nears, fars, window.threshold, peaks)
    shown = shade_baked(window.shader, found.sums, found.mass, directions)
    gathered = found.sums[:, :COLORS] / found.mass.clamp(min=1e-6)
    return torch.where(found.mass > 0, torch.logit(shown, 1e-5) - torch.logit(gathered, 1e-5), 0.0)


def _texels(window: BakedWindow, peaks: Float[Tensor, "B 8 8"]) -> _Texels:
    mpis, keys, steps = window.mpis, torch.full(peaks.shape, -1), torch.arange(SIDE)
    sizes = torch.tensor([[m.planes, m.height, m.width] for m in mpis.mpis])
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.prod(1).cumsum(0)])
    for k, mpi in enumerate(mpis.mpis):
        first = mpis.first_column(k)
        numbers = brick_numbers(mpis.columns[first : first + columns_of(mpi)], mpi)
        plane, row, column = ((numbers >= 0).nonzero()).unbind(-1)
        y, x = (row * CELLS)[:, None, None] + steps[:, None], (column * CELLS)[:, None, None] + steps
        key = ((plane[:, None, None] + 0) * mpi.height + y) * mpi.width + x + starts[k]
        keys[numbers[plane, row, column].to(torch.int64)] = torch.where((y < mpi.height) & (x < mpi.width), key, -1)
    found, own = keys.unique(return_inverse=True)
    outside = int(found[0] < 0)
    found, own = found[outside:], own - outside
    flat, inside = own.flatten(), own.flatten() >= 0
    gather = lambda values: values.new_zeros(len(found), *values.shape[1:]).index_copy(0, flat[inside], values[inside])  # noqa: E731
    head = torch.searchsorted(starts, found, right=True) - 1
    place, (_, height, width) = found - starts[head], sizes[head].unbind(-1)
    places = torch.stack([head, place // (height * width), place // width % height, place % width], -1)
    codes = gather(mpis.density.flatten()).float()
    depths = torch.empty_like(codes)
    for k in range(len(mpis.mpis)):
        depths[head == k] = mpis.optical_depth(k, codes[head == k])
    low, step = (torch.tensor([getattr(c, name) for c in mpis.channel_codes]) for name in ("low", "step"))
    channels = activate(low + step * gather(mpis.texels.flatten(0, 2)).float())
    highest = torch.zeros(len(found)).scatter_reduce(0, flat[inside], peaks.flatten()[inside], "amax")
    return _Texels(places, -torch.expm1(-depths), depths, channels, highest, own)


def _merged(texels: _Texels, wanted: Tensor) -> tuple[Int[Tensor, "T"], Int[Tensor, "T"]]:
    """Group of each wanted texel (-1 for the others), and how often four became one in it."""
    tolerance = texels.channels.new_tensor([AGREEING_ALPHA] + [AGREEING_COLOR] * COLORS)
    tolerance = torch.cat([tolerance, tolerance.new_full((texels.channels.shape[1] - COLORS,), AGREEING_FEATURE)])
    values = torch.cat([texels.alphas[:, None], texels.channels], -1)[wanted] / tolerance
    head, plane, y, x = texels.places[wanted].unbind(-1)
    wide = int(texels.places.max()) + 1
    level = torch.zeros_like(x)
    name = lambda depth: ((head * wide + plane) * wide + (y >> depth)) * wide + (x >> depth)  # noqa: E731
    for depth in range(1, LARGEST + 1):
        _, parent, count = name(depth).unique(return_inverse=True, return_counts=True)
        index = parent[:, None].expand(values.shape)
        spread = [values.new_zeros(len(count), values.shape[1]).scatter_reduce(0, index, values, how, include_self=False)
                  for how in ("amax", "amin")]  # fmt: skip
        agrees = (count == 4**depth) & ((spread[0] - spread[1]).amax(-1) < 1)
        level = torch.where(agrees[parent], depth, level)
    _, group = (name(level) * (LARGEST + 1) + level).unique(return_inverse=True)
    groups, levels = torch.full(wanted.shape, -1), torch.zeros(wanted.shape, dtype=torch.int64)
    groups[wanted], levels[wanted] = group, level
    return groups, levels


def _colors(moments: Float[Tensor, "N 22"]) -> Float[Tensor, "N 4 3"]:
    """Least squares of colour over (1, direction), by weight; steady where few directions tell."""
    row, column = torch.triu_indices(4, 4)
    squares = moments.new_zeros(len(moments), 4, 4)
    squares[:, row, column] = squares[:, column, row] = moments[:, :10]
    weight = squares[:, 0, 0].clamp(min=1e-6)
    held = STEADY * weight[:, None] * moments.new_tensor([1e-4, 1.0, 1.0, 1.0])
    return torch.linalg.solve(squares + torch.diag_embed(held), moments[:, 10:].view(-1, 4, 3))


def _placed(
    window: BakedWindow, texels: _Texels, group: Tensor, level: Tensor, inside: Tensor, focal: float, colors: Tensor
) -> Splats:
    """Where splats lie, how large they are and how much light they take."""
    count = torch.bincount(group, minlength=len(colors)).float()
    mean = lambda values: torch.zeros(len(colors)).index_add(0, group, values[inside].float()) / count  # noqa: E731
    first = torch.empty(len(colors), dtype=torch.int64)
    first[group] = inside.nonzero()[:, 0]
    head, plane = texels.places[first, :2].unbind(-1)
    size = 2.0 ** torch.zeros(len(colors), dtype=torch.int64).index_copy(0, group, level)
    y, x, depth = mean(texels.places[:, 2]), mean(texels.places[:, 3]), mean(texels.depths)
    means, scales = torch.empty(len(colors), 3), torch.empty(len(colors), 3)
    rotations, alphas = torch.empty(len(colors), 4), torch.empty(len(colors))
    for k, mpi in enumerate(window.mpis.mpis):
        own = head == k
        u0, u1, v0, v1 = mpi.extent
        du, dv = (u1 - u0) / (mpi.width - 1), (v1 - v0) / (mpi.height - 1)
        disparity = (mpi.planes - 1 - plane[own]) * mpi.disparity_step + mpi.last_disparity
        z = 1 / disparity.clamp(min=1 / window.farthest)
        axes = torch.tensor(mpi.axes)
        local = torch.stack([(u0 + x[own] * du) * z, (v0 + y[own] * dv) * z, z], -1)
        means[own] = torch.tensor(mpi.origin) + local @ axes
        sides = torch.stack([size[own] * du, size[own] * dv], -1)
        scales[own] = torch.cat([WIDTH * sides, THICKNESS * sides[:, :1]], -1) * z[:, None]
        rotations[own] = quaternion(axes.T)
        # Splats of this spacing sum up to so many times their middle, as a rasteriser blurs them.
        overlap = 2 * math.pi * (WIDTH**2 + BLUR / (focal * sides) ** 2).prod(-1).sqrt()
        alphas[own] = -torch.expm1(-depth[own] / overlap)
    return Splats(means, scales, rotations, alphas.clamp(max=0.999), colors)


def quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "4"]:
    """Unit quaternion (w, x, y, z) of a rotation."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    return torch.tensor([w, x, y, z], dtype=torch.float32)


def write_ply(splats: Splats, path: Path) -> int:
    """Writes the layout of Kerbl et al. (2023): logits of opacity, logarithms of scales, spherical harmonics.

    Returns:
        Bytes that were written.

    Raises:
        OSError: the disk is full or cannot be written.
    """
    constant, x, y, z = (splats.colors[:, i] for i in range(4))
    harmonics = torch.stack([-y, z, -x], -1) / SH1  # [N, colour, 3]
    columns = torch.cat([
        splats.means, torch.zeros_like(splats.means), (constant - 0.5) / SH0, harmonics.flatten(1),
        torch.logit(splats.alphas, 1e-4)[:, None], splats.scales.log(), splats.rotations,
    ], -1).numpy().astype("<f4")  # fmt: skip
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9)), "opacity",
             *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]  # fmt: skip
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(columns)}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    data = "\n".join(lines).encode() + np.ascontiguousarray(columns).tobytes()
    write_atomically(path, lambda unfinished: unfinished.write_bytes(data))
    return len(data)
