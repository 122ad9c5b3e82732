"""Cameras and keypoints set up by hand, and an MPI before them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.plan import MPIPlan

FX, FY, WIDTH, HEIGHT = 150.0, 100.0, 200, 100
AXES = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Of an MPI that looks as a camera without rotation does: along -z, y up."""


def observed(centers, points=(), seen_by=(), seen_point=None, turns=None) -> Observations:
    """Cameras that look along -z unless turned; point q is keypoint q unless said otherwise."""
    centers = np.asarray(centers, dtype=np.float64)
    turns = np.tile(np.eye(3), (len(centers), 1, 1)) if turns is None else turns
    count = len(centers)
    return Observations(
        camera_to_worlds=np.concatenate([turns, centers[:, :, None]], -1),
        intrinsics=np.tile([FX, FY, WIDTH / 2, HEIGHT / 2], (count, 1)),
        sizes=np.tile([float(WIDTH), HEIGHT], (count, 1)),
        points=np.asarray(points, dtype=np.float64).reshape(-1, 3),
        seen_by=np.asarray(seen_by, np.int64),
        seen_point=np.arange(len(seen_by)) if seen_point is None else seen_point,
        seen_at=np.zeros((len(seen_by), 2)),
    )


def mpi(**changes) -> MPIPlan:
    return replace(MPIPlan("front", (0.0, 0.0, 0.0), AXES, 2.0, (-0.8, 0.8, -0.6, 0.6), 33, 61, 81), **changes)


def turned_about_y(angles):
    return np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angles])
