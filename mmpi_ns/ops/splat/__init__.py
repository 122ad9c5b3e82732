"""Gaussians seen by a camera as viewers of 3D Gaussian splatting show them: the image, and what each gave to it.

Compiled alone (``splat.cpp``): only ``mmpi-export splats`` needs it. Source: Kerbl et al. (2023), sec. 4.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.build import arguments, library
from mmpi_ns.ops.layout import check_shapes, shaped

BLUR = 0.3
"""Variance that is added to a projected Gaussian, square pixels (as in ``splat.cpp``)."""


class Gaussians(NamedTuple):
    """N Gaussians."""

    means: Float[Tensor, "N 3"]
    covariances: Float[Tensor, "N 3 3"]
    alphas: Float[Tensor, "N"]


class View(NamedTuple):
    """A pinhole."""

    to_world: Float[Tensor, "3 4"]
    """From camera axes (x right, y up, looking along -z)."""
    size: tuple[int, int]
    """Width and height, pixels."""
    focal: tuple[float, float]
    center: tuple[float, float]


def splat_image(gaussians: Gaussians, view: View, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 4"]:
    """Red, green, blue without a background, and the light that passes.

    Args:
        gaussians: what is seen.
        view: the camera.
        colors: of each Gaussian, as this camera sees it.
    """
    image = torch.zeros(*view.size[::-1], 4)
    _run(splat_image, gaussians, view, colors=colors, out=image)
    return image


def splat_sums(gaussians: Gaussians, view: View, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "N 4"]:
    """What an image holds where each Gaussian is seen: the adjoint of ``splat_image``.

    Args:
        gaussians: what is seen.
        view: the camera.
        image: an image of that camera; an error for example.

    Returns:
        Sum over pixels of the weight that a Gaussian has there times (red, green, blue, 1).
    """
    sums = torch.zeros(len(gaussians.means), 4)
    _run(splat_sums, gaussians, view, image=image, out=sums)
    return sums


def splat_opacities(
    gaussians: Gaussians,
    view: View,
    colors: Float[Tensor, "N 3"],
    shown: Float[Tensor, "H W 3"],
    errors: Float[Tensor, "H W 3"],
) -> Float[Tensor, "N 2"]:
    """How opacities should change for an image to change by its errors.

    Args:
        gaussians: what is seen.
        view: the camera.
        colors: of each Gaussian, as this camera sees it.
        shown: the image with its background.
        errors: what is missing in it.

    Returns:
        With J the change of a number of the image with the logit of a Gaussian's opacity, the sums over the image's
        numbers of J error / (sum of |J| of all Gaussians) and of |J|.
    """
    sums = torch.zeros(len(gaussians.means), 2)
    _run(splat_opacities, gaussians, view, colors=colors, shown=shown, errors=errors, out=sums)
    return sums


class _View(ctypes.Structure):
    _fields_ = [
        ("to_world", ctypes.c_float * 12),
        *((n, ctypes.c_float) for n in ("fx", "fy", "cx", "cy")),
        *((n, ctypes.c_int32) for n in ("width", "height")),
    ]


class _Gaussians(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), *((n, ctypes.c_void_p) for n in ("means", "covariances", "alphas"))]


def _run(function: Callable[..., Tensor], gaussians: Gaussians, view: View, out: Tensor, **tensors: Tensor) -> None:
    """Calls the compiled form of a function, which writes to ``out``."""
    (width, height), count = view.size, len(gaussians.means)
    check_shapes(function, {"gaussians": gaussians, "view": view, **tensors}, {"W": width, "H": height, "N": count})
    camera = _View((ctypes.c_float * 12)(*view.to_world.flatten().tolist()), *view.focal, *view.center, *view.size)
    held = [shaped(x, *x.shape) for x in (*gaussians, *tensors.values(), out)]  # alive until it has run
    addresses = _Gaussians(count, *(x.data_ptr() for x in held[:3]))
    getattr(library(), f"mmpi_{function.__name__}")(ctypes.byref(camera), addresses, *arguments(held[3:]))
