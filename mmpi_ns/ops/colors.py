"""Colours of one head's samples with gradients to features and weights; the reference is ``ColorNetworks.forward``."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.field.color_network import ColorNetworks, positional_encoding
from mmpi_ns.ops import build as native
from mmpi_ns.ops import dispatch

PART = 2048
"""Samples whose gradients the compiled kernel sums together, so that a sum does not depend on the threads."""


class Network(ctypes.Structure):
    """A colour network without what directions and the bias add to its first layer. The weights must outlive it."""

    _fields_ = [(n, ctypes.c_int64) for n in ("channels", "frequencies", "width")] + [
        (n, ctypes.c_void_p) for n in ("first", "second", "second_bias", "third", "third_bias")
    ]


class _Samples(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("features", "ndc", "start", "rays")] + [("count", ctypes.c_int64)]


class _Colors(torch.autograd.Function):
    """``layers``: first [W, I], second [W, W] and its bias, third [3, W] and its bias."""

    @staticmethod
    def forward(
        ctx: Any,
        lib: ctypes.CDLL,
        frequencies: int,
        ndc: Tensor,
        rays: Tensor,
        features: Tensor,
        start: Tensor,
        *layers: Tensor,
    ) -> Tensor:
        features, start, ndc, rays, *held = (x.contiguous() for x in (features, start, ndc, rays, *layers))
        colors = torch.empty(len(features), 3)
        net, samples = _structures(frequencies, features, start, ndc, rays, held)

        def part(begin: int, end: int) -> None:
            lib.mmpi_colors(
                ctypes.byref(net),
                ctypes.byref(samples),
                *map(ctypes.c_int64, (begin, end)),
                native.address(colors),
            )

        native.in_parts(part, len(features))
        ctx.save_for_backward(colors, features, start, ndc, rays, *held)
        ctx.lib, ctx.frequencies = lib, frequencies
        return colors

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        colors, features, start, ndc, rays, *layers = ctx.saved_tensors
        net, samples = _structures(ctx.frequencies, features, start, ndc, rays, layers)
        grad, parts = grad_outputs[0].contiguous(), -(-len(features) // PART)
        to_features, to_start = torch.empty_like(features), torch.zeros_like(start)
        to_layers = torch.empty(parts, sum(x.numel() for x in layers))

        def part(begin: int, end: int) -> None:
            ctx.lib.mmpi_colors_back(
                ctypes.byref(net),
                ctypes.byref(samples),
                native.address(colors),
                native.address(grad),
                *map(ctypes.c_int64, (begin, end)),
                *map(native.address, (to_features, to_start, to_layers)),
            )

        native.in_parts(part, parts, least=1)
        summed = to_layers.sum(0).split([x.numel() for x in layers])
        shaped = (g.view(x.shape) for g, x in zip(summed, layers, strict=True))
        return None, None, None, None, to_features, to_start, *shaped


def _structures(
    frequencies: int, features: Tensor, start: Tensor, ndc: Tensor, rays: Tensor, layers: list[Tensor]
) -> tuple[Network, _Samples]:
    net = Network(features.shape[1], frequencies, start.shape[1], *map(native.address, layers))
    places = (*map(native.address, (features, ndc, start)), native.address(rays, torch.int64))
    return net, _Samples(*places, len(features))


def colors(
    networks: ColorNetworks,
    head: int,
    features: Float[Tensor, "N C"],
    ndc: Float[Tensor, "N 3"],
    directions: Float[Tensor, "R 3"],
    rays: Int[Tensor, "N"],
) -> Float[Tensor, "N 3"]:
    """``ColorNetworks.forward``, compiled where it can be; then samples of a ray must follow each other."""
    if dispatch.form_of("colors", features, ndc, directions, networks.weights) != "cpu":
        return networks(head, features, ndc, directions, rays)
    lib = native.library()
    w1, b1, *rest = networks.layers(head)
    split = features.shape[1] + 3 * (1 + 2 * networks.position_frequencies)
    encoded = positional_encoding(directions, networks.direction_frequencies)
    start = torch.addmm(b1, encoded, w1[:, split:].T).float()  # autocast would have it in half precision
    given = (lib, networks.position_frequencies, ndc, rays, features, start)
    return _Colors.apply(*given, w1[:, :split], *rest)  # type: ignore[no-any-return]
