"""Growth of a field's tables and release of bricks, by the schedule; the optimisers' moments follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmpi_ns.field.tables import TABLES, TexelTables
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.machine import give_back_freed_memory


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
    own = [(optimizers[name], getattr(field, name)) for name in TABLES if name in optimizers]
    factor = schedule.texel_factor(step)
    if factor != field.factor:
        for optimizer, table in own:
            optimizer.reset_moments(table)
        give_back_freed_memory()
        field.grow(factor)
    phase, left = schedule.phase_at(step), []
    if schedule.releases_at(step):
        give_back_freed_memory()
        left.append(field.release_unused(least))
    elif schedule.sharpened(step) and not schedule.sharpened(step - 1):
        field.look_afresh()
    if phase.name == "blend" and step == phase.start:
        left.append(field.release_untouched())
    for kept in left:
        for optimizer, table in own if kept is not None else ():
            optimizer.keep_blocks(table, kept, BRICK)
