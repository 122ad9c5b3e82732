"""The frame of the scene: gravity, and metres if they can be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from mmpi_ns.prepare.alignment import Array, camera_poses
from mmpi_ns.prepare.stages import PrepareError

LEVEL_TURN = 0.15
"""Minimum spread of the cameras' right vectors across their main direction for estimating gravity."""
LEAST_GROUND, GROUND_SHARE = 50, 0.15
"""Minimum number of points below the cameras for finding the ground, and the fraction that must lie on it."""
GROUND_TILT = 25.0
"""Maximum angle in degrees between gravity estimated from the cameras and the normal of the ground."""
TRIALS = 2000
"""Planes tried for the ground (RANSAC)."""


@dataclass(frozen=True)
class SceneFrame:
    """How the model was transformed into the scene."""

    similarity: pycolmap.Sim3d
    """Scene from model."""
    up: str
    """Source of the up direction, in words."""
    unit: str
    """The unit, in words."""


def up_from_cameras(poses: Array) -> Array:
    """Up, assuming level cameras: perpendicular to all right vectors if they turn, else the mean up vector. [3]"""
    mean = -poses[:, :3, 1].mean(0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    values, vectors = np.linalg.eigh(poses[:, :3, 0].T @ poses[:, :3, 0] / len(poses))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    turns_enough = values[1] > LEVEL_TURN and values[0] < 0.1 * values[1]
    return level if turns_enough and level @ mean > 0.5 else mean


def fit_ground(points: Array, centers: Array, up: Array, seed: int = 0) -> tuple[Array, float]:
    """The plane that the cameras stand over: the most populous among roughly level ones, by RANSAC.

    Args:
        points: SfM points. [P, 3]
        centers: camera centres. [N, 3]
        up: rough up. [3]

    Returns:
        Unit normal towards the cameras [3], and the cameras' median height above the plane, in the points' units.

    Raises:
        PrepareError: too few points below the cameras, or no plane among them.
    """
    # Points below the nearest camera and near the track.
    some = centers[:: max(1, len(centers) // 32)]
    reach = 2 * np.linalg.norm(centers - np.median(centers, axis=0), axis=-1).max()
    offset = points - some[np.linalg.norm(points[:, None] - some[None], axis=-1).argmin(1)]
    height = offset @ up
    across = np.linalg.norm(offset - height[:, None] * up, axis=-1)
    below = points[(height < 0) & (-height > 0.05 * across) & (across < reach)]
    if len(below) < LEAST_GROUND:
        raise PrepareError(
            f"--camera-height: only {len(below)} points lie below the cameras: too few to find the ground."
        )
    tolerance = 0.04 * abs(float(np.median(-((below - np.median(centers, axis=0)) @ up))))
    rng, inside = np.random.default_rng(seed), np.zeros(len(below), dtype=bool)
    for _ in range(TRIALS):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 or abs(normal @ up) / length < np.cos(np.radians(GROUND_TILT)):
            continue
        near = np.abs((below - a) @ normal) < tolerance * length
        inside = near if near.sum() > inside.sum() else inside
    if inside.sum() < GROUND_SHARE * len(below):
        raise PrepareError("--camera-height: the points below the cameras lie on no common plane.")
    center = below[inside].mean(0)
    normal = np.linalg.eigh((below[inside] - center).T @ (below[inside] - center))[1][:, 0]
    normal *= np.sign(normal @ up)
    return normal, float(np.median((centers - center) @ normal))


def choose_frame(model: pycolmap.Reconstruction, camera_height: float | None) -> SceneFrame:
    """Up to +z, the first camera's heading to +y, the cameras' middle (or the ground below it) as origin.

    Args:
        model: in its own frame.
        camera_height: metres above the ground, or None: then one unit is the extent of the track.
    """
    _, poses = camera_poses(model)
    centers = poses[:, :3, 3]
    up = up_from_cameras(poses)
    words = "mean of the cameras, assumed level"
    if camera_height is not None:
        points = np.array([p.xyz for p in model.points3D.values()])
        up, height = fit_ground(points, centers, up)
        if height <= 0:
            raise PrepareError("--camera-height: the ground found lies above the cameras.")
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
    return SceneFrame(similarity, words, unit)
