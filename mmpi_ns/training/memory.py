"""Memory of a run, estimated and reported before it starts."""

from __future__ import annotations

from collections.abc import Callable

import torch

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, SIDE, head_shapes
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.machine import free_memory

GIB = 2**30
LEAST_SHARE = 0.02
"""Fraction of a plan's texels assumed to be in reach of training rays; computing it takes time."""


def texel_bytes(feature_channels: int, two_phase: bool) -> int:
    """Bytes of a stored texel in the tables and moments; ``two_phase``: reliability is trained, so it has moments."""
    numbers, learned = 1 + feature_channels + 1, 1 + feature_channels + two_phase  # density, features, reliability
    return 4 * numbers + 2 * 2 * learned + 1  # in float32, in bfloat16, and whether a training ray read it


def check_memory(
    windows: WindowedPlan,
    views_of: Callable[[Window], TrainingViews | None],
    per_texel: int,
    device: str | torch.device,
) -> None:
    """Raises InputError if not enough memory is free on a device to train a window, before anything is allocated."""
    for window in windows.windows:
        plan = window.plan
        free, needed = free_memory(device), training_bytes(plan, None, per_texel)
        if LEAST_SHARE * needed <= free < needed:  # texels that no ray reaches are not stored
            needed = training_bytes(plan, views_of(window), per_texel, device)
        if needed > free:
            fitting = 0.95 * plan.texels * free / needed
            raise InputError(
                f"The tables of this plan ({plan.texels / 1e6:.0f} M texels) take at least {needed / GIB:.1f} GiB in "
                f"training and {free / GIB:.1f} GiB are free: give fewer texels, in the plan or with "
                f"--pipeline.model.placement.max-texels {fitting:.2g}."
            )


def training_bytes(
    plan: ScenePlan, views: TrainingViews | None, per_texel: int, device: str | torch.device = "cpu"
) -> int:
    """Bytes of the tables of one window at full resolution, and of their moments, before bricks are released. Texels
    that none of ``views`` can reach are not stored (None: all are); ``device`` computes which."""
    tiles = sum(depth * -(-height // SIDE) * -(-width // SIDE) for depth, height, width in head_shapes(plan))
    stored = tiles if views is None else int(reachable_tiles(views, plan, device).sum())
    return stored_bytes(stored, tiles, per_texel)


def stored_bytes(bricks: int, tiles: int, per_texel: int) -> int:
    """Bytes of tables with a number of bricks besides the empty one, and of their moments; ``tiles`` are those of all
    planes, stored or not."""
    return (bricks + 1) * (BRICK * per_texel + 8) + 4 * tiles  # with peaks and gains of bricks, and the tile map


def describe(windows: WindowedPlan, steps: int, held: int) -> str:
    """The plan and the memory it needs, as text: ``steps`` are of each window, ``held`` bytes of the largest one."""
    lines = []
    for i, window in enumerate(windows.windows):
        plan, count = window.plan, len(window.plan.mpis)
        mpis = f"{count} {'MPI' if count == 1 else 'MPIs'}" + (" and a cube" if plan.cube is not None else "")
        which = f"Window {i}, cameras within {window.radius:.3g}" if len(windows) > 1 else "Scene plan"
        lines.append(f"{which} ({plan.origin_of_plan}): {mpis}, {plan.texels / 1e6:.1f} M texels")
    if len(windows) > 1:
        lines.append(f"A long capture: {len(windows)} windows of {steps} steps each, one after the other.")
    memory = f"{held / GIB:.2f} GiB of tables and moments"
    return "\n".join([*lines, f"Memory in training: at most {memory}, plus pixels, program and the work of a step."])
