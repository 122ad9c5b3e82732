"""Growth of a field's tables and release of bricks, by the schedule; the optimisers' moments follow."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from mmpi_ns.field.tables import TABLES, TexelTables
from mmpi_ns.scene.bricks import tiles_with_copies
from mmpi_ns.scene.plan import FINER, MOST_TEXELS
from mmpi_ns.scene.texels import head_shapes
from mmpi_ns.training.memory import stored_bytes, texel_bytes, training_bytes
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.errors import log
from mmpi_ns.utils.host import give_back_freed_memory

FORMING = 0.4
"""Factor of the weight below which bricks are released while surfaces still form."""
WORTH = 1.25
"""Minimum factor by which texels grow beyond the plan."""
ROOM = 0.4
"""Share of the planned memory that finer texels may fill: with more, texels overfit single images
(docs/ablations.md)."""
MOST_COPIED = 0.1
"""Share of the bricks that get a finer copy for their errors; adjacent bricks get one, too."""


def prepare_storage(
    field: TexelTables, schedule: Schedule, step: int, least: float, optimizers: Mapping[str, Any]
) -> None:
    """Grows tables and releases bricks (below the weight ``least``) as scheduled for the step that is about to run; the
    moments of ``optimizers``, by name of the table, follow."""
    trained = [(optimizers[name], getattr(field, name)) for name in TABLES if name in optimizers]
    phase, factor, remaining = schedule.phase_at(step), schedule.texel_factor(step), []
    grows = factor > field.factor
    if grows:
        for optimizer, table in trained:
            optimizer.state.pop(table, None)
    if grows or schedule.releases_at(step):
        give_back_freed_memory()
    gain = field.gain if schedule.refines_at(step, copies=True) else None
    if schedule.releases_at(step):
        remaining.append(field.release_unused(FORMING * least if grows else least))
    if grows:  # released bricks do not grow
        field.grow(factor)
        give_back_freed_memory()
    elif schedule.sharpened(step) and not schedule.sharpened(step - 1):
        field.look_afresh()
    if phase.name == "blend" and step == phase.start:
        remaining.append(field.release_untouched())
    for kept in remaining:
        gain = gain if gain is None or kept is None else gain[kept]
        for optimizer, table in trained if kept is not None else ():
            optimizer.keep_bricks(table, kept)
    if schedule.refines_at(step) and field.num_copies == 0:
        per_texel = texel_bytes(field.feature_channels, two_phase=not schedule.is_joint)
        budget = training_bytes(field.full_plan, field.views, per_texel, field.density.device)
        if gain is not None and schedule.is_joint and field.full_plan.may_be_copied(field.factor):
            copy_finely(field, gain, per_texel, budget, trained)
        else:
            refine(field, per_texel, budget, trained)


def refine(field: TexelTables, per_texel: int, budget: int, trained: list[tuple[Any, Any]]) -> None:
    """Makes texels finer than planned where bricks were released: as fine as the plan allows within ``ROOM`` of
    ``budget`` bytes of tables and moments. ``trained`` are optimisers and their tables."""
    plan, budget = field.full_plan, int(ROOM * budget)
    needed = stored_bytes(field.num_bricks, len(field.tiles), per_texel)
    longest = max(n for shape in head_shapes(plan) for n in shape[1:])
    factor = min(plan.detail, (MOST_TEXELS / longest) ** 2, field.factor * budget / needed)
    while factor >= WORTH * field.factor:
        tiles = field.tiles_at(factor)
        needed = stored_bytes(int((tiles > 0).sum()), len(tiles), per_texel)
        if needed <= budget:
            for optimizer, table in trained:
                optimizer.state.pop(table, None)
            give_back_freed_memory()
            field.grow(factor, tiles)
            give_back_freed_memory()
            log(f"The number of texels is now {factor:.1f} times the planned one, in the memory of released bricks.")
            return
        factor *= min(0.98, budget / needed)


def copy_finely(
    field: TexelTables, gain: Float[Tensor, "B"], per_texel: int, budget: int, trained: list[tuple[Any, Any]]
) -> None:
    """Makes finer copies of the bricks in which training rays have the largest errors (``TexelTables.gain``), and of
    adjacent ones, if there are none yet. Arguments are those of ``refine``."""
    grids, copies = field.grids, field.copy_grids()
    first_voxel = sum(grid.own_tiles.numel() for grid in grids[: len(copies)])
    order = gain[1:].argsort(descending=True, stable=True) + 1
    order = order[grids[0].places[order] < first_voxel]  # the cube has no copy

    def chosen(count: int) -> tuple[Tensor, bool]:
        """Tiles of the first bricks and the stored ones around them on their planes; whether their copies fit."""
        tiles = torch.zeros_like(field.tiles, dtype=torch.bool)
        tiles[grids[0].places[order[:count]]] = True
        wide = tiles.clone()
        for grid in grids[: len(copies)]:
            here = slice(grid.first_tile, grid.first_tile + grid.own_tiles.numel())
            images = tiles[here].view(grid.own_tiles.shape)[:, None].float()
            wide[here] |= (max_pool2d(images, 3, 1, 1) > 0).reshape(-1)
        wide &= field.tiles > 0
        fine, kept = tiles_with_copies(grids, copies, wide)
        needed = stored_bytes(int(fine.sum()) + int(kept.sum()), len(fine) + len(kept), per_texel)
        return wide, needed <= budget

    # More bricks nearly always take more room. The number taken fits, whether or not a few more would.
    most = int(MOST_COPIED * len(order))
    count = bisect_left(range(1, most + 1), True, key=lambda n: not chosen(n)[1])
    if not count or not float(gain.sum()) > 0:
        return
    for optimizer, table in trained:
        optimizer.state.pop(table, None)
    tiles, _ = chosen(count)
    share = float(gain[field.tiles[tiles].to(torch.int64)].sum() / gain.sum())
    stored = int(tiles.sum()) / field.num_bricks
    give_back_freed_memory()
    field.copy_finely(tiles)
    give_back_freed_memory()
    log(f"{stored:.0%} of the bricks, with {share:.0%} of the errors, have {FINER**2} times as many texels now.")
