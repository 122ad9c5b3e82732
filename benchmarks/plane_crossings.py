"""Test images of a run, and every plane that rays cross."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from score import evenly
from torch import Tensor

from mmpi_ns.scene.geometry import Frames, PlaneHits, inverse_distance, sample_disparity

Image = tuple[Any, Tensor]
"""A test camera and its image [H, W, 3]."""
AHEAD = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Axes of an MPI that faces +z."""


def images_of(pipeline: Any, count: int = 0) -> Iterator[Image]:
    """Test images of a finished run, evenly spaced; 0 for all."""
    data, device = pipeline.datamanager.eval_dataset, pipeline.model.device
    for i in evenly(len(data), count):
        yield data.cameras[i : i + 1].to(device), pipeline.model.observed(data.get_data(i))


def crossings(hits: PlaneHits, frames: Frames, k: int, planes: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Every plane of MPI k, nearest first: whether it is intersected, the tangents u and v, and 1/t. [R, L] each"""
    m = torch.arange(planes - 1, -1, -1).expand(len(hits.count), -1)
    w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
    first, count = hits.m_first[:, k, None], hits.count[:, k, None]
    u, v = (x[:, k, :1] + w * x[:, k, 1:] for x in (hits.u, hits.v))
    q = inverse_distance(w, hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:])
    return (m <= first) & (m > first - count), u, v, q
