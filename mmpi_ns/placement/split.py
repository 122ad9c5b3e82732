"""Splits a long capture into windows: balls of neighbouring cameras, each placed separately."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from mmpi_ns.placement.candidates import vector
from mmpi_ns.placement.observations import Array, Observations, farthest_first, find_visible_points
from mmpi_ns.placement.rule import place
from mmpi_ns.scene.plan import NO_PLAN
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.settings import PlacementConfig
from mmpi_ns.utils.errors import InputError

MARGIN = 0.08
"""Distance over which the share of a window falls off, as a fraction of the windows' length."""
FEWEST = 8
"""Minimum training cameras of a window; smaller ones are merged with their neighbours."""
SLACK = 1.1
"""Factor by which windows may be longer than configured."""
ROUNDS = 50
"""Rounds of moving windows to the centres of their cameras."""


def place_windows(
    observations: Observations, config: PlacementConfig, training_rays: int | None = None
) -> WindowedPlan:
    """A plan for each window of a capture; a single one for a short capture. Budgets and ``training_rays`` are those of
    one window. Raises ValueError if the cameras leave nothing to place."""
    balls = find_balls(observations, config.window_length)
    if len(balls) < 2:
        return WindowedPlan.single(place(observations, config, training_rays))
    observed = (of_cameras(observations, cameras_of(ball, observations.centers)) for ball in balls)
    plans = (place(each, config, training_rays) for each in observed)
    return WindowedPlan(tuple(replace(ball, plan=plan) for ball, plan in zip(balls, plans, strict=True)))


def most_pixels(observations: Observations, windows: Sequence[Window]) -> float:
    """Training pixels of the largest window; of the capture without any."""
    pixels = observations.sizes.prod(-1)
    cameras = (cameras_of(window, observations.centers) for window in windows)
    return float(max((pixels[some].sum() for some in cameras), default=pixels.sum()))


def find_balls(observations: Observations, length: float) -> list[Window]:
    """The windows without plans, in order along the path; independent of the cameras' order. ``length`` is the maximum
    of a window, in median distances of the content; 0 for no windows."""
    if length <= 0:
        return []
    visible = find_visible_points(observations)
    longest = length * float(np.median(np.linalg.norm(visible.points - observations.centers[visible.cameras], axis=-1)))
    centers = observations.centers
    spread = np.linalg.norm(centers - centers.mean(0), axis=-1)
    if 2 * spread.max() <= longest:
        return []
    # The fewest balls, hardly longer than allowed, that contain all cameras: farthest-point sampling needs at most
    # twice as many.
    start = centers[farthest_first(centers, radius=longest / 2)]
    middles, low, high = _settled(centers, start), 1, len(start)
    while low < high:
        count = (low + high) // 2
        fewer = _settled(centers, start[:count])
        if cdist(centers, fewer).min(-1).max() <= SLACK * longest / 2:
            middles, high = fewer, count
        else:
            low = count + 1
    while len(middles) > 1:  # removes windows of too few cameras, smallest first; neighbours take their cameras
        counts = np.bincount(cdist(centers, middles).argmin(-1), minlength=len(middles))
        if counts.min() >= FEWEST:
            break
        middles = _settled(centers, np.delete(middles, counts.argmin(), axis=0))
    owner = cdist(centers, middles).argmin(-1)
    radii = [float(np.linalg.norm(centers[owner == i] - m, axis=-1).max()) for i, m in enumerate(middles)]
    # Order: from the window farthest from the centre of all, always to the nearest.
    order, left = [], list(range(len(middles)))
    at = middles[np.linalg.norm(middles - middles.mean(0), axis=-1).argmax()]
    while left:
        order.append(min(left, key=lambda i: float(np.linalg.norm(middles[i] - at))))
        left.remove(order[-1])
        at = middles[order[-1]]
    if 2 * max(radii) > SLACK * longest:  # sparse cameras: merged windows are longer, and so are the gaps between them
        longest = 2 * max(radii)
    return [Window(vector(middles[i]), radii[i], MARGIN * longest, NO_PLAN) for i in order]


def cameras_of(window: Window, centers: Array) -> NDArray[np.int64]:
    """Cameras with a share in a window, which its placement and training use; all cameras if there is only one. Raises
    InputError if there is none."""
    distance = np.linalg.norm(centers - np.asarray(window.center), axis=-1)
    cameras = np.nonzero(distance < window.radius + window.margin)[0]
    if not len(cameras):
        raise InputError(f"The plan's window at {window.center} holds no training camera: move it or leave it out.")
    return cameras


def of_cameras(observations: Observations, cameras: NDArray[np.int64]) -> Observations:
    """Observations of some of the cameras. Points keep their numbers."""
    number = np.full(len(observations.centers), -1)
    number[cameras] = np.arange(len(cameras))
    observations = observations.with_keypoints(number[observations.seen_by] >= 0)
    return replace(
        observations,
        camera_to_worlds=observations.camera_to_worlds[cameras],
        intrinsics=observations.intrinsics[cameras],
        sizes=observations.sizes[cameras],
        seen_by=number[observations.seen_by],
        lens=None if observations.lens is None else observations.lens[cameras],
    )


def _settled(centers: Array, middles: Array) -> Array:
    """Balls moved to the centres of the cameras nearest to them (Lloyd)."""
    for _ in range(ROUNDS):
        owner = cdist(centers, middles).argmin(-1)
        balls = [centers[owner == i] for i in range(len(middles)) if (owner == i).any()]
        # The centre of the bounding box: balls around it are smaller than around the mean.
        moved = np.stack([(ball.min(0) + ball.max(0)) / 2 for ball in balls])
        if len(moved) == len(middles) and np.allclose(moved, middles, rtol=1e-9, atol=0):
            break
        middles = moved
    return middles
