"""The compiled total variation against its reference."""

from __future__ import annotations

import math

import pytest
import torch
from bricked import layout_of
from compiled import compiled, normal  # noqa: F401
from hand_made import make_mpi

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.variation import total_variation
from mmpi_ns.scene.plan import CubePlan, ScenePlan
from mmpi_ns.scene.texels import BRICK


@pytest.mark.parametrize(("channels", "chroma"), [(1, 0.0), (8, 0.0), (9, 0.0), (3, 2.5), (8, 2.5), (20, 2.5)])
def test_variation_equals_the_reference_with_its_gradient(channels, chroma):
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (3, 2, 4))
    plan = ScenePlan((make_mpi("a", height=5, width=4, planes=3), make_mpi("b", height=2, width=3)), cube, 0.05, 1.0)
    layout = MMPIField(plan).layout
    grids = layout.grids
    texels = torch.cat([g.rows for g in grids])
    table = normal(len(grids[0].places) * 64, channels) * 2
    rows = texels[torch.randperm(plan.texels, generator=torch.Generator().manual_seed(1))[: plan.texels - 9]]
    actual, scales = [], torch.tensor([(0.5, 2.0, 1.0), (1.0, 3.0, 0.3), (0.7, 1.0, 2.0)])
    for function in (total_variation, total_variation.reference):
        values = table[rows].requires_grad_()
        value = function(values, table, rows, layout, scales, chroma)
        (3 * value).backward()
        actual.append((value.item(), values.grad))
    assert actual[0][0] == pytest.approx(actual[1][0], rel=1e-5) and actual[0][0] > 1
    assert torch.allclose(actual[0][1], actual[1][1], atol=1e-5)


@pytest.mark.parametrize("function", [total_variation, total_variation.reference])
@pytest.mark.parametrize("channels", [3, 8, 20])
def test_differences_of_chroma_count_more_in_the_gradient_and_not_in_the_value(function, channels):
    layout = layout_of([(3, 7, 6), (2, 5, 9)])
    table = 2 * normal(len(layout.grids[0].places) * BRICK, channels)
    rows, scales = torch.cat([g.rows for g in layout.grids]).sort()[0], torch.tensor([(0.5, 2.0, 1.0), (1.0, 3.0, 0.3)])
    exact, fast = table[rows].double().requires_grad_(), table[rows].requires_grad_()
    wanted = total_variation.reference(exact, table.double(), rows, layout, scales)
    wanted.backward()
    value = function(fast, table, rows, layout, scales, 50.0)
    (3 * value + fast.sum()).backward()
    gradient = []
    for row in exact.grad.tolist():
        mean = sum(row[:3]) / 3
        gradient.append([3 * (x + 50 * (x - mean)) + 1 for x in row[:3]] + [3 * x + 1 for x in row[3:]])
    assert value.item() == pytest.approx(wanted.item(), rel=1e-6)
    assert torch.allclose(fast.grad.double(), torch.tensor(gradient, dtype=torch.float64), rtol=1e-5, atol=2e-4)
    assert (fast.grad - exact.grad).abs().max() > 50


def test_variation_says_where_a_texel_is_not_a_number():
    layout = layout_of([(2, 9, 9)])
    grids = layout.grids
    table = normal(len(grids[0].places) * BRICK, 9)
    broken = int(grids[0].row(torch.tensor([1]), torch.tensor([8]), torch.tensor([3])))
    table[broken, 4] = math.nan
    rows = grids[0].rows.sort()[0]
    values = table[rows].requires_grad_()
    value = total_variation(values, table, rows, layout, torch.ones(1, 3))
    value.backward()
    own = (rows == broken).nonzero().item()
    assert value.isnan() and values.grad[own, 4].isnan() and values.grad.isnan().sum() == 1 + 4, "and its neighbours"
