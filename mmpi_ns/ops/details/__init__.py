"""Residuals of a training image at the surfaces of rays, and their weights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from mmpi_ns.ops.build import HEADERS
from mmpi_ns.ops.ends import numbers_in

TEXT = (HEADERS / "details.h").read_text(encoding="utf-8")
"""Source of the constants and weights in GLSL."""
TURN, FADE, SAME_DEPTH, SAME_PIXELS, STRENGTH, HERE, MIDDLE, LEAST_WEIGHT, TINY = numbers_in(
    TEXT, "TURN", "FADE", "SAME_DEPTH", "SAME_PIXELS", "STRENGTH", "HERE", "MIDDLE", "LEAST_WEIGHT", "TINY"
)


class SeenDetails(NamedTuple):
    """Values of an image at the surfaces of rays."""

    difference: Float[Tensor, "R 3"]
    weight: Float[Tensor, "R 1"]
    """0 where the image sees another surface, or none."""


def project(
    local: Float[Tensor, "R 3"], camera: Float[Tensor, "24"], height: int, width: int
) -> tuple[Float[Tensor, "R 2"], Bool[Tensor, "R"]]:
    """Pixel coordinates of directions in a camera's axes (x right, y up, z backwards), and whether the image has them.

    Args:
        local: directions, of any length.
        camera: as for ``seen_details``.
        height, width: of the image, pixels.
    """
    fx, fy, cx, cy, k1, k2, k3, k4, p1, p2, fisheye, reach = camera[12:].unbind()
    x, y, ahead = local[:, 0], -local[:, 1], -local[:, 2]
    radius = torch.hypot(x, y)
    scale = torch.where(
        fisheye > 0, torch.atan2(radius, ahead) / radius.clamp(min=TINY), 1 / torch.where(ahead > TINY, ahead, TINY)
    )
    u, v = x * scale, y * scale
    inside = (radius * scale <= reach) & ((fisheye > 0) | (ahead > TINY))
    r = u * u + v * v
    radial = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    du, dv = 2 * p1 * u * v + p2 * (r + 2 * u * u), 2 * p2 * u * v + p1 * (r + 2 * v * v)
    column, row = fx * (radial * u + du) + cx, fy * (radial * v + dv) + cy
    inside &= (column > 0) & (column < width) & (row > 0) & (row < height)
    return torch.stack([column, row], -1), inside


def seen_details(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    inverse: Float[Tensor, "R 1"],
    radiance: Float[Tensor, "R 3"],
    image: Float[Tensor, "H W 4"],
    camera: Float[Tensor, "24"],
) -> SeenDetails:
    """Interpolated residuals of an image where it sees the surfaces of rays. Weights grow with the agreement of viewing
    directions and depths; residuals fade with the angle between the directions.

    Args:
        origins: of the rays.
        directions: of the rays, unit length.
        inverse: 1 / distance of their surfaces along the rays; 0 is infinity.
        radiance: of the field along the rays.
        image: three differences (``rendering.details.DetailView``), and inverse distances along the image's own
            rays; below 0 where it is masked.
        camera: its pose, camera to world row by row; fx, fy, cx, cy in pixels; nerfstudio's k1, k2, k3, k4, p1, p2;
            whether angles are proportional to distances from the centre (fisheye); and the largest distance of a pixel
            from the centre before the distortion, in focal lengths.
    """
    height, width = image.shape[:2]
    pose = camera[:12].view(3, 4)
    towards = origins - pose[:, 3]
    relative = inverse * towards + directions  # to the surface, over its distance along the ray
    length = relative.norm(dim=-1, keepdim=True).clamp(min=TINY)
    pixels, inside = project(relative @ pose[:, :3], camera, height, width)
    grid = torch.where(inside[:, None], 2 * pixels / pixels.new_tensor([width, height]) - 1, 0.0)
    planes = image.movedim(-1, 0)[None]
    values = grid_sample(planes, grid[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
    there, here = values[:, 3:], inverse / length
    shift = camera[12] * towards.norm(dim=-1, keepdim=True)  # pixels for each unit of inverse depth
    margin = SAME_DEPTH * torch.maximum(there, here) + SAME_PIXELS / shift.clamp(min=TINY)
    turn = (relative / length - directions).norm(dim=-1, keepdim=True)
    agrees = torch.exp(-((there - here) / margin).square().clamp(max=80)) / (turn + TURN)
    faded = (values[:, :3] - HERE * (radiance - MIDDLE)) / (1 + (turn / FADE).square())
    return SeenDetails(faded, torch.where(inside[:, None] & (there >= 0), agrees, 0.0))
