"""Colours of samples without gradients on a GPU: features, position encoding and colour network in one launch a head.

The reference is ``ColorNetworks.forward`` on looked-up features. Nothing between the features and the colour goes
through memory; what bias and direction of a ray add to the first layer is computed once a ray.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.field.color_network import ColorNetworks, positional_encoding
from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, WIDTH, GpuScene, block_size, cell, row_of, sin_turn
from mmpi_ns.ops.layout import SceneLayout

SAMPLES = 64
"""Of a program."""
LEAST = 16
"""Sides of matrix products are at least so long."""
PRECISION = "tf32x3"
"""Of the products: three reduced ones make one of nearly float32's precision on the tensor cores."""


@triton.jit
def _features(features, grids, head, plane, place, inside, channels, CUBE: tl.constexpr, INPUTS: tl.constexpr):
    """Interpolated features in the first columns, 0 in the others; and the columns."""
    u, v, s = tl.load(place, inside, 0.0), tl.load(place + 1, inside, 0.0), tl.load(place + 2, inside, 0.0)
    grid, column = grids + head * INTS, tl.arange(0, INPUTS)[None, :]
    x, fx = cell(u, tl.load(grid + WIDTH))
    y, fy = cell(v, tl.load(grid + HEIGHT))
    z, fz = plane, u * 0
    if CUBE:
        z, fz = cell(s, tl.load(grid + DEPTH))
    wanted, total = inside[:, None] & (column < channels), u[:, None] * column * 0.0
    for tap in tl.static_range(8 if CUBE else 4):
        dx, dy, dz = tap % 2, tap // 2 % 2, tap // 4
        weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
        row = row_of(grids, head, z + dz, y + dy, x + dx, inside)
        total += weight[:, None] * tl.load(features + row[:, None] * channels + column, wanted, 0.0)
    return total, column


@triton.jit
def shade_kernel(
    features, starts, planes, places, order, grids, first, second, second_bias, third, third_bias, skip, colors,
    head, begin, end, slots, channels, octaves,
    CUBE: tl.constexpr, INPUTS: tl.constexpr, HIDDEN: tl.constexpr, SAMPLES: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Colours of samples begin ... end of the order, all of one head. Matrices are padded with zeros."""
    i = begin + tl.program_id(0) * SAMPLES + tl.arange(0, SAMPLES)
    inside = i < end
    slot = tl.load(order + i, inside, 0)
    place, plane = places + 3 * slot, tl.load(planes + slot, inside, 0)
    inputs, column = _features(features, grids, head, plane, place, inside, channels, CUBE, INPUTS)
    # (x, sin 2^i pi x, cos 2^i pi x) in the order of color_network.positional_encoding.
    group = (column - channels) // 3
    encodes = (column >= channels) & (group < 1 + 2 * octaves)
    position = tl.load(place[:, None] + (column - channels) % 3, inside[:, None] & encodes, 0.0)
    is_cosine = group > octaves
    octave = tl.maximum(group - 1 - tl.where(is_cosine, octaves, 0), 0)
    wave = sin_turn(position * (1 << octave).to(tl.float32) + tl.where(is_cosine, 0.5, 0.0))
    inputs += tl.where(encodes, tl.where(group == 0, position, wave), 0.0)

    unit, row = tl.arange(0, HIDDEN), tl.arange(0, INPUTS)
    hidden = tl.load(starts + (slot // slots)[:, None] * HIDDEN + unit[None, :], inside[:, None], 0.0)
    weights = tl.load(first + row[:, None] * HIDDEN + unit[None, :])
    hidden = tl.maximum(tl.dot(inputs, weights, hidden, input_precision=PRECISION), 0.0)
    weights = tl.load(second + unit[:, None] * HIDDEN + unit[None, :])
    hidden = tl.dot(hidden, weights, input_precision=PRECISION) + tl.load(second_bias + unit)[None, :]
    out = tl.arange(0, 16)
    weights = tl.load(third + unit[:, None] * 16 + out[None, :])
    logits = tl.dot(tl.maximum(hidden, 0.0), weights, input_precision=PRECISION) + tl.load(third_bias + out)[None, :]
    # The first three features are logits too: a product with a part of the identity moves them to their columns.
    logits = tl.dot(inputs, tl.load(skip + row[:, None] * 16 + out[None, :]), logits, input_precision=PRECISION)
    color = 1 / (1 + tl.exp(-logits))
    tl.store(colors + 3 * slot[:, None] + out[None, :], color, inside[:, None] & (out < 3)[None, :])


def _padded(matrix: Tensor, rows: int, columns: int) -> Tensor:
    """With zeros, contiguous."""
    out = torch.zeros(rows, columns, device=matrix.device)
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    return out


def shade(
    layout: SceneLayout,
    features: Float[Tensor, "T C"],
    networks: ColorNetworks,
    directions: Float[Tensor, "H R 3"],
    heads: Int[Tensor, "R S"],
    planes: Int[Tensor, "R S"],
    ndc: Float[Tensor, "R S 3"],
    valid: Bool[Tensor, "R S"],
    precision: str = PRECISION,
) -> Float[Tensor, "R S 3"]:
    """Colours of the valid samples; empty slots are black. ``ops.shade.shade`` on a GPU.

    Waits for the device twice: for the samples, and for how many each head has.

    Args:
        precision: of the matrix products: tf32x3 or tf32 (whole float32 products spill kilobytes of registers).
        others: as for ``ops.shade.shade``.
    """
    (num_rays, slots), num_heads = valid.shape, directions.shape[0]
    channels, octaves = features.shape[1], networks.position_frequencies
    split = channels + 3 * (1 + 2 * octaves)
    inputs, hidden = (max(LEAST, triton.next_power_of_2(n)) for n in (split, networks.width))
    colors = torch.zeros(num_rays, slots, 3, device=features.device)
    index = valid.reshape(-1).nonzero()[:, 0]
    of_head, by = torch.sort(heads.reshape(-1)[index].to(torch.int16), stable=True)
    order, bounds = index[by], torch.arange(num_heads + 1, device=index.device, dtype=torch.int16)
    edges = torch.searchsorted(of_head, bounds).tolist()
    skip = _padded(torch.eye(3, device=features.device), inputs, 16)
    parts = (planes.contiguous(), ndc.contiguous(), order, GpuScene.of(layout).grids)
    for k in range(num_heads):
        begin, end = edges[k], edges[k + 1]
        if begin == end:
            continue
        w1, b1, w2, b2, w3, b3 = (x.detach() for x in networks.layers(k))
        encoded = positional_encoding(directions[k], networks.direction_frequencies)
        start = _padded(torch.addmm(b1, encoded, w1[:, split:].T), num_rays, hidden)
        samples = block_size(SAMPLES, features.device)
        shade_kernel[(triton.cdiv(end - begin, samples),)](
            features, start, *parts, _padded(w1[:, :split].T, inputs, hidden), _padded(w2.T, hidden, hidden),
            _padded(b2[None], 1, hidden), _padded(w3.T, hidden, 16), _padded(b3[None], 1, 16), skip, colors,
            k, begin, end, slots, channels, octaves,
            CUBE=k >= len(layout.mpis), INPUTS=inputs, HIDDEN=hidden, SAMPLES=samples, PRECISION=precision,
            num_warps=8,  # with 4 the registers do not suffice
        )  # fmt: skip
    return colors
