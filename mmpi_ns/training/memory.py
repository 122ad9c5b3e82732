"""Plan and memory of a run, reported before it starts."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, SIDE, head_shapes
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.machine import free_memory

GIB = 2**30
LEAST_SHARE = 0.02
"""Fraction of a plan's texels assumed to be in reach of training rays; computing it takes time."""


def check_memory(
    windows: WindowedPlan,
    views: Sequence[TrainingViews | None],
    feature_channels: int,
    two_phase: bool,
    device: str | torch.device,
) -> None:
    """Compares the memory that the largest window needs in training with what is free, before anything is allocated.

    Args:
        windows: of the capture.
        views: training images of each window.
        feature_channels, two_phase: see ``training_bytes``.
        device: on which it will be trained.

    Raises:
        InputError: not enough memory is free.
    """
    free = free_memory(device)
    for plan, seen in zip(windows.plans, views, strict=True):
        everything = training_bytes(plan, None, feature_channels, two_phase)
        needed = max(_bytes_to_look(plan, seen), int(LEAST_SHARE * everything))
        if needed <= free < everything:
            needed = training_bytes(plan, seen, feature_channels, two_phase)
        if needed > free:
            raise InputError(
                f"The tables of this plan ({plan.texels / 1e6:.0f} M texels) take at least {needed / GIB:.1f} GiB in "
                f"training and {free / GIB:.1f} GiB are free: give fewer texels, in the plan or with "
                "--pipeline.model.placement.max-texels."
            )


def _bytes_to_look(plan: ScenePlan, views: TrainingViews | None) -> int:
    """Bytes needed to find the tiles that training rays can reach: marks, and the 4 side planes of every image at the
    tiles of one plane (``visible_tiles``)."""
    cameras = 0 if views is None else len(views.origins)
    largest = max(-(-height // SIDE) * -(-width // SIDE) for _, height, width in head_shapes(plan))
    return 8 * count_tiles(plan) + 4 * 8 * 3 * cameras * largest


def count_tiles(plan: ScenePlan) -> int:
    """Tiles of 8 x 8 texels of all planes, stored or not."""
    return sum(depth * -(-height // SIDE) * -(-width // SIDE) for depth, height, width in head_shapes(plan))


def training_bytes(plan: ScenePlan, views: TrainingViews | None, feature_channels: int, two_phase: bool) -> int:
    """Bytes of the tables of one window at full resolution, and of their moments, before bricks are released.

    Args:
        plan: MPIs and cube.
        views: training images; texels that none can reach are not stored. None: all are stored.
        feature_channels: colour features of a texel.
        two_phase: whether reliability is trained, so that it has moments.
    """
    tiles = count_tiles(plan)
    stored = tiles if views is None else int(reachable_tiles(views, plan).sum())
    return stored_bytes(stored, tiles, feature_channels, two_phase)


def stored_bytes(bricks: int, tiles: int, feature_channels: int, two_phase: bool) -> int:
    """Bytes of tables with so many bricks besides the empty one, and of their moments.

    Args:
        bricks: that hold a tile.
        tiles: of all planes, stored or not.
        feature_channels, two_phase: see ``training_bytes``.
    """
    learned = 1 + feature_channels + two_phase
    numbers, moments = 1 + feature_channels + 1, 2 * learned  # density, features, reliability; in float32, bfloat16
    # Also marks of touched texels, peaks of bricks, and the tile map.
    return (bricks + 1) * (BRICK * (4 * numbers + 2 * moments + 1) + 4) + 4 * tiles


def describe(windows: WindowedPlan, steps: int, tables: Sequence[int], pixels: Sequence[int]) -> str:
    """The plan and the memory it needs, as text.

    Args:
        windows: of the capture.
        steps: of each window.
        tables: ``training_bytes`` of each window.
        pixels: bytes of training pixels in memory while each window trains.
    """
    most = max(range(len(windows)), key=lambda w: tables[w] + pixels[w])
    memory = (
        f"Memory in training: at most {(tables[most] + pixels[most]) / GIB:.2f} GiB (tables and moments "
        f"{tables[most] / GIB:.2f}, pixels {pixels[most] / GIB:.2f}), plus the program and the work of a step."
    )
    if len(windows) == 1:
        return "\n".join([*_describe_plan(windows.plans[0]), memory])
    texels = [plan.texels for plan in windows.plans]
    lines = [
        f"A long capture: {len(windows)} windows of {steps} steps each, one after the other; {sum(texels) / 1e6:.1f} M "
        f"texels on disk, at most {max(texels) / 1e6:.1f} M in training at a time."
    ]
    for i, window in enumerate(windows.windows):
        lines.append(f"Window {i}, cameras within {window.radius:.3g} (and {window.margin:.3g} more to mix):")
        lines += ["  " + line for line in _describe_plan(window.plan)]
    return "\n".join([*lines, memory])


def _describe_plan(plan: ScenePlan) -> list[str]:
    count = f"{len(plan.mpis)} {'MPI' if len(plan.mpis) == 1 else 'MPIs'}"
    lines = [f"Scene plan ({plan.origin_of_plan}): {count}, {plan.texels / 1e6:.1f} M texels"]
    for m in plan.mpis:
        tangents = " ".join(f"{t:.2f}" for t in m.extent)
        lines.append(
            f"  {m.name}: {m.planes} planes of {m.height} x {m.width}, "
            f"depths {m.near:.3g} to {m.far:.3g}, tangents {tangents}"
        )
    if plan.cube is not None:
        lines.append(f"  cube: {' x '.join(str(n) for n in plan.cube.shape)} voxels")
    return lines
