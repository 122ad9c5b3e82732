"""Inputs of the network of a ray, and its colour, on a GPU, with their gradients."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import shading as constants
from mmpi_ns.ops.dispatch import OPERATIONS
from mmpi_ns.ops.gpu_scene import block_size, launch
from mmpi_ns.ops.layout import dense

CHANGE, MOST_CHANGE, LEAST_MASS = map(tl.constexpr, (constants.CHANGE, constants.MOST_CHANGE, constants.LEAST_MASS))
PI = tl.constexpr(3.141592653589793)
NUMBERS = 512
"""Rays per program times their inputs."""


@triton.jit(do_not_specialize=("num_rays",))
def shader_inputs_kernel(
    gathered, masses, directions, inputs, slopes, to_gathered, to_mass, num_rays, channels, octaves,
    BACK: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Mean colours and features, and the encoding of a direction; or, BACK, the gradients of sums and mass."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, COLUMNS)[None, :]
    inside, width = ray < num_rays, channels + 3 + 6 * octaves
    has, at = inside[:, None] & (column < channels), ray[:, None] * width + column
    mass, sums = tl.load(masses + ray, inside, 1.0), tl.load(gathered + ray[:, None] * channels + column, has, 0.0)
    least = tl.maximum(mass, LEAST_MASS)
    if BACK:
        slope = tl.load(slopes + at, has, 0.0) / least[:, None]
        tl.store(to_gathered + ray[:, None] * channels + column, slope, has)
        tl.store(to_mass + ray, tl.where(mass < LEAST_MASS, 0.0, -tl.sum(slope * sums, 1) / least), inside)
    else:
        number = tl.maximum(column - channels, 0)  # x y z, sines of each octave, cosines of each
        angle = tl.load(directions + 3 * ray[:, None] + number % 3, inside[:, None], 0.0)
        turn = tl.maximum(number - 3, 0)
        octave = turn % tl.maximum(3 * octaves, 1) // 3
        wave = angle * (PI * tl.exp2(octave.to(tl.float32)))
        encoded = tl.where(number < 3, angle, tl.where(turn < 3 * octaves, tl.sin(wave), tl.cos(wave)))
        values = tl.where(column < channels, sums / least[:, None], encoded)
        tl.store(inputs + at, values, inside[:, None] & (column < width))


@triton.jit(do_not_specialize=("num_rays",))
def shaded_kernel(
    inputs, offsets, accumulations, colors, slopes, to_inputs, to_offsets, to_accumulations, num_rays, width,
    BACK: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Colours of rays, or, BACK, the gradients of inputs, offsets and accumulation."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, COLUMNS)[None, :]
    inside, at = ray < num_rays, 3 * ray[:, None] + column
    has = inside[:, None] & (column < 3)
    color = tl.load(inputs + ray[:, None] * width + column, has, 0.0)
    # tanh(x) = 2 / (1 + e^-2x) - 1
    bent = 2 / (1 + tl.exp(tl.load(offsets + at, has, 0.0) * (-2 * CHANGE / MOST_CHANGE))) - 1
    factor = tl.exp(-bent * MOST_CHANGE)
    odds = tl.where(has, color + (1 - color) * factor, 1.0)
    accumulation = tl.load(accumulations + ray, inside, 0.0)
    if BACK:
        slope = tl.load(slopes + at, has, 0.0)
        tl.store(to_accumulations + ray, tl.sum(slope * color / odds, 1), inside)
        slope = slope * accumulation[:, None] * factor / (odds * odds)
        filled = inside[:, None] & (column < width)
        tl.store(to_inputs + ray[:, None] * width + column, tl.where(has, slope, 0.0), filled)
        tl.store(to_offsets + at, slope * CHANGE * color * (1 - color) * (1 - bent * bent), has)
    else:
        tl.store(colors + at, accumulation[:, None] * color / odds, has)


def sizes(inputs: Tensor) -> dict[str, int]:
    """Columns and rays of a program."""
    columns = int(triton.next_power_of_2(inputs.shape[1]))
    return {"COLUMNS": columns, "BLOCK": block_size(max(1, NUMBERS // columns), inputs.device)}


class _ShaderInputs(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gathered: Tensor, mass: Tensor, directions: Tensor, octaves: int) -> Tensor:
        count, channels = gathered.shape
        inputs = torch.empty(count, channels + 3 + 6 * octaves, device=gathered.device)
        ctx.octaves, ctx.how = octaves, sizes(inputs)
        tensors = (gathered, mass, directions, inputs, inputs, inputs, inputs)
        launch(shader_inputs_kernel, count, ctx.how["BLOCK"], *tensors, count, channels, octaves, BACK=False, **ctx.how)
        ctx.save_for_backward(gathered, mass)
        return inputs

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        gathered, mass = ctx.saved_tensors
        slopes, to_gathered, to_mass = grad_outputs[0].contiguous(), torch.empty_like(gathered), torch.empty_like(mass)
        tensors = (gathered, mass, gathered, slopes, slopes, to_gathered, to_mass)
        numbers = (*gathered.shape, ctx.octaves)
        launch(shader_inputs_kernel, len(mass), ctx.how["BLOCK"], *tensors, *numbers, BACK=True, **ctx.how)
        return to_gathered, to_mass, None, None


class _Shaded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, offset: Tensor, accumulation: Tensor) -> Tensor:
        colors, numbers, ctx.how = torch.empty_like(offset), inputs.shape, sizes(inputs)
        tensors = (inputs, offset, accumulation, colors, colors, colors, colors, colors)
        launch(shaded_kernel, len(inputs), ctx.how["BLOCK"], *tensors, *numbers, BACK=False, **ctx.how)
        ctx.save_for_backward(inputs, offset, accumulation)
        return colors

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, ...]:
        saved, slopes = ctx.saved_tensors, grad_outputs[0].contiguous()
        gradients = tuple(torch.empty_like(x) for x in saved)
        tensors, numbers = (*saved, slopes, slopes, *gradients), saved[0].shape
        launch(shaded_kernel, numbers[0], ctx.how["BLOCK"], *tensors, *numbers, BACK=True, **ctx.how)
        return gradients


def shader_inputs(gathered: Tensor, mass: Tensor, directions: Tensor, frequencies: int) -> Tensor:
    if directions.requires_grad:
        return OPERATIONS["shader_inputs"].reference(gathered, mass, directions, frequencies)
    return _ShaderInputs.apply(*dense(gathered, mass, directions), frequencies)  # type: ignore[no-any-return]


def shaded(inputs: Tensor, offset: Tensor, accumulation: Tensor) -> Tensor:
    return _Shaded.apply(*dense(inputs, offset.float(), accumulation))  # type: ignore[no-any-return]
