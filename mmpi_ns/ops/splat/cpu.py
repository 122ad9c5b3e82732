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


class _Gaussians(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), *((n, ctypes.c_void_p) for n in ("means", "covariances", "alphas"))]


def splat_image(gaussians: Gaussians, view: View, colors: Tensor) -> Tensor:
    """See ``ops.splat``."""
    image = torch.zeros(*view.size[::-1], 4)
    _run("mmpi_splat_image", gaussians, view, colors, image)
    return image


def splat_sums(gaussians: Gaussians, view: View, image: Tensor) -> Tensor:
    """See ``ops.splat``."""
    sums = torch.zeros(len(gaussians.means), 4)
    _run("mmpi_splat_sums", gaussians, view, image, sums)
    return sums


def splat_opacities(gaussians: Gaussians, view: View, colors: Tensor, shown: Tensor, errors: Tensor) -> Tensor:
    """See ``ops.splat``."""
    sums = torch.zeros(len(gaussians.means), 2)
    _run("mmpi_splat_opacities", gaussians, view, colors, shown, errors, sums)
    return sums


def _run(name: str, gaussians: Gaussians, view: View, *tables: Tensor) -> None:
    seen = _View((ctypes.c_float * 12)(*view.to_world.flatten().tolist()), *view.focal, *view.center, *view.size)
    held = [x.contiguous() for x in (*gaussians, *tables)]  # alive until it has run
    all_ = _Gaussians(len(gaussians.means), *(x.data_ptr() for x in held[:3]))
    getattr(library(), name)(ctypes.byref(seen), all_, *arguments(held[3:]))
