"""Gaussians seen by a camera, compiled (``splat.cpp``)."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.build import arguments, library
from mmpi_ns.ops.splat.reference import Gaussians, View


class _View(ctypes.Structure):
    _fields_ = [
        ("to_world", ctypes.c_float * 12),
        *((n, ctypes.c_float) for n in ("fx", "fy", "cx", "cy")),
        *((n, ctypes.c_int32) for n in ("width", "height")),
    ]


def splat_image(gaussians: Gaussians, view: View, colors: Tensor) -> Tensor:
    """See ``ops.splat``."""
    image = torch.zeros(*view.size[::-1], 4)
    _run(gaussians, view, colors.contiguous(), image, None, None)
    return image


def splat_sums(gaussians: Gaussians, view: View, image: Tensor) -> Tensor:
    """See ``ops.splat``."""
    sums = torch.zeros(len(gaussians.means), 4)
    _run(gaussians, view, None, None, image.contiguous(), sums)
    return sums


def _run(gaussians: Gaussians, view: View, *tables: Tensor | None) -> None:
    seen = _View((ctypes.c_float * 12)(*view.to_world.flatten().tolist()), *view.focal, *view.center, *view.size)
    held = [len(gaussians.means), *(x.contiguous() for x in gaussians), *tables]  # alive until it has run
    library().mmpi_splat(ctypes.byref(seen), *arguments(held))
