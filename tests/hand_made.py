"""Small frames, cameras and rays that several test files use."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.geometry import local_rays, local_to_ndc, rotate
from mmpi_ns.scene.plan import MPIPlan

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def make_mpi(name="front", origin=(0.0, 0.0, 0.0), axes=IDENTITY, near=1.0, extent=(-1.0, 1.0, -0.5, 0.5), **size):
    """An MPI at the world's origin facing +z with 9 planes; every field can be replaced."""
    size = {"planes": 9, "height": 5, "width": 7, **size}
    return MPIPlan(name=name, origin=origin, axes=axes, near=near, extent=extent, **size)


def world_to_ndc(points, inverse_t, frames):
    """``local_to_ndc`` of homogeneous world points."""
    return local_to_ndc(rotate(frames.axes, points[:, None] - frames.origins * inverse_t[:, None, None]),
                        inverse_t[:, None], frames)  # fmt: skip


def samples_to_ndc(origins, directions, inverse_t, frames):
    """``local_to_ndc`` of the points origins + t directions, from differences to each MPI's origin (exact far away)."""
    local_origins, local_directions = local_rays(origins, directions, frames)
    return local_to_ndc(local_origins * inverse_t[:, None, None] + local_directions, inverse_t[:, None], frames)


def rotation(quaternion):
    """Rows of the rotation of a quaternion w, x, y, z (need not be normalised)."""
    return tuple(map(tuple, Rotation.from_quat(np.roll(quaternion, -1)).as_matrix().tolist()))


def random_mpi(rng, name="random", planes=None, deep=math.inf):
    """An MPI anywhere within a few units of the world's origin, with an asymmetric frustum, ``deep`` nears deep."""
    u0, v0 = -rng.uniform(0.1, 2, size=2)
    return make_mpi(
        name,
        tuple(float(x) for x in rng.normal(size=3) * 2),
        rotation(rng.normal(size=4)),
        near=(near := float(rng.uniform(0.5, 4))),
        far=deep * near,
        extent=(float(u0), float(u0 + rng.uniform(0.5, 4)), float(v0), float(v0 + rng.uniform(0.5, 4))),
        planes=int(planes or rng.integers(2, 40)),
    )


def unit(vector):
    vector = np.asarray(vector, np.float64)
    return vector / np.linalg.norm(vector)


def rays(origins, directions, near=0.0, far=math.inf, dtype=torch.float64):
    """(origins [R, 3], unit directions [R, 3], nears [R, 1], fars [R, 1])."""
    origins = np.atleast_2d(np.asarray(origins, np.float64))
    directions = np.atleast_2d(np.asarray(directions, np.float64))
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    origins, directions = np.broadcast_arrays(origins, directions)
    column = np.ones((origins.shape[0], 1))
    return tuple(torch.tensor(x, dtype=dtype) for x in (origins.copy(), directions, near * column, far * column))


def posed(poses, pinhole, size, files=None, lens=(0.0, 0.0, 0.0, 0.0), fisheye=False):
    """Images of one camera from several poses [N, 3, 4]; their files need not be there."""
    files = [Path(f"{i}.png") for i in range(len(poses))] if files is None else files
    numbers = (np.tile(np.array(row, np.float64), (len(poses), 1)) for row in (pinhole, size, lens))
    return PosedImages(tuple(files), np.array(poses, np.float64), *numbers, fisheye)


def observed(poses, pinhole, size, points=(), seen_by=(), seen_point=None, seen_at=None, **more):
    """What one camera sees from several poses [N, 3, 4]; point q is keypoint q unless said otherwise."""
    return Observations(
        np.array(poses, np.float64),
        *(np.tile(np.array(row, np.float64), (len(poses), 1)) for row in (pinhole, size)),
        np.array(points, np.float64).reshape(-1, 3),
        np.array(seen_by, np.int64),
        np.arange(len(seen_by)) if seen_point is None else np.array(seen_point, np.int64),
        np.zeros((len(seen_by), 2)) if seen_at is None else np.array(seen_at, np.float64).reshape(-1, 2),
        **more,
    )


def median_reprojection_error(observations):
    """Median distance between keypoints and their projected points, as a share of the image width; no lens: tells
    a model in another frame from a good one."""
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


# Blending ------------------------------------------------------------------------------------------------------------


def starts_of(valid):
    """Where the samples of each ray start, of a mask [R, S] of those that there are."""
    return torch.nn.functional.pad(valid.sum(-1).cumsum(0), (1, 0))


def tensor(values, dtype=torch.float64):
    return torch.tensor(np.asarray(values), dtype=dtype)


def random_votes(rng, samples, heads, scale):
    """Reliabilities, a cover that contains each sample's own head, and the own heads."""
    own = rng.integers(0, heads, size=samples)
    cover = rng.random((samples, heads)) < 0.6
    cover[np.arange(samples), own] = True
    return rng.normal(size=(samples, heads)) * scale, cover, own
