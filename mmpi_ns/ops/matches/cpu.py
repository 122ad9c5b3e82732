"""Parallax between two images, compiled: ``matches.cpp``. In the caller's thread, as threads share the images."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import run_in_parts
from mmpi_ns.ops.layout import shaped
from mmpi_ns.ops.matches import Compared, Measured, Moved, Places

MOST = 16
"""Measurements of a pixel, as in ``matches.cpp``."""


def place_pixels(inverse: Tensor, linear: Tensor, b: Tensor, first_row: int) -> Places:
    height, width = inverse.shape
    places = Places(*(torch.empty(height, width) for _ in range(3)))
    arrays = shaped(inverse, height, width), shaped(linear, 3, 3), shaped(b, 3)
    run_in_parts("mmpi_place_pixels", [0, height], arrays, (width, first_row, *places))
    return places


def follow_motion(x: Tensor, y: Tensor, motion: Tensor, first_row: int) -> Moved:
    (height, width), rows = x.shape, len(motion)
    assert min(height, width) > 1, x.shape
    moved = Moved(torch.empty(rows, width), torch.empty(rows, width))
    arrays = shaped(x, height, width), shaped(y, height, width), shaped(motion, rows, width, 2)
    run_in_parts("mmpi_follow_motion", [0, rows], arrays, (height, width, first_row, *moved))
    return moved


def solve_matches(
    x: Tensor, y: Tensor, alike: Tensor, usable: Tensor, linear: Tensor, b: Tensor,
    first_row: int, noise: float, farthest: float,
) -> Measured:  # fmt: skip
    height, width = x.shape
    maps = [shaped(each, height, width) for each in (x, y, alike)]
    arrays = *maps, shaped(usable, height, width, dtype=torch.bool), shaped(linear, 3, 3), shaped(b, 3)
    measured = Measured(torch.empty(height, width), torch.empty(height, width))
    run_in_parts("mmpi_solve_matches", [0, height], arrays, (width, first_row, noise**2, farthest**2, *measured))
    return measured


def average_matches(inverse: Tensor, certainty: Tensor, most_relative: float) -> Measured:
    count, pixels = inverse.shape
    assert count <= MOST, count
    arrays = shaped(inverse, count, pixels), shaped(certainty, count, pixels)
    averaged = Measured(torch.empty(pixels), torch.empty(pixels))
    run_in_parts("mmpi_average_matches", [0, pixels], arrays, (pixels, count, most_relative, *averaged))
    return averaged


def compare_depths(
    inverse: Tensor, error: Tensor, their_inverse: Tensor, their_error: Tensor, linear: Tensor, b: Tensor,
    first_row: int, same: float,
) -> Compared:  # fmt: skip
    (rows, width), theirs = inverse.shape, their_inverse.shape
    depths = shaped(inverse, rows, width), shaped(error, rows, width)
    others = shaped(their_inverse, *theirs), shaped(their_error, *theirs)
    compared = Compared(*torch.empty(2, rows, width, dtype=torch.bool))
    arrays = *depths, *others, shaped(linear, 3, 3), shaped(b, 3)
    run_in_parts("mmpi_compare_depths", [0, rows], arrays, (width, *theirs, first_row, same, *compared))
    return compared
