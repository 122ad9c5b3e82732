"""Losses of rays on a GPU, with their gradients; a lane a ray."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import ray_losses as constants
from mmpi_ns.ops.gpu_scene import block_size, launch
from mmpi_ns.ops.layout import dense
from mmpi_ns.ops.ray_losses import RayLosses

CLIPPED, LEAST, KEYPOINT_WIDTH = map(tl.constexpr, (constants.CLIPPED, constants.LEAST, constants.KEYPOINT_WIDTH))
DEPTH_OUTLIERS, KEYPOINT_OUTLIERS = map(tl.constexpr, (constants.DEPTH_OUTLIERS, constants.KEYPOINT_OUTLIERS))
RAYS = 32
"""Rays per program, of one warp."""


@triton.jit
def _add(sums, place: tl.constexpr, values):
    tl.atomic_add(sums + place, tl.sum(values, 0), sem="relaxed")


@triton.jit(do_not_specialize=("num_rays", "asked", "size", "share"))
def ray_losses_kernel(
    colors, transmittances, masses, firsts, seconds, spreads, nears, reached, covered, exposures, images, random,
    decay, sums, errors, slopes, to_colors, to_transmittances, to_firsts, to_seconds, to_spreads, to_nears,
    num_rays, asked, size, share, of_color, of_entropy, of_distortion, of_keypoints, of_depths,
    CHANNELS: tl.constexpr, EXPOSED: tl.constexpr, BACK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Losses, that of keypoints still a sum, the number of keypoints that are reached, and errors; or, BACK, the
    gradients of the rays' values."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4)[None, :]
    inside, place = ray < num_rays, ray % size
    is_pixel, at = inside & (place < asked), 3 * ray[:, None] + column
    is_channel, filled = is_pixel[:, None] & (column < 3), inside[:, None] & (column < 3)
    drawn = tl.load(random + 3 * (ray // size * asked + place)[:, None] + column, is_channel, 0.0)
    observed = tl.load(images + CHANNELS * place[:, None] + column, is_channel, 0.0)
    if CHANNELS == 4:
        opacity = tl.load(images + 4 * place + 3, is_pixel, 1.0)[:, None]
        observed = observed * opacity + drawn * (1 - opacity)
    background = tl.where((tl.load(covered + ray, is_pixel, 0) != 0)[:, None], drawn, observed)
    transmittance = tl.load(transmittances + ray, is_pixel, 0.5)
    error = tl.load(colors + at, is_channel, 0.0) + transmittance[:, None] * background - observed
    error = tl.where(is_channel, error, 0.0)
    factor = error * 0 + 1
    if EXPOSED:
        exposure = tl.load(exposures + at, is_channel, 1.0)
        factor = tl.where((observed * exposure > CLIPPED) & (error > 0), 0.0, exposure)
    p = tl.minimum(tl.maximum(transmittance, LEAST), 1 - LEAST)
    near, has = tl.load(nears + ray, inside, 0.0), tl.load(reached + ray, inside, 0) != 0
    outliers = tl.where(is_pixel, DEPTH_OUTLIERS, KEYPOINT_OUTLIERS)
    if BACK:
        slope = 2.0 / 3 * share * tl.load(slopes) * factor * factor * error
        tl.store(to_colors + at, slope, filled)
        free = is_pixel & (transmittance >= LEAST) & (transmittance <= 1 - LEAST)
        chosen = tl.where(free, share * of_entropy * tl.load(slopes + 2) * (tl.log(1 - p) - tl.log(p)), 0.0)
        tl.store(to_transmittances + ray, tl.sum(slope * background, 1) + chosen, inside)
        per_color = tl.where(is_channel, share * of_color * tl.load(slopes + 1), 0.0)
        tl.store(to_firsts + at, -2 * observed * per_color, filled)
        tl.store(to_seconds + at, per_color, filled)
        tl.store(to_spreads + ray, tl.where(is_pixel, share * of_distortion * tl.load(slopes + 3), 0.0), inside)
        per_keypoint = of_keypoints * tl.load(slopes + 4) / tl.maximum(tl.load(sums + 6), 1.0)
        per_ray = tl.where(is_pixel, share * of_depths * tl.load(decay) * tl.load(slopes + 5), per_keypoint)
        tl.store(to_nears + ray, tl.where(has, -per_ray / (near + outliers), 0.0), inside)
    else:
        squares = tl.sum(error * error, 1)
        tl.store(errors + ray, squares, inside)
        _add(sums, 0, share / 3 * tl.sum(factor * factor * error * error, 1))
        mass, first = tl.load(masses + ray, is_pixel, 0.0)[:, None], tl.load(firsts + at, is_channel, 0.0)
        second = tl.load(seconds + at, is_channel, 0.0)
        _add(sums, 1, share * of_color * tl.sum(second - 2 * observed * first + observed * observed * mass, 1))
        _add(sums, 2, tl.where(is_pixel, -share * of_entropy * (p * tl.log(p) + (1 - p) * tl.log(1 - p)), 0.0))
        _add(sums, 3, share * of_distortion * tl.load(spreads + ray, is_pixel, 0.0))
        cost = tl.where(has, -tl.log(near + outliers), 0.0)
        _add(sums, 4, tl.where(is_pixel, 0.0, of_keypoints * cost))
        _add(sums, 5, tl.where(is_pixel, share * of_depths * tl.load(decay) * cost, 0.0))
        _add(sums, 6, (has & (place >= asked)).to(tl.float32))


class _RayLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[Tensor, Tensor]:
        *tensors, times, weights = given
        colors, exposures, image = tensors[0], tensors[9], tensors[10]
        count, (asked, channels), device = len(colors), image.shape, colors.device
        sums, errors, block = torch.zeros(7, device=device), torch.empty(count, device=device), block_size(RAYS, device)
        values = [colors if x is None else x.contiguous() for x in tensors]
        ctx.numbers = (count, asked, max(1, count // times), 1 / max(1, times * asked), *weights)
        ctx.constants = {"CHANNELS": channels, "EXPOSED": exposures is not None, "BLOCK": block, "num_warps": 1}
        tensors = (*values, sums, errors, *[errors] * 7)
        launch(ray_losses_kernel, count, block, *tensors, *ctx.numbers, BACK=False, **ctx.constants)
        sums[4:5].div_(sums[6:].clamp(min=1))
        ctx.save_for_backward(*values, sums)
        ctx.mark_non_differentiable(errors)
        return sums[:6], errors

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        *values, sums = ctx.saved_tensors
        gradients = [torch.empty_like(values[i]) for i in (0, 1, 3, 4, 5, 6)]
        tensors, block = (*values, sums, sums, grad_outputs[0].contiguous(), *gradients), ctx.constants["BLOCK"]
        launch(ray_losses_kernel, len(values[0]), block, *tensors, *ctx.numbers, BACK=True, **ctx.constants)
        to_colors, to_transmittances, *others = gradients
        return (to_colors, to_transmittances, None, *others, *[None] * 8)


def ray_losses(
    rgb: Tensor, transmittance: Tensor, mass: Tensor, first: Tensor, second: Tensor, spread: Tensor, near: Tensor,
    reached: Tensor, fully_covered: Tensor, exposures: Tensor | None, image: Tensor, random: Tensor, times: int,
    weights: tuple[float, ...], decay: float | Tensor, has_depths: bool,
) -> RayLosses:  # fmt: skip
    floats = dense(rgb, transmittance, mass, first, second, spread, near)
    decay = torch.as_tensor(decay, dtype=torch.float32, device=rgb.device)
    tensors = (*floats, reached, fully_covered, *dense(exposures, image, random), decay)
    losses, errors = _RayLosses.apply(*tensors, times, weights)  # type: ignore[misc]
    *others, keypoints, depths = losses.unbind()
    has_keypoints = len(image) * times < len(rgb)
    return RayLosses(*others, keypoints if has_keypoints else None, depths if has_depths else None, errors)


@triton.jit(do_not_specialize=("num_rays",))
def depth_targets_kernel(
    disparities, keypoints, counts, targets, intervals, num_rays, least, KNOWN: tl.constexpr, POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Target, width of its window, and interval of a ray."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, target, width = ray < num_rays, ray * 0.0, ray * 0.0
    if KNOWN:
        target, width = tl.load(disparities + 2 * ray, inside, 0.0), tl.load(disparities + 2 * ray + 1, inside, 0.0)
    width = tl.sqrt(width * width + least * least)
    if POINTS:
        keypoint = tl.load(keypoints + ray, inside, 0.0)
        target = tl.where(keypoint > 0, keypoint, target)
        width = tl.where(keypoint > 0, KEYPOINT_WIDTH * keypoint, width)
    tl.store(targets + 2 * ray, target, inside)
    tl.store(targets + 2 * ray + 1, width, inside)
    tl.store(intervals + ray, 1 / tl.maximum(tl.load(counts + ray, inside, 1), 1).to(tl.float32), inside)


def depth_targets(
    disparities: Tensor | None, keypoints: Tensor | None, counts: Tensor, least: float
) -> tuple[Tensor, Tensor]:
    size, device, block = len(counts), counts.device, block_size(RAYS, counts.device)
    targets, intervals = torch.empty(size, 2, device=device), torch.empty(size, device=device)
    values = [targets if x is None else x.contiguous() for x in (disparities, keypoints)]
    launch(
        depth_targets_kernel, size, block, *values, counts, targets, intervals, size, least,
        KNOWN=disparities is not None, POINTS=keypoints is not None, BLOCK=block, num_warps=1,
    )  # fmt: skip
    return targets, intervals
