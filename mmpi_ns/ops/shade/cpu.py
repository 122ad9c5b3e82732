"""Colours of samples, compiled: ``shade.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts, structs
from mmpi_ns.ops.cpu_scene import grids_of
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shade import SampleNetworks


def shade(
    layout: SceneLayout, table: Tensor, networks: SampleNetworks, axes: Tensor, directions: Tensor, places: Places
) -> Tensor:
    pairs = [(w.contiguous(), b.contiguous()) for x in networks.layers for w, b in zip(x[::2], x[1::2], strict=True)]
    tensors, colors = [x.contiguous() for x in (axes, table, directions, *places)], torch.empty(*places.valid.shape, 3)
    shading = structs((*tensors, *table.shape, colors.shape[1], *networks[1:]))
    layers = structs(*((*w.shape, w, b) for w, b in pairs))
    call_in_parts("mmpi_shade", len(colors), grids_of(layout), len(layout.mpis), len(axes), shading, layers, colors)
    return colors
