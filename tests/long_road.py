"""A long road as placement sees it."""

from __future__ import annotations

import numpy as np

from mmpi_ns.placement.observations import Observations

# Splitting -----------------------------------------------------------------------------------------------------------


def road(length: float, spacing: float = 1.0) -> Observations:
    """Cameras that drive along a slow bend and see walls 6 away on both sides, some way ahead."""
    s = np.arange(0, length, spacing)
    centers = np.stack([s, 0 * s, 8 * np.sin(s / 60)], -1)
    heading = np.stack([np.ones_like(s), 0 * s, 8 / 60 * np.cos(s / 60)], -1)
    facing = heading / np.linalg.norm(heading, axis=-1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    right = np.cross(facing, up)
    poses = np.stack([right, np.broadcast_to(up, right.shape), -facing, centers], -1)
    rng = np.random.default_rng(0)
    ahead, side = rng.uniform(4, 20, (len(s), 30)), rng.choice([-6.0, 6.0], (len(s), 30))
    points = centers[:, None] + ahead[..., None] * facing[:, None] + side[..., None] * right[:, None]
    points = points + rng.uniform(-2, 2, (len(s), 30))[..., None] * up
    count = points.shape[0] * points.shape[1]
    return Observations(
        camera_to_worlds=poses.astype(np.float64),
        intrinsics=np.tile([100.0, 100.0, 80.0, 40.0], (len(s), 1)),
        sizes=np.tile([160.0, 80.0], (len(s), 1)),
        points=points.reshape(-1, 3),
        seen_by=np.repeat(np.arange(len(s)), 30),
        seen_point=np.arange(count),
        seen_at=np.zeros((count, 2)),
    )
