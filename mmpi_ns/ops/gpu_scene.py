"""Plan data and shared functions of the Triton kernels, the counterpart of ``cpp/scene.h``.

Imported only if Triton is used (``dispatch.py``): the package runs without it.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.texels import BRICK

# Columns of a head's layout. BRICK_OF_TILE and TILE_OF_BRICK are the places, in the same tensor, of the brick of the
# head's first tile and of the tile of the very first brick.
FIRST_TILE, DEPTH, HEIGHT, WIDTH, BIAS, DOWN, ACROSS = map(tl.constexpr, range(7))
BRICK_OF_TILE, TILE_OF_BRICK, INTS = map(tl.constexpr, range(7, 10))
STORED = tl.constexpr(BRICK)
"""First row of a stored brick, for the results of ``row_of``."""


def grids_of(layout: SceneLayout) -> Int[Tensor, "N"]:
    """Addresses of the texels of every head, for ``row_of`` and ``texel_of``: a row of numbers for each head, then the
    brick of every tile and the tile of every brick."""
    if "gpu" in layout.packed:
        return layout.packed["gpu"]
    device, grids, start = layout.frames.origins.device, layout.grids, layout.num_heads * INTS.value
    tiles, places = grids[0].tiles, grids[0].places
    rows = [
        (g.first_tile, g.depth, g.height, g.width, b, g.down, g.across, start + g.first_tile, start + len(tiles))
        for g, b in zip(grids, layout.bias_starts(), strict=True)
    ]
    head = torch.tensor(rows, dtype=torch.int32, device=device).reshape(-1)
    packed = torch.cat([head, tiles.to(device), places.to(device, torch.int32)])
    return layout.packed.setdefault("gpu", packed)


def block_size(size: int, device: torch.device) -> int:
    """Rays or rows per program; more in the interpreter, which runs programs one after the other."""
    return size if device.type == "cuda" else 16 * size


def launch(kernel: Any, size: int, block: int, *arguments: Any, **constants: Any) -> None:
    """Runs a kernel for ``size`` items, ``block`` per program, on the device of its tensors; nothing for no items."""
    if size:
        # Triton launches on the current device, which may not be that of the tensors.
        with torch.cuda.device_of(next(x for x in arguments if isinstance(x, Tensor))):
            kernel[(triton.cdiv(size, block),)](*arguments, **constants)


@triton.jit
def row_of(grids, head, plane, y, x, mask):
    """Row of a head's texel in the pooled tables. Only this and ``texel_of`` depend on how texels are stored.

    Where masked, plane, y and x may be out of range, and so may the row.
    """
    grid = grids + head * INTS
    plane, y, x = plane.to(tl.int32), y.to(tl.int32), x.to(tl.int32)
    tile = (plane * tl.load(grid + DOWN) + (y >> 3)) * tl.load(grid + ACROSS) + (x >> 3)
    brick = tl.load(grids + tl.load(grid + BRICK_OF_TILE) + tile, mask, 0)
    return (brick * 64 + ((y & 7) << 3) + (x & 7)).to(tl.int64)


@triton.jit
def texel_of(grids, row, mask, NUM_HEADS: tl.constexpr):
    """Head, plane, y and x of a row, the inverse of ``row_of``; and whether it is any head's."""
    of_brick = tl.load(grids + tl.load(grids + TILE_OF_BRICK) + (row >> 6), mask, 0)
    held = mask & (of_brick >= 0)
    of_brick = tl.maximum(of_brick, 0)
    head = row.to(tl.int32) * 0
    for k in tl.static_range(1, NUM_HEADS):
        head += (of_brick >= tl.load(grids + k * INTS + FIRST_TILE)).to(tl.int32)
    grid = grids + head * INTS
    tile, across = of_brick - tl.load(grid + FIRST_TILE), tl.load(grid + ACROSS)
    layer = across * tl.load(grid + DOWN)
    plane = tile // layer
    down = (tile - plane * layer) // across
    return head, plane, down * 8 + ((row >> 3) & 7), tile % across * 8 + (row & 7), held


@triton.jit
def samples_of(starts, num_rays, BLOCK: tl.constexpr):
    """Rays of a program, whether they exist, and the first and the number of their samples."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = ray < num_rays
    start = tl.load(starts + ray, inside, 0)
    return ray, inside, start, tl.load(starts + ray + 1, inside, 0) - start


@triton.jit
def vectors(of_rays, ray):
    """Vectors of rays, an array for each axis."""
    at = of_rays + 3 * ray
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)


@triton.jit
def cell(coordinate, size):
    """Lower texel and fraction of a coordinate in [-1, 1] over ``size`` texels; outside it clamps to the border."""
    last = (size - 1).to(tl.float32)
    position = tl.minimum(tl.maximum((coordinate + 1) * (0.5 * last), 0.0), last)
    lower = tl.minimum(tl.floor(position), last - 1)
    return lower.to(tl.int64), position - lower


@triton.jit
def one_minus_exp(tau):
    """1 - e^-tau for tau >= 0, exact also for small tau."""
    t = tl.minimum(tau, 0.5)
    p = 1 - t * (1.0 / 8)
    p = 1 - t * (1.0 / 7) * p
    p = 1 - t * (1.0 / 6) * p
    p = 1 - t * (1.0 / 5) * p
    p = 1 - t * (1.0 / 4) * p
    p = 1 - t * (1.0 / 3) * p
    p = 1 - t * (1.0 / 2) * p
    return tl.where(tau < 0.5, t * p, 1 - tl.exp(-tau))
