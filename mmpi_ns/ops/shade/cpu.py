"""Colours of samples, compiled: ``shade.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.build import arguments, call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene, Layer
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shade import SampleNetworks


class _Shading(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_void_p) for n in ("axes", "features", "directions", "heads", "planes", "ndc", "valid")),
        *((n, ctypes.c_int64) for n in ("rows", "channels", "slots", "position_octaves", "direction_octaves")),
    ]


def shade(
    layout: SceneLayout, table: Tensor, networks: SampleNetworks, axes: Tensor, directions: Tensor, places: Places
) -> Tensor:
    pairs = [(w.contiguous(), b.contiguous()) for x in networks.layers for w, b in zip(x[::2], x[1::2], strict=True)]
    tensors, colors = [x.contiguous() for x in (axes, table, directions, *places)], torch.empty(*places.valid.shape, 3)
    octaves = (networks.position_frequencies, networks.direction_frequencies)
    shading = _Shading(*arguments(tensors), *table.shape, colors.shape[1], *octaves)
    scene = (CpuScene.of(layout).grids, len(layout.mpis), len(axes), ctypes.byref(shading), Layer.array(pairs))
    call_in_parts("mmpi_shade", len(colors), scene, (colors,))
    return colors
