"""Tensors of a wrong shape never reach C++ or Triton (ops/layout.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.layout import check_shapes


class Pair(NamedTuple):
    rows: Int[Tensor, "N 4"]
    values: Float[Tensor, "N C"] | None = None


@dataclass
class Group:
    marks: Int[Tensor, "N"]


class Sized:
    @property
    def sizes(self):
        return {"T": 7}


def owner(layout: Sized, pair: Pair, table: Float[Tensor, "T C"], groups: list[Group], free: Int[Tensor, "..."]):
    """What an operation looks like."""


def check(rows=(5, 4), values=(5, 9), table=(7, 9), groups=((3,), (2,)), free=(1, 2)):
    pair = Pair(torch.zeros(rows), None if values is None else torch.zeros(values))
    listed = [Group(torch.zeros(shape)) for shape in groups]
    values = {"layout": Sized(), "pair": pair, "table": torch.zeros(table), "groups": listed}
    check_shapes(owner, values | {"free": torch.zeros(free)})


def test_letters_stand_for_one_size_each():
    check()
    check(values=None)
    check(free=())


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        *(("rows", shape) for shape in ((5, 3), (5,), (6, 4))),
        *(("values", shape) for shape in ((6, 9), (5,), (5, 9, 1))),
        *(("table", shape) for shape in ((8, 9), (7, 8), (7,))),
    ],
)
def test_another_shape_is_refused_by_the_tensors_name(name, shape):
    with pytest.raises(ValueError, match=r"(rows|values|table) has the shape \["):
        check(**{name: shape})


def test_each_of_a_list_has_sizes_of_its_own():
    with pytest.raises(ValueError, match=r"marks has the shape \[2, 1\]"):
        check(groups=((3,), (2, 1)))
