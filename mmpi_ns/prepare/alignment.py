"""Similarity alignment of two tracks of the same cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROTATION_WEIGHT = 1.0
"""Weight of rotations in the alignment of two tracks; the main direction of the centres has weight 1."""


def degrees_between(one: Array, other: Array) -> Array:
    """Angles [N] between rotations [N, 3, 3] and others."""
    traces = np.einsum("nij,nij->n", one, other)
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def rotation_between(source: Array, target: Array) -> Array:
    """The rotation [3, 3] that takes rotations [N, 3, 3] nearest to others: it turns all cameras of a track alike."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", target, source))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def similarity_matrix(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation [3, 3] and translation [3] that align camera poses with other poses of the same cameras.

    Uses centres and rotations: the centres of a straight track do not fix its roll, and noise tilts a short one.

    Args:
        source, target: camera to world. [N, 4, 4]
    """
    a = source[:, :3, 3] - source[:, :3, 3].mean(0)
    b = target[:, :3, 3] - target[:, :3, 3].mean(0)
    by_centers = b.T @ a / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-24)
    by_rotations = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]) / len(source)
    u, _, vt = np.linalg.svd(by_centers + ROTATION_WEIGHT * by_rotations)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    scale = float((a @ rotation.T * b).sum() / max((a * a).sum(), 1e-24))
    translation = target[:, :3, 3].mean(0) - scale * rotation @ source[:, :3, 3].mean(0)
    return scale, rotation, translation


def similarity_of_centers(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation [3, 3] and translation [3] that align points with others in the least-squares sense.

    Args:
        source, target: [N, 3]

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns (1991).
    """
    a, b = source - source.mean(0), target - target.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum() / max((a * a).sum(), 1e-24))
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)
