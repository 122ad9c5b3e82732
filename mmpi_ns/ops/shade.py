"""Colours of samples without gradients, compiled; the reference is ``ColorNetworks.forward`` on looked-up features."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.ops import build as native
from mmpi_ns.ops.colors import Network
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout, Tables


class _Shading(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("features", "directions", "heads", "planes", "ndc", "valid")] + [
        (n, ctypes.c_int64) for n in ("rows", "slots")
    ]


class _Start(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("axes", "weights", "bias")] + [("frequencies", ctypes.c_int64)]


def shade(
    layout: SceneLayout,
    tables: Tables,
    features: Float[Tensor, "T C"],
    networks: ColorNetworks,
    axes: Float[Tensor, "H 3 3"],
    directions: Float[Tensor, "R 3"],
    heads: Int[Tensor, "R S"],
    planes: Int[Tensor, "R S"],
    ndc: Float[Tensor, "R S 3"],
    valid: Bool[Tensor, "R S"],
) -> Float[Tensor, "R S 3"]:
    """Colours of the valid samples; empty slots are black.

    Args:
        layout: of the scene.
        tables: its tables.
        features: colour features of all texels.
        networks: the colour networks.
        axes: of each head, as rows.
        directions: of each ray, world axes.
        heads: head of each sample.
        planes: its plane.
        ndc: its position in the head.
        valid: which slots hold a sample.
    """
    scene, lib = CpuScene.of(layout).with_tables(tables), native.library()
    num_rays, slots = valid.shape
    channels, axes = features.shape[1], axes.contiguous()
    split = channels + 3 * (1 + 2 * networks.position_frequencies)
    held, nets, starts = [], [], []
    for k in range(len(axes)):
        w1, b1, w2, b2, w3, b3 = networks.layers(k)
        own = [w1[:, :split].contiguous(), w2.contiguous(), b2, w3.contiguous(), b3]
        first = (axes[k], w1[:, split:].contiguous(), b1)
        sizes = (channels, networks.position_frequencies, networks.width)
        nets.append(Network(*sizes, *(native.address(x) for x in own)))
        starts.append(_Start(*(native.address(x) for x in first), networks.direction_frequencies))
        held.append((own, first))
    parts = [x.contiguous() for x in (features, directions, heads, planes, ndc, valid)]
    shading = _Shading(*(native.address(x, x.dtype) for x in parts), len(features), slots)
    table, rays = (Network * len(nets))(*nets), (_Start * len(starts))(*starts)
    colors = torch.empty(num_rays, slots, 3)

    def part(begin: int, end: int) -> None:
        lib.mmpi_shade(
            ctypes.byref(scene),
            ctypes.byref(shading),
            table,
            rays,
            *map(ctypes.c_int64, (begin, end)),
            native.address(colors),
        )

    native.in_parts(part, num_rays)
    return colors
