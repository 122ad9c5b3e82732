"""The placement rule: MPIs stand where cameras stood, as many as lower the expected pixel error enough.

Candidates are the training cameras themselves, pulled back by some amounts and widened by some margins: seen from its
own origin an MPI has no plane error and texels as fine as pixels, and both errors grow with the distance from there
(``errors.py``). The candidate that lowers the mean error of all observations most for its texels is taken, again and
again (greedy facility location), until the next one would add too little. A forward-facing capture ends with one MPI, a
drive with several that face the same way, one further on than the other, a walk through rooms with one per view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.errors import mpi_errors
from mmpi_ns.placement.hand_made import drive_plan, room_plan, vector
from mmpi_ns.placement.observations import Array, Observations, frustum_points
from mmpi_ns.placement.plan import MPIPlan, ScenePlan

MAX_ERROR = 64.0
"""Pixels: what an observation costs that no MPI holds; worse errors count no more than this."""
SAMPLED = 6000
"""Observations that the choice is based on."""


@dataclass
class PlacementConfig:
    """Where the MPIs stand and how fine they are."""

    arrangement: Literal["cameras", "drive", "room"] = "cameras"
    """cameras: chosen among the training cameras; drive: front, left, right, below; room: five around the centre."""
    max_mpis: int = 8
    """No more MPIs than this (cameras)."""
    min_gain: float = 0.01
    """Stop when the next MPI gains less than this share of what there was to gain (cameras)."""
    planes: int = 64
    """Planes of every MPI."""
    texel_pixels: float = 1.5
    """Image pixels that a texel spans, seen from where the MPI stands (cameras)."""
    rays_per_texel: float = 2.5
    """Training rays that a texel's footprint should get: a short run on large images gets larger texels (cameras)."""
    height: int = 96
    """Texel rows of every MPI (drive, room)."""
    width: int = 256
    """Texel columns of every MPI (drive, room)."""
    enough: float = 0.75
    """Pixels of expected error that need no further MPI (cameras)."""
    margins: tuple[float, ...] = (1.12, 1.4, 1.75)
    """Frusta to try, relative to the camera's own (cameras)."""
    pull_backs: tuple[float, ...] = (0.0, 1.0, 2.0)
    """Distances to try for standing behind the camera, relative to the nearest content (cameras)."""
    texel_cost: float = 0.25
    """How much texels count against a candidate: its gain is divided by texels to this power (cameras)."""
    faces: tuple[str, ...] = ("front", "left", "right", "below")
    """Which MPIs of the drive to use (drive)."""
    drive_pull_back: float = 0.45
    """How far behind the first camera the front MPI stands, as a share of the travel (drive)."""
    cube_voxels: int = 0
    """Voxels along each side of the centred cube; 0 for none."""


@dataclass(frozen=True)
class Content:
    """Where the content of a scene lies, as placement sees it."""

    cameras: NDArray[np.int64]
    """[Q] camera of each observation."""
    points: Array
    """[Q, 3] what it observes."""
    nearest: Array
    """[M] distance from each camera to its nearest content (2nd percentile)."""
    near: float
    """The same over all cameras."""


def place(observations: Observations, config: PlacementConfig, training_rays: int | None = None) -> ScenePlan:
    """The scene plan for some training cameras and points.

    Args:
        observations: training cameras and what they saw.
        config: the rule's settings.
        training_rays: pixel rays of the whole training, where known: texels are no finer than those can train.

    Raises:
        ValueError: the cameras leave nothing to place, e.g. all observations are behind their cameras.
    """
    content = find_content(observations)
    if config.arrangement == "drive":
        # The hand-made rule is in metres; it was made where the nearest content lies 5 m away.
        size = (config.planes, config.height, config.width)
        return drive_plan(observations, content.near / 5, *size, config.faces, config.drive_pull_back)
    if config.arrangement == "room":
        half_size = float(np.abs(observations.centers - observations.centers.mean(0)).max()) + content.near
        near = max(0.5 * content.near, 1e-6)
        return room_plan(observations, config.planes, config.width, config.cube_voxels, near, half_size)
    if training_rays is not None:
        rays_per_pixel = training_rays / float(observations.sizes.prod(-1).sum())
        coarsest = (config.rays_per_texel / rays_per_pixel) ** 0.5
        config = replace(config, texel_pixels=max(config.texel_pixels, coarsest))
    chosen = _choose(_candidates(observations, content, config), observations, content, config)
    mpis = tuple(_named(m, i) for i, m in enumerate(chosen))
    return ScenePlan(mpis, None, 0.2 * content.near, content.near, "camera placement")


def find_content(observations: Observations) -> Content:
    """The observations that placement weighs: SfM keypoints, else points filling the cameras' frusta.

    Without any points the nearest content is taken to lie at a tenth of the cameras' spread.
    """
    centers = observations.centers
    if len(observations.seen_by):
        cameras, points = observations.seen_by, observations.points[observations.seen_point]
    else:
        spread = float(np.linalg.norm(centers - centers.mean(0), axis=-1).max())
        cloud = frustum_points(observations, near=max(0.1 * spread, 1e-3))
        cameras = np.repeat(np.arange(len(centers)), len(cloud) // len(centers))
        points = cloud
    depth = -np.einsum("qi,qi->q", points - centers[cameras], observations.camera_to_worlds[cameras][:, :, 2])
    good = np.isfinite(points).all(-1) & (depth > 0)
    if not good.any():
        raise ValueError("No point lies in front of the camera that saw it: check the poses and the points' frame.")
    cameras, points, depth = cameras[good], points[good], depth[good]
    distance = np.linalg.norm(points - centers[cameras], axis=-1)
    near = float(np.percentile(distance, 2))
    nearest = np.array(
        [np.percentile(depth[cameras == i], 2) if (cameras == i).sum() >= 20 else near for i in range(len(centers))]
    )
    keep = np.linspace(0, len(cameras) - 1, min(SAMPLED, len(cameras))).round().astype(int)
    return Content(cameras[keep], points[keep], nearest, near)


def _candidates(observations: Observations, content: Content, config: PlacementConfig) -> list[MPIPlan]:
    """Every training camera (at most 64, evenly chosen) with every pull-back and margin."""
    count = len(observations.centers)
    chosen = np.unique(np.linspace(0, count - 1, min(64, count)).round().astype(int))
    return [
        _candidate(observations, int(i), pull_back * content.near, margin, content, config)
        for i in chosen
        for pull_back in config.pull_backs
        for margin in config.margins
    ]


def _candidate(
    observations: Observations, i: int, pull_back: float, margin: float, content: Content, config: PlacementConfig
) -> MPIPlan:
    right, up, back = observations.camera_to_worlds[i, :, :3].T
    fx, fy, cx, cy = observations.intrinsics[i]
    width, height = observations.sizes[i]
    u, v = np.array([-cx, width - cx]) / fx, np.array([-cy, height - cy]) / fy
    extent = [float(x) for side in (u, v) for x in side.mean() + margin * (side - side.mean())]
    texel = config.texel_pixels
    return MPIPlan(
        name=str(i),
        origin=vector(observations.centers[i] + pull_back * back),
        axes=(vector(right), vector(-up), vector(-back)),
        near=float(0.6 * min(content.nearest[i], content.near) + pull_back),
        extent=(extent[0], extent[1], extent[2], extent[3]),
        planes=config.planes,
        height=max(8, round((extent[3] - extent[2]) * fy / texel) + 1),
        width=max(8, round((extent[1] - extent[0]) * fx / texel) + 1),
    )


def _choose(
    candidates: list[MPIPlan], observations: Observations, content: Content, config: PlacementConfig
) -> list[MPIPlan]:
    """Greedy facility location on the mean of log2(expected pixel error), counted from what is small enough."""
    cost = np.stack([_log_error(m, observations, content, config.enough) for m in candidates])
    penalty = np.array([m.texels for m in candidates], dtype=np.float64) ** config.texel_cost
    current = np.full(cost.shape[1], np.log2(MAX_ERROR / config.enough))
    total = current.mean()
    chosen: list[int] = []
    while len(chosen) < config.max_mpis:
        gain = current.mean() - np.minimum(cost, current).mean(-1)
        best = int((gain / penalty).argmax())
        if chosen and gain[best] < config.min_gain * total:
            break
        chosen.append(best)
        current = np.minimum(current, cost[best])
    return [candidates[j] for j in chosen]


def _log_error(mpi: MPIPlan, observations: Observations, content: Content, enough: float) -> Array:
    plane, texel = mpi_errors(mpi, observations, content.cameras, content.points)
    return np.log2(np.clip(np.hypot(plane, 0.5 * texel), enough, MAX_ERROR) / enough)


def _named(mpi: MPIPlan, index: int) -> MPIPlan:
    return replace(mpi, name=f"view {int(mpi.name) + 1} ({index})")
