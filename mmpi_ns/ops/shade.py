"""Colours of samples without gradients, compiled; the reference is ``ColorNetworks.forward`` on looked-up features."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.color_network import ColorNetworks, positional_encoding
from mmpi_ns.ops import native
from mmpi_ns.ops.colors import Network
from mmpi_ns.ops.march import SceneTables


class _Shading(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("features", "start", "heads", "planes", "ndc", "valid")] + [
        (n, ctypes.c_int64) for n in ("rows", "num_rays", "slots")
    ]


def shade(
    lib: ctypes.CDLL,
    scene: SceneTables,
    features: Float[Tensor, "T C"],
    networks: ColorNetworks,
    directions: Float[Tensor, "H R 3"],
    heads: Int[Tensor, "R S"],
    planes: Int[Tensor, "R S"],
    ndc: Float[Tensor, "R S 3"],
    valid: Bool[Tensor, "R S"],
) -> Float[Tensor, "R S 3"]:
    """Colours of the valid samples; empty slots are black.

    Args:
        lib: the compiled kernels.
        scene: the plan with its tables.
        features: colour features of all texels.
        networks: the colour networks.
        directions: of each ray, in each head's axes.
        heads: head of each sample.
        planes: its plane.
        ndc: its position in the head.
        valid: which slots hold a sample.
    """
    num_rays, slots = valid.shape
    channels, num_heads = features.shape[1], directions.shape[0]
    split = channels + 3 * (1 + 2 * networks.position_frequencies)
    start = torch.empty(num_heads, num_rays, networks.width)
    held, parts = [], []
    for k in range(num_heads):
        w1, b1, w2, b2, w3, b3 = networks.layers(k)
        encoded = positional_encoding(directions[k], networks.direction_frequencies)
        torch.addmm(b1, encoded, w1[:, split:].T, out=start[k])
        held.append([w1[:, :split].contiguous(), w2.contiguous(), b2, w3.contiguous(), b3])
        sizes = (channels, networks.position_frequencies, networks.width)
        parts.append(Network(*sizes, *(native.address(x) for x in held[-1])))
    slots_held = [heads.contiguous(), planes.contiguous(), ndc.contiguous(), valid.contiguous()]
    shading = _Shading(
        *(native.address(x, x.dtype) for x in (features, start, *slots_held)), len(features), num_rays, slots
    )
    table = (Network * num_heads)(*parts)
    colors = torch.empty(num_rays, slots, 3)

    def part(begin: int, end: int) -> None:
        lib.mmpi_shade(
            ctypes.byref(scene),
            ctypes.byref(shading),
            table,
            *map(ctypes.c_int64, (begin, end)),
            native.address(colors),
        )

    native.in_parts(part, num_rays)
    return colors
