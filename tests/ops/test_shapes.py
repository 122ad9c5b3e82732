"""Tensors of a wrong shape never reach C++ or Triton (ops/layout.py)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import kernel_cases
import pytest
import torch
from jaxtyping import Float, Int
from random_bricks import random_window, rays_into
from torch import Tensor

from mmpi_ns.ops.layout import Tables, check_shapes
from mmpi_ns.ops.march import MarchOptions, Rays
from mmpi_ns.sampler import march, show_rays
from mmpi_show.ops.baked import show_baked


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


# Every entry of the walk ---------------------------------------------------------------------------------------------

WIDER = {"a row more": (1, 0), "a column more": (0, 1), "a row less": (-1, 0)}


def changed(x, rows, columns):
    """A tensor with more or fewer rows, and more columns, of zeros."""
    shape = [len(x) + rows, *x.shape[1:-1], *([x.shape[-1] + columns] if x.ndim > 1 else [])]
    return x.new_zeros(shape if x.ndim > 1 or rows else (*shape, 1))


def walked():
    """Arguments of the march and of pictures: a layout, tables, features, rays and options."""
    layout, tables, rays, _ = kernel_cases.CASES["march"]("cpu", kernel_cases.SMALL)[0]
    heads, priorities = torch.ones(5, 3, dtype=torch.bool), torch.rand(5, 2)
    rays = Rays(*(x[:5] for x in rays[:4]), heads, priorities)
    return layout, tables, torch.zeros(len(tables.density), 4), rays, MarchOptions(0.01)


@pytest.mark.parametrize("change", WIDER)
@pytest.mark.parametrize("name", [*Tables._fields, "features", *Rays._fields])
def test_no_tensor_of_a_walk_through_texels_may_have_another_shape(name, change):
    layout, tables, features, rays, options = walked()
    march(layout, tables, rays, options)
    show_rays(layout, tables, features, rays, options)
    if name == "features":
        if change == "a column more":
            return  # texels may have any number of channels
        features = changed(features, *WIDER[change])
    elif name in Tables._fields:
        tables = tables._replace(**{name: changed(getattr(tables, name), *WIDER[change])})
    else:
        rays = rays._replace(**{name: changed(getattr(rays, name), *WIDER[change])})
    with pytest.raises(ValueError, match="has the shape"):
        show_rays(layout, tables, features, rays, options)
    if name != "features":
        with pytest.raises(ValueError, match="has the shape"):
            march(layout, tables, rays, options)


@pytest.mark.parametrize("change", WIDER)
@pytest.mark.parametrize("name", ["columns", "density", "texels", "peaks", *Rays._fields[:4]])
def test_no_tensor_of_a_walk_through_bricks_may_have_another_shape(name, change):
    window = random_window()
    rays, peaks, scene = Rays(*rays_into(window, 5 * 5)), torch.zeros(window.mpis.num_bricks, 8, 8), window.mpis
    show_baked(scene, rays, 0.01, peaks)
    if name in Rays._fields:
        rays = rays._replace(**{name: changed(getattr(rays, name), *WIDER[change])})
    elif name == "peaks":
        peaks = changed(peaks, *WIDER[change])
    else:
        scene = replace(scene, packed={}, **{name: changed(getattr(scene, name), *WIDER[change])})
    with pytest.raises((ValueError, AssertionError), match=r"shape|is read"):
        show_baked(scene, rays, 0.01, peaks)
