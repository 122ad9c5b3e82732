"""Planes through the pixels of an image by PatchMatch stereo (Bleyer, Rhemann and Rother 2011; many pixels at once as
in Galliani, Lasinger and Schindler 2015).

In a pinhole image the inverse depth of a plane is linear in the pixel, so a pixel's plane is (q, right, down): its
inverse depth there and the change for each pixel. A patch on it appears in another image at the homogeneous pixels a +
q b (``ops/matches``), which are linear in the pixel, too. Planes are scored by the correlation of patches.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64, UInt8
from torch import Tensor

from mmpi_ns.ops.dispatch import operation
from mmpi_priors.ops.matches import linear_at

REACH = 2
"""Pixels of a patch on each side of its middle."""
LEAST_AHEAD, LEAST_SHARE = 1e-6, 0.2
"""Depth there over depth here, at least, and of a patch's pixels over that of its middle."""
LEAST_CONTRAST = 1.0
"""Standard deviation of gray levels of a patch, at least."""
ALONE = 0.1
"""Amount below the best correlation that an image which does not see the patch counts as."""
OFFSETS = (1, 4, 2)
"""Pixels from which planes spread, in turn."""
GRAZING = 0.05
"""Cosine between a plane's normal and the view direction, at least, times the length of the pixel's direction."""


class Others(NamedTuple):
    """K images that an image is compared with."""

    corners: Int32[Tensor, "T"]
    """Pixels of all their sizes, row by row, one after the other: four bytes, of a pixel, the one to its right, the one
    below and the one below that; beyond the border those of the border."""
    levels: Int64[Tensor, "K L 3"]
    """First pixel, height and width of each at twice its size, once and half of it (or as an operation says)."""
    linear: Float[Tensor, "K 3 3"]
    """a at a pixel (x, y) of the image is this times (x, y, 1)."""
    b: Float[Tensor, "K 3"]


class Patches(NamedTuple):
    """Planes through pixels."""

    planes: Float[Tensor, "H W 3"]
    """Inverse depth at the pixel's centre, and its change for a pixel to the right and for one down."""
    alike: Float[Tensor, "H W"]
    """Mean of the two largest correlations (with one image: that), the largest less ``ALONE`` for images that do not
    see the patch; -1 where none does."""


@operation(in_cpp=1)
def compare_planes(
    gray: UInt8[Tensor, "H W"],
    patches: Patches,
    planes: Float[Tensor, "H W 3"],
    others: Others,
    stride: int,
) -> Patches:
    """The better of two planes at each pixel.

    Args:
        gray: the image.
        patches: planes, with their correlations.
        planes: the other ones.
        others: the images that decide.
        stride: pixels between the pixels of a patch, of which there are 5 x 5.
    """
    return _better(_References(gray, stride), patches, planes, others)


@operation(in_cpp=1)
def spread_planes(
    gray: UInt8[Tensor, "H W"],
    patches: Patches,
    changes: Float[Tensor, "H W 4"],
    pinhole: Float[Tensor, "4"],
    others: Others,
    stride: int,
    offset: int,
) -> Patches:
    """The best of each pixel's plane, those of the pixels around it, and two small perturbations of the best.

    Args:
        gray: the image.
        patches: planes, with their correlations.
        changes: of the first that differs, octaves of the inverse depth, which the second changes by as much the other
            way; and what the second adds to the unit normal.
        pinhole: fx, fy, cx, cy of the image.
        others: the images that decide.
        stride: pixels between the pixels of a patch, of which there are 5 x 5.
        offset: pixels to the left, right, above and below from which planes come.
    """
    references, before = _References(gray, stride), patches.planes
    height, width = gray.shape
    for right, down in ((-offset, 0), (offset, 0), (0, -offset), (0, offset)):
        rows, columns = (torch.arange(n) + shift for n, shift in ((height, down), (width, right)))
        inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
        taken = before[rows.clamp(0, height - 1)][:, columns.clamp(0, width - 1)]
        q = taken[..., 0] - taken[..., 1] * right - taken[..., 2] * down
        planes = torch.where(inside[..., None], torch.stack([q, taken[..., 1], taken[..., 2]], -1), -1.0)
        patches = _better(references, patches, planes, others)
    factor = torch.exp2(changes[..., :1])
    patches = _better(references, patches, patches.planes * factor, others)
    (fx, fy, cx, cy), (q, right, down) = pinhole, (patches.planes / factor).unbind(-1)
    x, y = (torch.arange(n, dtype=before.dtype) + 0.5 for n in (width, height))
    y = y[:, None]
    normal = torch.stack([fx * right, fy * down, q - right * (x - cx) - down * (y - cy)], -1)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-20) + changes[..., 1:]
    towards = normal[..., 0] * (x - cx) / fx + normal[..., 1] * (y - cy) / fy + normal[..., 2]
    scale = q / torch.where(towards < 0, towards.clamp(max=-GRAZING), towards.clamp(min=GRAZING))
    turned = torch.stack([q, scale * normal[..., 0] / fx, scale * normal[..., 1] / fy], -1)
    return _better(references, patches, turned, others)


class _References:
    """The patches of an image, less their means."""

    def __init__(self, gray: Tensor, stride: int) -> None:
        height, width = gray.shape
        steps = torch.arange(-REACH, REACH + 1) * stride
        rows, columns = ((torch.arange(n)[:, None] + steps).clamp(0, n - 1) for n in (height, width))
        values = gray[rows[:, None, :, None], columns[None, :, None, :]].float().flatten(2)
        self.steps = steps
        self.values = values - values.mean(-1, keepdim=True)
        """[H, W, 25]"""
        self.squares = self.values.square().sum(-1)


def _better(references: _References, patches: Patches, planes: Tensor, others: Others) -> Patches:
    best, second = (torch.full(planes.shape[:2], -1.0, dtype=planes.dtype) for _ in range(2))
    is_visible, is_hidden = torch.zeros((2, *planes.shape[:2]), dtype=torch.bool)
    for sizes, linear, b in zip(others.levels, others.linear, others.b, strict=True):
        alike, visible = _correlations(references, planes, others.corners, sizes, linear, b)
        second = torch.maximum(second, torch.minimum(best, alike))
        best, is_visible, is_hidden = torch.maximum(best, alike), is_visible | visible, is_hidden | ~visible
    if len(others.b) == 1:
        second = best
    else:
        second = torch.where(is_hidden, torch.maximum(second, best - ALONE), second)
    flat = references.squares < LEAST_CONTRAST**2 * references.values.shape[-1]
    mean = torch.where(is_visible & ~flat & (planes[..., 0] > 0), (best + second) / 2, -1.0)
    better = mean > patches.alike
    return Patches(torch.where(better[..., None], planes, patches.planes), torch.where(better, mean, patches.alike))


def _correlations(
    references: _References, planes: Tensor, corners: Tensor, sizes: Tensor, linear: Tensor, b: Tensor
) -> tuple[Tensor, Tensor]:
    """Correlations of patches with one image (-1: none), and whether it sees their centres. [H, W] each"""
    q, right, down = planes.unbind(-1)
    middle = torch.stack([a + q * s for a, s in zip(linear_at(q, linear), b, strict=True)])
    to_right, to_down = (
        torch.stack([linear[i, n] + slope * b[i] for i in range(3)]) for n, slope in enumerate((right, down))
    )
    ahead = middle[2] > LEAST_AHEAD
    at = middle[:2] / torch.where(ahead, middle[2], 1.0)
    height, width = sizes[1, 1:].tolist()
    visible = ahead & (at[0] >= 0.5) & (at[0] <= width - 0.5) & (at[1] >= 0.5) & (at[1] <= height - 0.5)
    # Pixels there for a pixel here decide the size at which the image is looked at.
    (xr, yr), (xd, yd) = ((to[:2] - at * to[2]) / torch.where(ahead, middle[2], 1.0) for to in (to_right, to_down))
    area = (xr * yd - xd * yr).abs()
    level = torch.where(area < 0.5, 0, torch.where(area > 2.0, 2, 1))
    first, heights, widths = (sizes[level, n] for n in range(3))
    steps_down, steps_right = torch.meshgrid(references.steps, references.steps, indexing="ij")
    places = middle[..., None] + to_right[..., None] * steps_right.flatten() + to_down[..., None] * steps_down.flatten()
    whole = (places[2] >= LEAST_SHARE * middle[2][..., None]).all(-1)
    depth = torch.where(whole[..., None], places[2], 1.0)
    column, row = (
        (place / depth * (of / size)[..., None] - 0.5).nan_to_num(0).clamp(min=0)
        for place, of, size in zip(places, (widths, heights), (width, height), strict=False)
    )
    column = torch.minimum(column, (widths - 1)[..., None].to(column.dtype))
    row = torch.minimum(row, (heights - 1)[..., None].to(row.dtype))
    left, top = column.long(), row.long()
    u, v = column - left, row - top
    at = first[..., None] + top * widths[..., None] + left
    a, b, c, d = (part.to(u) for part in corners.view(torch.uint8).view(-1, 4)[at].unbind(-1))
    values = torch.lerp(torch.lerp(a, b, u), torch.lerp(c, d, u), v)
    values = values - values.mean(-1, keepdim=True)
    squares = values.square().sum(-1)
    alike = (values * references.values).sum(-1) / (squares * references.squares).clamp(min=1e-20).sqrt()
    return torch.where(visible & whole & (squares >= LEAST_CONTRAST**2 * values.shape[-1]), alike, -1.0), visible


def others_of(
    grays: list[list[UInt8[Tensor, "h w"]]], linear: Float[Tensor, "K 3 3"], b: Float[Tensor, "K 3"]
) -> Others:
    """Images to compare with, each at twice its size, once and half of it (or as an operation says)."""
    corners, levels, first = [], [], 0
    for gray in (gray for sizes in grays for gray in sizes):
        right = torch.cat([gray[:, 1:], gray[:, -1:]], 1)
        pair = torch.stack([gray, right], -1)
        corners.append(torch.cat([pair, torch.cat([pair[1:], pair[-1:]])], -1).view(torch.int32).flatten())
        levels.append([first, *gray.shape])
        first += gray.numel()
    return Others(torch.cat(corners), torch.tensor(levels).view(len(grays), -1, 3), linear, b)
