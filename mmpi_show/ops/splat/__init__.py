"""Rasterisation of Gaussians as in viewers of 3D Gaussian splatting: the image, and each one's contribution.

Only ``mmpi-export splats`` needs it, and it has no form in plain torch. Source: Kerbl et al. (2023), sec. 4.
"""

from __future__ import annotations

import ctypes
from itertools import chain
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.build import arguments, library, structs
from mmpi_ns.ops.layout import dense
from mmpi_show.files import Pose
from mmpi_show.ops import OPS

BLUR = 0.3
"""Variance that is added to a projected Gaussian, square pixels (as in ``splat.cpp``)."""


class Gaussians(NamedTuple):
    """N Gaussians."""

    means: Float[Tensor, "N 3"]
    covariances: Float[Tensor, "N 3 3"]
    alphas: Float[Tensor, "N"]


def splat_image(gaussians: Gaussians, pose: Pose, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 4"]:
    """Red, green, blue without a background, and the transmittance.

    Args:
        gaussians: what is seen.
        pose: the camera.
        colors: of each Gaussian, as this camera sees it.
    """
    image = torch.zeros(*pose.size[::-1], 4)
    _run("mmpi_splat_image", gaussians, pose, colors, image)
    return image


def splat_errors(
    gaussians: Gaussians,
    pose: Pose,
    colors: Float[Tensor, "N 3"],
    rendered: Float[Tensor, "H W 3"],
    errors: Float[Tensor, "H W 3"],
) -> Float[Tensor, "N 6"]:
    """Changes of colours and opacities that reduce an image's errors.

    Args:
        gaussians: what is seen.
        pose: the camera.
        colors: of each Gaussian, as this camera sees it.
        rendered: the image with its background.
        errors: target minus rendered image.

    Returns:
        Of each Gaussian the sum over pixels of its weight there times (error, 1), the adjoint of ``splat_image``. Then,
        with J the change of a number of the image with the logit of its opacity, the sums over the image's numbers of
        J error / (sum of |J| of all Gaussians) and of |J|.
    """
    sums = torch.zeros(len(gaussians.means), 6)
    _run("mmpi_splat_errors", gaussians, pose, colors, rendered, errors, sums)
    return sums


def _run(name: str, gaussians: Gaussians, pose: Pose, *tensors: Tensor) -> None:
    """Calls a compiled function, which writes to the last tensor."""
    inputs = dense(*gaussians, *tensors)
    numbers = map(float, (*chain(*pose.to_world), *pose.focal, *pose.center))
    camera, seen = structs((*numbers, *map(ctypes.c_int32, pose.size))), structs((len(gaussians.means), *inputs[:3]))
    getattr(library(OPS), name)(*arguments((camera, seen, *inputs[3:])))
