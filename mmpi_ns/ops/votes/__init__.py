"""Compiled forms of the look-up of votes (``mmpi_ns/blending.py`` defines it in torch): C++ here, Triton in ``gpu``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts, even_bounds
from mmpi_ns.ops.layout import SceneLayout, Tables, dense


class Votes(NamedTuple):
    """The texels whose reliability is the vote of a head on a sample, for every head that covers it.

    On a GPU, whose results have a fixed size, all heads are listed, those that do not cover a sample without texels.
    """

    places: Int[Tensor, "M"]
    """Sample * H + head; N * H where the head does not cover the sample."""
    rows: Int[Tensor, "M 8"]
    weights: Float[Tensor, "M 8"]


def empty_votes(count: int, device: torch.device | str = "cpu") -> Votes:
    places, rows = (torch.empty(*shape, dtype=torch.int64, device=device) for shape in ((count,), (count, 8)))
    return Votes(places, rows, torch.empty(count, 8, device=device))


def find_votes_on_cpu(
    layout: SceneLayout, tables: Tables, origins: Tensor, directions: Tensor, inverse_t: Tensor, heads: Tensor
) -> Votes:
    bounds, num_heads = even_bounds(len(heads)), layout.num_heads
    votes, counts = empty_votes(len(heads) * num_heads), torch.empty(len(bounds) - 1, dtype=torch.int64)
    samples = (*dense(origins, directions, inverse_t), heads.contiguous())
    call_in_parts("mmpi_find_votes", bounds, layout.cpu_scene(tables), *samples, *votes, counts)
    # Each part has left its votes in one piece.
    firsts = [num_heads * first for first in bounds[:-1]]
    pieces = [[x[i : i + n] for i, n in zip(firsts, counts.tolist(), strict=True)] for x in votes]
    return Votes(*(torch.cat(each) if len(each) > 1 else each[0] for each in pieces))
