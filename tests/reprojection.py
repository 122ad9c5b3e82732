"""How far keypoints lie from where their points project: tells a model in another frame from a good one."""

from __future__ import annotations

import numpy as np

from mmpi_ns.placement.observations import Observations


def median_reprojection_error(observations: Observations) -> float:
    """Median distance between keypoints and their projected points, as a share of the image width; no lens."""
    errors = []
    for (x, y), i, p in zip(observations.seen_at, observations.seen_by, observations.seen_point, strict=False):
        pose, (fx, fy, cx, cy) = observations.camera_to_worlds[i], observations.intrinsics[i]
        right, up, back = np.linalg.inv(pose[:, :3]) @ (observations.points[p] - pose[:, 3])
        if back >= 0:
            errors.append(np.inf)
            continue
        off = np.array([fx * right / -back + cx - x, -fy * up / -back + cy - y])
        errors.append(float(np.linalg.norm(off)) / observations.sizes[i, 0])
    return float(np.median(errors))
