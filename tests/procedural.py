"""What structure from motion would know of a procedural scene: exact points, seen where nothing hides them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hand_made import observed

from mmpi_ns.placement.observations import Observations


def observations_of(scene, per_camera=40):
    """Training cameras of a scene and points at random pixels of theirs, with every keypoint that is really visible."""
    rng = np.random.default_rng(0)
    cameras = scene.cameras
    training = np.nonzero(~cameras.is_test)[0]
    cx, cy = cameras.center
    poses = cameras.camera_to_worlds[training]
    points = []
    for i in training:
        pixels = rng.uniform([0, 0], [cameras.width, cameras.height], (per_camera, 2))
        origins, directions = cameras.rays(int(i), pixels)
        distance, _ = scene.hit(origins, directions)
        solid = np.isfinite(distance)
        points.append(origins[solid] + distance[solid, None] * directions[solid])
    points = np.concatenate(points).astype(np.float64)
    seen_by, seen_point, seen_at = [], [], []
    for n, pose in enumerate(poses):
        offset = points - pose[:, 3]
        local = offset @ pose[:, :3]
        depth = np.where(local[:, 2] < 0, -local[:, 2], np.inf)
        pixels = np.stack([local[:, 0], -local[:, 1]], -1) * (cameras.focal / depth[:, None]) + [cx, cy]
        inside = np.isfinite(depth) & ((pixels > 0) & (pixels < [cameras.width, cameras.height])).all(-1)
        index = np.nonzero(inside)[0]
        distance = np.linalg.norm(offset[index], axis=-1)
        hit, _ = scene.hit(np.broadcast_to(pose[:, 3], (len(index), 3)), offset[index] / distance[:, None])
        index = index[np.abs(hit - distance) < 1e-3 * distance + 1e-3]
        seen_by.append(np.full(len(index), n))
        seen_point.append(index)
        seen_at.append(pixels[index])
    seen = (np.concatenate(x) for x in (seen_by, seen_point, seen_at))
    return observed(poses, [cameras.focal, cameras.focal, cx, cy], [cameras.width, cameras.height], points, *seen)


def moved(observations: Observations, turn: np.ndarray, shift: np.ndarray, scale: float) -> Observations:
    poses = observations.camera_to_worlds
    centers = scale * (poses[:, :, 3] @ turn.T) + shift
    return replace(
        observations,
        camera_to_worlds=np.concatenate([turn @ poses[:, :, :3], centers[:, :, None]], -1),
        points=scale * (observations.points @ turn.T) + shift,
    )
