"""Gaussians seen by a camera as viewers of 3D Gaussian splatting show them: the image, and what each gave to it."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.splat.reference import Gaussians, View


def splat_image(gaussians: Gaussians, view: View, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 4"]:
    """Red, green, blue without a background, and the light that passes.

    Args:
        gaussians: what is seen.
        view: the camera.
        colors: of each Gaussian, as this camera sees it.
    """
    return dispatch.run("splat_image", gaussians, view, colors)


def splat_sums(gaussians: Gaussians, view: View, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "N 4"]:
    """What an image holds where each Gaussian is seen: the adjoint of ``splat_image``.

    Args:
        gaussians: what is seen.
        view: the camera.
        image: an image of that camera; an error for example.

    Returns:
        Sum over pixels of the weight that a Gaussian has there times (red, green, blue, 1).
    """
    return dispatch.run("splat_sums", gaussians, view, image)


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
    return dispatch.run("splat_opacities", gaussians, view, colors, shown, errors)
