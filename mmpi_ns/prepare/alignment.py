"""Poses of a model, and alignment of two tracks of the same cameras."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROTATION_WEIGHT = 1.0
"""Weight of rotations in the alignment of two tracks; the main direction of the centres has weight 1."""


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array]:
    """Names in order of the image ids, and camera to world with OpenCV axes. [N, 4, 4]"""
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    for pose, image in zip(poses, images, strict=True):
        pose[:3] = image.cam_from_world().inverse().matrix()
    return [image.name for image in images], poses


def degrees_between(one: Array, other: Array) -> Array:
    """Angles [N] between rotations [N, 3, 3] and others."""
    traces = np.einsum("nij,nij->n", one, other)
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def rotation_between(source: Array, target: Array) -> Array:
    """The rotation [3, 3] that takes rotations [N, 3, 3] nearest to others: it turns all cameras of a track alike."""
    return nearest_rotation(np.einsum("nij,nkj->ik", target, source))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation with the largest product with a matrix. [3, 3]"""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def similarity_between(source: Array, target: Array) -> pycolmap.Sim3d:
    """The similarity that aligns camera poses with other poses of the same cameras.

    Uses centres and rotations: the centres of a straight track do not fix its roll, and noise tilts a short one.
    (``pycolmap.estimate_sim3d`` uses centres alone, and gives up where they lie on a line or a plane, as drives do.)

    Args:
        source, target: camera to world. [N, 4, 4]
    """
    a = source[:, :3, 3] - source[:, :3, 3].mean(0)
    b = target[:, :3, 3] - target[:, :3, 3].mean(0)
    by_centers = b.T @ a / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-24)
    by_rotations = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]) / len(source)
    rotation = nearest_rotation(by_centers + ROTATION_WEIGHT * by_rotations)
    scale = float((a @ rotation.T * b).sum() / max((a * a).sum(), 1e-24))
    translation = target[:, :3, 3].mean(0) - scale * rotation @ source[:, :3, 3].mean(0)
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation)
