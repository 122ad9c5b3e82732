"""Memory of a run, estimated and reported before it starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, SIDE, head_shapes
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.utils.errors import InputError, log
from mmpi_ns.utils.machine import free_memory

GIB = 2**30
LEAST_SHARE = 0.02
"""Fraction of a plan's texels assumed to be in reach of training rays; computing it takes time."""
RAYS_PER_PIXEL_RAY, BYTES_PER_RAY = 2, 100_000
"""Maximum rays of a step per pixel ray, with new views and keypoints; bytes of a GPU for a ray that keeps as many
samples as a step can, with their texels and gradients."""
PROGRAM_BYTES = 2**29
"""Bytes of libraries and compiled kernels on a GPU, and of an image in the viewer."""
SMALLEST_PLAN = 1e5
"""Texels below which a window is not worth training."""
ATTEMPTS = 4
"""Plans that are tried with fewer and fewer texels."""


@dataclass(frozen=True)
class Work:
    """Settings of a training that determine its memory, besides the plan."""

    feature_channels: int
    """Colour features of a texel."""
    two_phase: bool
    """Whether reliability is trained, so that it has moments."""
    pixel_rays: int = 0
    """Rays of a step."""
    all_mpis: bool = False
    """Whether each MPI renders all rays for a while."""
    sample_bytes: int = 0
    """Bytes per sample that a network evaluated for every sample stores for its gradients."""


def fit_memory(
    windows: WindowedPlan,
    views_of: Callable[[Window], TrainingViews | None],
    work: Work,
    device: str | torch.device,
    again: Callable[[float], WindowedPlan] | None = None,
) -> WindowedPlan:
    """A plan whose largest window can be trained in the memory that is free, before anything is allocated.

    Args:
        windows: of the capture.
        views_of: training images of a window.
        work: settings of the training.
        device: on which it will be trained.
        again: makes a plan with at most so many texels a window; None if a plan was given.

    Returns:
        ``windows`` if they fit, or planned again.

    Raises:
        InputError: not enough memory is free.
    """
    for left in reversed(range(ATTEMPTS)):
        for window in windows.windows:
            plan = window.plan
            free, needed = free_memory(device) - step_bytes(plan, work, device), training_bytes(plan, None, work)
            if needed > free:  # texels that no ray reaches are not stored
                least = int(LEAST_SHARE * needed)
                needed = least if least > free else training_bytes(plan, views_of(window), work, device)
            if needed > free:
                break
        else:
            return windows
        most = 0.95 * plan.texels * max(0.0, free) / needed
        if again is None or most < SMALLEST_PLAN or not left:
            raise InputError(
                f"The tables of this plan ({plan.texels / 1e6:.0f} M texels) take at least {needed / GIB:.1f} GiB in "
                f"training and {max(0.0, free) / GIB:.1f} GiB are free: give fewer texels, in the plan or with "
                "--pipeline.model.placement.max-texels."
            )
        log(
            f"{needed / GIB:.1f} GiB would be needed in training and {free / GIB:.1f} are free: texels are made "
            f"larger, {most / 1e6:.3g} M of them a window instead of {plan.texels / 1e6:.3g} M."
        )
        windows = again(most)
    return windows


def step_bytes(plan: ScenePlan, work: Work, device: str | torch.device) -> int:
    """Bytes of a GPU for a step, beside the tables; 0 on a CPU, whose memory can be swapped."""
    if torch.device(device).type != "cuda":
        return 0
    rays = work.pixel_rays * (len(plan.mpis) if work.all_mpis else 1)
    # Until surfaces have formed a ray keeps all samples, those of one MPI where each trains alone.
    samples = max((m.planes for m in plan.mpis), default=0) if work.two_phase else plan.samples_per_ray
    return rays * (RAYS_PER_PIXEL_RAY * BYTES_PER_RAY + work.sample_bytes * samples) + PROGRAM_BYTES


def training_bytes(plan: ScenePlan, views: TrainingViews | None, work: Work, device: str | torch.device = "cpu") -> int:
    """Bytes of the tables of one window at full resolution, and of their moments, before bricks are released.

    Args:
        plan: MPIs and cube.
        views: training images; texels that none can reach are not stored. None: all are stored.
        work: what is trained.
        device: where the reachable tiles are computed.
    """
    tiles = sum(depth * -(-height // SIDE) * -(-width // SIDE) for depth, height, width in head_shapes(plan))
    stored = tiles if views is None else int(reachable_tiles(views, plan, device).sum())
    return stored_bytes(stored, tiles, work)


def stored_bytes(bricks: int, tiles: int, work: Work) -> int:
    """Bytes of tables with a number of bricks besides the empty one, and of their moments.

    Args:
        bricks: number of bricks with a tile.
        tiles: of all planes, stored or not.
        work: what is trained.
    """
    learned = 1 + work.feature_channels + work.two_phase
    numbers, moments = 1 + work.feature_channels + 1, 2 * learned  # density, features, reliability; float32, bfloat16
    # Plus masks of touched texels, peaks and gains of bricks, and the tile map.
    return (bricks + 1) * (BRICK * (4 * numbers + 2 * moments + 1) + 8) + 4 * tiles


def describe(windows: WindowedPlan, steps: int, held: Sequence[int]) -> str:
    """The plan and the memory it needs, as text.

    Args:
        windows: of the capture.
        steps: of each window.
        held: bytes of tables, moments and training pixels while each window trains.
    """
    texels, lines, indent = [plan.texels for plan in windows.plans], [], ""
    if len(windows) > 1:
        indent = "  "
        lines.append(
            f"A long capture: {len(windows)} windows of {steps} steps each, one after the other; "
            f"{sum(texels) / 1e6:.1f} M texels on disk, at most {max(texels) / 1e6:.1f} M in training at a time."
        )
    for i, window in enumerate(windows.windows):
        if len(windows) > 1:
            lines.append(f"Window {i}, cameras within {window.radius:.3g} (and {window.margin:.3g} more to mix):")
        plan, count = window.plan, len(window.plan.mpis)
        mpis = f"{count} {'MPI' if count == 1 else 'MPIs'}"
        lines.append(f"{indent}Scene plan ({plan.origin_of_plan}): {mpis}, {plan.texels / 1e6:.1f} M texels")
        for m in plan.mpis:
            lines.append(
                f"{indent}  {m.name}: {m.planes} planes of {m.height} x {m.width}, depths {m.near:.3g} to {m.far:.3g}, "
                f"tangents {' '.join(f'{t:.2f}' for t in m.extent)}"
            )
        if plan.cube is not None:
            lines.append(f"{indent}  cube: {' x '.join(map(str, plan.cube.shape))} voxels")
    memory = f"{max(held) / GIB:.2f} GiB of tables, moments and pixels"
    return "\n".join([*lines, f"Memory in training: at most {memory}, plus the program and the work of a step."])
