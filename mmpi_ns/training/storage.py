"""Growth of a field's tables and release of bricks, by the schedule; the optimisers' moments follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from mmpi_ns.field.tables import TABLES, TexelTables
from mmpi_ns.scene.plan import MOST_TEXELS
from mmpi_ns.scene.texels import BRICK, head_shapes
from mmpi_ns.training.memory import Work, stored_bytes, training_bytes
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.errors import say
from mmpi_ns.utils.host import give_back_freed_memory

FORMING = 0.4
"""Factor of the weight below which bricks are released while surfaces still form."""
WORTH = 1.25
"""Least multiple of texels for which tables grow beyond the plan."""


def prepare_storage(
    field: TexelTables, schedule: Schedule, step: int, least: float, optimizers: Mapping[str, Any]
) -> None:
    """Grows tables and releases bricks as scheduled for a step.

    Args:
        field: the field that is trained.
        schedule: of the whole run.
        step: that is about to run.
        least: see ``TexelTables.release_unused``.
        optimizers: of the tables, by name, if there are any; their moments follow.
    """
    trained = [(optimizers[name], getattr(field, name)) for name in TABLES if name in optimizers]
    phase, factor, remaining = schedule.phase_at(step), schedule.texel_factor(step), []
    grows = factor > field.factor
    if grows:
        for optimizer, table in trained:
            optimizer.reset_moments(table)
    if grows or schedule.releases_at(step):
        give_back_freed_memory()
    if schedule.releases_at(step):
        remaining.append(field.release_unused(FORMING * least if grows else least))
    if grows:  # what has just been released does not grow
        field.grow(factor)
        give_back_freed_memory()
    elif schedule.sharpened(step) and not schedule.sharpened(step - 1):
        field.look_afresh()
    if phase.name == "blend" and step == phase.start:
        remaining.append(field.release_untouched())
    for kept in remaining:
        for optimizer, table in trained if kept is not None else ():
            optimizer.keep_blocks(table, kept, BRICK)
    if schedule.refines_at(step):
        refine(field, Work(field.feature_channels, any(p.name == "blend" for p in schedule.phases)), trained)


def refine(field: TexelTables, work: Work, trained: list[tuple[Any, Any]]) -> None:
    """Makes texels finer than planned where bricks were released: as fine as the plan allows within its bytes.

    Args:
        field: the field that is trained.
        work: what is trained.
        trained: optimisers and their tables.
    """
    plan = field.full_plan
    budget = training_bytes(plan, field.views, work, field.density.device)

    def bytes_of(tiles: Tensor) -> int:
        return stored_bytes(int((tiles > 0).sum()), len(tiles), work)

    longest = max(n for shape in head_shapes(plan) for n in shape[1:])
    factor = min(plan.detail, (MOST_TEXELS / longest) ** 2, field.factor * budget / bytes_of(field.tiles))
    while factor >= WORTH * field.factor:
        tiles = field.tiles_at(factor)
        if bytes_of(tiles) <= budget:
            for optimizer, table in trained:
                optimizer.reset_moments(table)
            give_back_freed_memory()
            field.grow(factor, tiles)
            give_back_freed_memory()
            say(f"Texels are {factor:.1f} times as many as planned now, in the room that released ones left.")
            return
        factor *= min(0.98, budget / bytes_of(tiles))
