"""Motion of overlapping patches between two images that look nearly alike (dense inverse search: Kroeger, Timofte, Dai
and Van Gool, Fast Optical Flow using Dense Inverse Search, ECCV 2016).

A patch of one image is compared with the other one at its motion, both less their means. The gradients of the first
give the step of the patch by least squares, so they are computed once. From coarse to fine, each size begins with the
motion of the previous one; patches take the motions of neighbouring patches that fit better.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mmpi_ns.ops.dispatch import operation

SIDE = 8
"""Pixels along the side of a patch."""
FLAT = 16.0
"""Added to the sums of squared gradients of a patch: one of a single colour stays where it is."""
APART, FARTHEST = 0.25, 8.0
"""Distance above which two motions differ, and maximum displacement of a patch from its start, pixels."""


@operation(in_cpp=0)
def refine_motion(
    gray: UInt8[Tensor, "H W"], other: UInt8[Tensor, "H W"], coarse: Float[Tensor, "A B 2"], stride: int, rounds: int
) -> Float[Tensor, "H W 2"]:
    """Optical flow from an image to another one, right and down, pixels.

    Args:
        gray: the image, of at least ``SIDE`` pixels in height and width.
        other: the other one.
        coarse: the same of smaller images, or of one pixel, in their pixels.
        stride: pixels between patches, at most ``SIDE``.
        rounds: comparisons of a patch, each but the first after a step.
    """
    (height, width), (small_height, small_width) = gray.shape, coarse.shape[:2]
    patches = _Patches(gray, other, stride, coarse)
    scale = torch.tensor([small_width / width, small_height / height], dtype=coarse.dtype)
    x, y = (((at + SIDE / 2 + 0.5) * of - 0.5) for at, of in zip((patches.columns, patches.rows), scale, strict=True))
    start = between(coarse, x.expand(patches.shape), y.expand(patches.shape)) / scale
    first, least = patches.descended(start, rounds)
    best = first
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        theirs = first.roll(shift, (0, 1))
        rows, columns = (torch.arange(n) - by for n, by in zip(patches.shape, shift, strict=True))
        exists = ((rows >= 0) & (rows < patches.shape[0]))[:, None] & (columns >= 0) & (columns < patches.shape[1])
        is_other = ((theirs - first).square().sum(-1) > APART**2) & exists
        errors = torch.where(is_other, patches.compare(theirs)[0], torch.inf)
        best, least = torch.where((errors < least)[..., None], theirs, best), torch.minimum(errors, least)
    best = torch.where((best != first).any(-1, keepdim=True), patches.descended(best, rounds)[0], best)
    # Motions of pixels are those of the patches that they are in, where both images look alike first.
    weight = 1 / patches.differences(best).abs().clamp(min=1)
    rows = (patches.rows[..., None, None] + torch.arange(SIDE)[:, None]).expand(weight.shape)
    columns = (patches.columns[:, None, None] + torch.arange(SIDE)).expand(weight.shape)
    values = weight[..., None] * functional.pad(best, (0, 1), value=1.0)[:, :, None, None]
    sums = torch.zeros(height, width, 3, dtype=best.dtype)
    sums.index_put_((rows, columns), values, accumulate=True)
    # Beyond the last patch as in it.
    rows, columns = (torch.arange(n).clamp(max=int(at.max()) + SIDE - 1) for n, at in
                     ((height, patches.rows), (width, patches.columns)))  # fmt: skip
    sums = sums[rows[:, None], columns]
    return sums[..., :2] / sums[..., 2:]


class _Patches:
    """Patches of an image, and another one that they are compared with."""

    def __init__(self, gray: Tensor, other: Tensor, stride: int, like: Tensor) -> None:
        self.size, self.other = gray.shape, other.to(like)
        image = functional.pad(gray.to(like)[None], (1, 1, 1, 1), mode="replicate")[0]
        across, smooth = image[:, 2:] - image[:, :-2], image[:, :-2] + 2 * image[:, 1:-1] + image[:, 2:]
        right, down = (across[:-2] + 2 * across[1:-1] + across[2:]) / 8, (smooth[2:] - smooth[:-2]) / 8
        self.gray, right, down = (
            part.unfold(0, SIDE, stride).unfold(1, SIDE, stride) for part in (image[1:-1, 1:-1], right, down)
        )
        gradients = torch.stack([right, down], -1)
        self.gradients = gradients - gradients.mean((2, 3), keepdim=True)
        products = torch.einsum("pqijm,pqijn->pqmn", self.gradients, self.gradients)
        self.inverse = torch.linalg.inv(products + FLAT * torch.eye(2, dtype=like.dtype))
        self.shape = self.gray.shape[:2]
        self.rows, self.columns = (stride * torch.arange(n) for n in self.shape)
        self.rows = self.rows[:, None]

    def differences(self, motion: Tensor) -> Tensor:
        height, width = self.size
        x = (self.columns + motion[..., 0]).clamp(1 - SIDE, width - 1)[..., None, None] + torch.arange(SIDE)
        y = (self.rows + motion[..., 1]).clamp(1 - SIDE, height - 1)[..., None, None] + torch.arange(SIDE)[:, None]
        return between(self.other[..., None], *torch.broadcast_tensors(x, y))[..., 0] - self.gray

    def compare(self, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Sums of squared differences less their means, and the least-squares steps."""
        apart = self.differences(motion)
        towards = torch.einsum("pqij,pqijn->pqn", apart, self.gradients)
        steps = -(self.inverse @ towards[..., None])[..., 0]
        return apart.square().sum((2, 3)) - apart.sum((2, 3)).square() / SIDE**2, steps

    def descended(self, start: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """The best motions of some steps, and their errors."""
        at, best, least = start, start, torch.full(self.shape, torch.inf, dtype=start.dtype)
        goes_on = torch.ones(self.shape, dtype=torch.bool)
        for _ in range(rounds):
            errors, steps = self.compare(at)
            goes_on = goes_on & (errors < least)
            best, least = torch.where(goes_on[..., None], at, best), torch.where(goes_on, errors, least)
            at = at + steps
            goes_on = goes_on & ((at - start).square().sum(-1) <= FARTHEST**2)
        return best, least


def between(values: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Values [H, W, C] at places, interpolated; beyond the borders those of the border."""
    height, width = values.shape[:2]
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    left, top = x.long().clamp(0, max(width - 2, 0)), y.long().clamp(0, max(height - 2, 0))
    right, below, u, v = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1), x - left, y - top
    upper, lower = (torch.lerp(values[row, left], values[row, right], u[..., None]) for row in (top, below))
    return torch.lerp(upper, lower, v[..., None])


def find_motion(gray: NDArray[np.uint8], other: NDArray[np.uint8], stride: int, rounds: int) -> NDArray[np.float32]:
    """The same from coarse to fine. [H, W, 2]"""
    levels = [[gray, other]]
    while min(levels[-1][0].shape) >= 2 * SIDE and max(levels[-1][0].shape) >= 6 * SIDE:
        height, width = levels[-1][0].shape
        size = width // 2, height // 2
        levels.append([np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_AREA), np.uint8) for x in levels[-1]])
    motion = torch.zeros(1, 1, 2)
    for image, moved in reversed(levels):
        motion = refine_motion(torch.from_numpy(image), torch.from_numpy(moved), motion, stride, rounds)
    return motion.numpy()
