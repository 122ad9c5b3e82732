"""Poses of a model, alignment of two tracks of the same cameras, and the frame of the scene: gravity, and metres."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mmpi_ns.utils.errors import InputError

Array = NDArray[np.float64]
ROTATION_WEIGHT = 1.0
"""Weight of rotations in the alignment of two tracks; the main direction of the centres has weight 1."""
LEVEL_TURN = 0.15
"""Minimum spread of the cameras' right vectors across their main direction for estimating gravity."""
LEAST_GROUND, GROUND_SHARE = 50, 0.15
"""Minimum number of points below the cameras for fitting the ground, and the fraction that must lie on it."""
GROUND_TILT = 25.0
"""Maximum angle in degrees between gravity estimated from the cameras and the normal of the ground."""
TRIALS = 2000
"""Planes tried for the ground (RANSAC)."""


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array]:
    """Names in order of the image ids, and camera to world with OpenCV axes. [N, 4, 4]"""
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    for pose, image in zip(poses, images, strict=True):
        pose[:3] = image.cam_from_world().inverse().matrix()
    return [image.name for image in images], poses


def degrees_between(first: Array, second: Array) -> Array:
    """Angles [N] between rotations [N, 3, 3]."""
    traces = np.einsum("nij,nij->n", first, second)
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


def fit_ground(points: Array, centers: Array, up: Array) -> tuple[Array, float]:
    """The plane that the cameras [N, 3] stand over: the most populous of SfM points [P, 3] among roughly level ones.

    Returns its unit normal towards the cameras [3], and their median height above it. Raises InputError if too few
    points lie below the cameras, or no plane is among them.
    """
    # Points below the nearest camera and near the track.
    some = centers[:: max(1, len(centers) // 32)]
    reach = 2 * np.linalg.norm(centers - np.median(centers, axis=0), axis=-1).max()
    offset = points - some[np.linalg.norm(points[:, None] - some[None], axis=-1).argmin(1)]
    height = offset @ up
    across = np.linalg.norm(offset - height[:, None] * up, axis=-1)
    below = points[(height < 0) & (-height > 0.05 * across) & (across < reach)]
    if len(below) < LEAST_GROUND:
        raise InputError(
            f"--camera-height: only {len(below)} points lie below the cameras: too few to find the ground."
        )
    tolerance = 0.04 * abs(float(np.median(-((below - np.median(centers, axis=0)) @ up))))
    rng, inside = np.random.default_rng(0), np.zeros(len(below), dtype=bool)
    for _ in range(TRIALS):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 or abs(normal @ up) / length < np.cos(np.radians(GROUND_TILT)):
            continue
        near = np.abs((below - a) @ normal) < tolerance * length
        inside = near if near.sum() > inside.sum() else inside
    if inside.sum() < GROUND_SHARE * len(below):
        raise InputError("--camera-height: the points below the cameras lie on no common plane.")
    center = below[inside].mean(0)
    normal = np.linalg.eigh((below[inside] - center).T @ (below[inside] - center))[1][:, 0]
    normal *= np.sign(normal @ up)
    return normal, float(np.median((centers - center) @ normal))


def choose_frame(model: pycolmap.Reconstruction, camera_height: float | None) -> tuple[pycolmap.Sim3d, str, str]:
    """Up to +z, the first camera's heading to +y, the cameras' middle (or the ground below it) as origin.

    Without a ground, cameras are assumed level: up is perpendicular to all right vectors if they turn, else the mean up
    vector. Without ``camera_height``, in metres above the ground, one unit is the extent of the track.

    Returns the transform from the model to the scene, and the sources of up and of the unit in words.
    """
    _, poses = camera_poses(model)
    centers = poses[:, :3, 3]
    up, words = -poses[:, :3, 1].mean(0), "mean of the cameras, assumed level"
    up /= max(float(np.linalg.norm(up)), 1e-12)
    values, vectors = np.linalg.eigh(poses[:, :3, 0].T @ poses[:, :3, 0] / len(poses))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    if values[1] > LEVEL_TURN and values[0] < 0.1 * values[1] and level @ up > 0.5:
        up = level
    if camera_height is not None:
        points = np.array([p.xyz for p in model.points3D.values()])
        up, height = fit_ground(points, centers, up)
        if height <= 0:
            raise InputError("--camera-height: the ground found lies above the cameras.")
        scale, words = camera_height / height, "normal of the ground"
        unit = f"1 metre, from a camera height of {camera_height:g} m above the ground"
    else:
        extent = float(np.ptp(centers @ np.linalg.svd(centers - centers.mean(0))[2][0]))
        scale, unit = 1 / max(extent, 1e-12), "the extent of the camera track (metres are not known)"
    heading = poses[0, :3, 2] - (poses[0, :3, 2] @ up) * up
    if np.linalg.norm(heading) < 1e-6:  # the first camera looks up or down
        heading = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    heading = heading / np.linalg.norm(heading)
    rotation = np.stack([np.cross(heading, up), heading, up])
    similarity = pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), -scale * rotation @ centers.mean(0))
    return similarity, words, unit
