"""In which order tables grow and bricks are released (training.run.py)."""

from __future__ import annotations

import pytest
import torch
from hand_made import make_mpi

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.tables import TABLES
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.training.memory import texel_bytes, training_bytes
from mmpi_ns.training.phases import Phase, Schedule
from mmpi_ns.training.report import EARLY_COST, TrainingLog
from mmpi_ns.training.storage import MOST_COPIED, copy_finely, refine
from mmpi_ns.training.touched_adam import TouchedAdam


def half_empty(detail: float, share: float) -> MMPIField:
    """A field of 256 tiles of which the first share of each plane holds something."""
    plan = ScenePlan((make_mpi(planes=4, height=64, width=64),), None, 0.05, 1.5, detail=detail)
    field = MMPIField(plan, shading="ray", feature_channels=8)
    field.features.data.normal_(generator=torch.Generator().manual_seed(0))
    field.peak[1:] = (torch.arange(64) < 64 * share).repeat(4)
    field.crossings.fill_(1e9)
    field.release_unused(0.5)
    return field


def used_bytes(field: MMPIField, optimizer: TouchedAdam) -> int:
    """Of the tables, what belongs to them, and the moments that training the density and the features would take."""
    buffers = [field.tiles, field.touched, field.peak, field.gain, *(getattr(field, name).data for name in TABLES)]
    for table in (field.density, field.features):
        table.add_grad(torch.tensor([BRICK]), torch.ones(1, table.shape[1]))
    optimizer.step()
    moments = [optimizer.state[table]["moments"] for table in (field.density, field.features)]
    return sum(x.nbytes for x in [*buffers, *moments])


@pytest.mark.parametrize(("detail", "share", "factor"), [(1.0, 0.15, 1.0), (1.5, 0.15, 1.5), (8.0, 0.9, 1.0)])
def test_texels_become_as_fine_as_rays_can_train_unless_hardly_anything_was_released(detail, share, factor):
    field = half_empty(detail, share)
    before = field.features.data.clone()
    refine(field, texel_bytes(8, False), training_bytes(field.full_plan, None, texel_bytes(8, False)), [])
    assert field.factor == factor
    assert (factor > 1) != torch.equal(field.features.data, before)


@pytest.mark.parametrize(("share", "room"), [(0.25, 1.0), (0.5, 1.0), (1.0, 1.0), (1.0, 1.2), (0.25, 0.5), (0.25, 0.3)])
def test_bricks_of_the_largest_gain_get_copies_within_the_bytes_of_the_plan(share, room):
    field = half_empty(64.0, share)
    optimizer = TouchedAdam([field.density, field.features], lr=0.1)
    trained = [(optimizer, field.density), (optimizer, field.features)]
    budget = int(room * training_bytes(field.full_plan, None, texel_bytes(8, False)))
    gain = torch.zeros(field.num_bricks + 1)
    count, best = field.num_bricks, field.num_bricks // 2
    gain[1:], gain[best] = 0.1, 5.0
    place = int(field.grids[0].places[best])
    copy_finely(field, gain, texel_bytes(8, False), budget, trained)
    if (share, room) in ((1.0, 1.0), (0.25, 0.3)):  # a brick and its neighbours have no room
        assert not field.copied and field.num_bricks == count
        return
    assert field.copied and not optimizer.state and used_bytes(field, optimizer) <= budget
    copy, mpi = field.grids
    assert count < field.num_bricks <= count + 4 * 9 * MOST_COPIED * count
    plane, y, x = place // 64, place // 8 % 8, place % 8
    assert (copy.own_tiles[plane, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2] > 0).all(), "the brick of the largest gain"
    assert mpi.own_tiles[plane, y, x] == 0, "which the MPI gives up"


def test_the_time_left_knows_that_steps_cost_less_once_surfaces_have_formed():
    schedule = Schedule((Phase("joint", 0, 100),), (10, 20), 1.0, 0.0, windows=2, formed=20)
    log = TrainingLog(schedule, rays=64, first=0)
    assert log.remaining(149, 149) == 50 and log.remaining(190, 199) == 0
    assert log.remaining(110, 110) == pytest.approx(9 + 80 / EARLY_COST)
    assert log.remaining(20, 20) == pytest.approx(79 + 20 * EARLY_COST + 80)
    mixed = (1 + EARLY_COST) / 2
    assert log.remaining(119, 120) == pytest.approx(79 / mixed), "an interval on both sides of the border"
