"""Parallax between two images, compiled: ``matches.cpp``. In the caller's thread, as threads share the images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from mmpi_ns.ops.build import run_in_parts
from mmpi_ns.ops.layout import dense
from mmpi_ns.ops.matches import Compared, Measured, Places

Maps = TypeVar("Maps", bound=Sequence[Tensor])
MOST = 16
"""Measurements of a pixel, as in ``matches.cpp``."""


def _written(maps: Maps, name: str, *values: Any) -> Maps:
    run_in_parts(f"mmpi_{name}", [0, len(maps[0])], *values, *maps)
    return maps


def place_pixels(inverse: Tensor, linear: Tensor, b: Tensor, first_row: int) -> Places:
    places = Places(*torch.empty(3, *inverse.shape))
    return _written(places, "place_pixels", *dense(inverse, linear, b), inverse.shape[1], first_row)


def follow_motion(x: Tensor, y: Tensor, motion: Tensor, first_row: int) -> tuple[Tensor, Tensor]:
    assert min(x.shape) > 1, x.shape
    moved = (torch.empty(motion.shape[:2]), torch.empty(motion.shape[:2]))
    return _written(moved, "follow_motion", *dense(x, y, motion), *x.shape, first_row)


def solve_matches(
    x: Tensor, y: Tensor, alike: Tensor, usable: Tensor, linear: Tensor, b: Tensor,
    first_row: int, noise: float, farthest: float,
) -> Measured:  # fmt: skip
    arrays = *dense(x, y, alike), *dense(usable, dtype=torch.bool), *dense(linear, b)
    measured = Measured(*torch.empty(2, *x.shape))
    return _written(measured, "solve_matches", *arrays, x.shape[1], first_row, noise**2, farthest**2)


def average_matches(inverse: Tensor, certainty: Tensor, most_relative: float) -> Measured:
    count, pixels = inverse.shape
    assert count <= MOST, count
    averaged = Measured(*torch.empty(2, pixels))
    return _written(averaged, "average_matches", *dense(inverse, certainty), pixels, count, most_relative)


def compare_depths(
    inverse: Tensor, error: Tensor, their_inverse: Tensor, their_error: Tensor, linear: Tensor, b: Tensor,
    first_row: int, same: float,
) -> Compared:  # fmt: skip
    arrays = dense(inverse, error, their_inverse, their_error, linear, b)
    compared = Compared(*torch.empty(2, *inverse.shape, dtype=torch.bool))
    return _written(compared, "compare_depths", *arrays, inverse.shape[1], *their_inverse.shape, first_row, same)
