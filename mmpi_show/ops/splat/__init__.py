"""Rasterisation of Gaussians as in viewers of 3D Gaussian splatting: the image, and each one's contribution.

Only ``mmpi-export splats`` needs it, and it has no form in plain torch. Source: Kerbl et al. (2023), sec. 4.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.build import arguments, library, structs
from mmpi_ns.ops.layout import dense
from mmpi_show.ops import OPS

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
    """Red, green, blue without a background, and the transmittance.

    Args:
        gaussians: what is seen.
        view: the camera.
        colors: of each Gaussian, as this camera sees it.
    """
    image = torch.zeros(*view.size[::-1], 4)
    _run(splat_image, gaussians, view, colors=colors, out=image)
    return image


def splat_errors(
    gaussians: Gaussians,
    view: View,
    colors: Float[Tensor, "N 3"],
    rendered: Float[Tensor, "H W 3"],
    errors: Float[Tensor, "H W 3"],
) -> Float[Tensor, "N 6"]:
    """Changes of colours and opacities that reduce an image's errors.

    Args:
        gaussians: what is seen.
        view: the camera.
        colors: of each Gaussian, as this camera sees it.
        shown: the rendered image with its background.
        errors: target minus rendered image.

    Returns:
        Of each Gaussian the sum over pixels of its weight there times (error, 1), the adjoint of ``splat_image``. Then,
        with J the change of a number of the image with the logit of its opacity, the sums over the image's numbers of
        J error / (sum of |J| of all Gaussians) and of |J|.
    """
    sums = torch.zeros(len(gaussians.means), 6)
    _run(splat_errors, gaussians, view, colors=colors, rendered=rendered, errors=errors, out=sums)
    return sums


def _run(function: Callable[..., Tensor], gaussians: Gaussians, view: View, out: Tensor, **tensors: Tensor) -> None:
    """Calls the compiled form of a function, which writes to ``out``."""
    count = len(gaussians.means)
    numbers = map(float, (*view.to_world.flatten(), *view.focal, *view.center))
    inputs = dense(*gaussians, *tensors.values())
    camera, seen = structs((*numbers, *map(ctypes.c_int32, view.size))), structs((count, *inputs[:3]))
    values = (camera, seen, *inputs[3:], out)  # referenced until it has run
    getattr(library(OPS), f"mmpi_{function.__name__}")(*arguments(values))
