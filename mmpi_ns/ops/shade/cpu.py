"""Colours of samples, compiled: ``shade.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.build import arguments, call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shade.reference import SampleNetworks


class _Network(ctypes.Structure):
    """A network without what directions and the bias add to its first layer."""

    _fields_ = [(n, ctypes.c_int64) for n in ("channels", "frequencies", "width")] + [
        (n, ctypes.c_void_p) for n in ("first", "second", "second_bias", "third", "third_bias")
    ]


class _Start(ctypes.Structure):
    """What those add."""

    _fields_ = [(n, ctypes.c_void_p) for n in ("axes", "weights", "bias")] + [("frequencies", ctypes.c_int64)]


class _Shading(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("features", "directions", "heads", "planes", "ndc", "valid")] + [
        (n, ctypes.c_int64) for n in ("rows", "slots")
    ]


def shade(
    layout: SceneLayout, table: Tensor, networks: SampleNetworks, axes: Tensor, directions: Tensor, places: Places
) -> Tensor:
    """See ``ops.shade``."""
    channels, axes, shape = table.shape[1], axes.contiguous(), places.valid.shape
    split = channels + 3 * (1 + 2 * networks.position_frequencies)
    held, nets, starts = [], [], []
    for own_axes, (w1, b1, w2, b2, w3, b3) in zip(axes, networks.layers, strict=True):
        own = [x.contiguous() for x in (w1[:, :split], w2, b2, w3, b3)]
        first = [x.contiguous() for x in (own_axes, w1[:, split:], b1)]
        nets.append(_Network(channels, networks.position_frequencies, len(w1), *arguments(own)))
        starts.append(_Start(*arguments(first), networks.direction_frequencies))
        held.append((own, first))
    parts = [x.contiguous() for x in (table, directions, *places)]
    shading = _Shading(*arguments(parts), len(table), shape[1])
    given = (CpuScene.of(layout).grids, len(layout.mpis), len(nets), ctypes.byref(shading))
    given, colors = (*given, (_Network * len(nets))(*nets), (_Start * len(starts))(*starts)), torch.empty(*shape, 3)
    call_in_parts("mmpi_shade", len(colors), given, (colors,))
    return colors
