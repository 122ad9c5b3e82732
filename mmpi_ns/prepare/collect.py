"""Collects the evidence from a model and the database of its matches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.matching import MIN_INLIERS
from mmpi_ns.prepare.evidence import Array, Pairs, Places, Witness, scale_changes
from mmpi_ns.prepare.frame import camera_poses

FIT_PX = 2.0
"""Sampson distance, in pixels of an image side of 1,000, up to which a match lies on its epipolar line."""
BESIDE = 4.0
"""Multiple of that distance up to which a match lies beside its line."""


def witness_of(name: str, model: pycolmap.Reconstruction, database: Path, offered: Sequence[str]) -> Witness:
    """The evidence on a mapper's model.

    Args:
        name: of the mapper.
        model: poses and points, with the keypoints of the database.
        database: verified matches.
        offered: names of all images given, in order.
    """
    names, poses = camera_poses(model)
    camera = model.cameras[next(iter(model.images[i] for i in model.reg_image_ids())).camera_id]
    place = {name: i for i, name in enumerate(offered)}
    return Witness(
        name,
        names,
        np.array([place[n] for n in names], dtype=np.int64),
        poses,
        _pairs(model, database),
        camera.mean_focal_length() / max(camera.width, camera.height),
        model.compute_mean_reprojection_error(),
        scale_changes(*_observations(model), len(names)),
    )


def _pairs(model: pycolmap.Reconstruction, database: Path) -> Pairs:
    """For every verified pair of registered images, how many matches became points and how well they fit the poses."""
    order = sorted(model.reg_image_ids())
    place = {image_id: i for i, image_id in enumerate(order)}
    points = {i: _points(model.images[i]) for i in order}
    rays = {i: _rays(model, model.images[i]) for i in order}
    rows: list[tuple[int, ...]] = []
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
    for number, geometry in zip(numbers, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(number)
        if a not in place or b not in place or len(geometry.inlier_matches) < MIN_INLIERS:
            continue
        matches = np.asarray(geometry.inlier_matches).astype(int)
        seen = points[a][matches[:, 0]]
        tracked = (seen == points[b][matches[:, 1]]) & (seen >= 0)
        relative = model.images[b].cam_from_world() * model.images[a].cam_from_world().inverse()
        essential = pycolmap.essential_matrix_from_pose(relative)
        pixels = rays[a][matches[:, 0], :2], rays[b][matches[:, 1], :2]
        off = np.sqrt(pycolmap.compute_squared_sampson_error(*pixels, essential))
        camera = model.cameras[model.images[a].camera_id]
        off *= camera.mean_focal_length() / (FIT_PX * max(camera.width, camera.height) / 1000)
        fitting, beside = int((off < 1).sum()), int(((off >= 1) & (off < BESIDE)).sum())
        rows.append((place[a], place[b], len(matches), int(tracked.sum()), fitting, beside))
    table = np.array(rows, dtype=np.int64).reshape(-1, 6)
    low, high = table[:, :2].min(1, initial=len(order)), table[:, :2].max(1, initial=0)
    return Pairs(low, high, *table[:, 2:].T.astype(np.float64))


def _observations(model: pycolmap.Reconstruction) -> tuple[Places, Places, Array, Array]:
    """Point, index of the image, camera centre and ray of every observation. [O], [O], [O, 3], [O, 3]"""
    parts = []
    for place, image_id in enumerate(sorted(model.reg_image_ids())):
        image = model.images[image_id]
        points = _points(image)
        rays = _rays(model, image)[points >= 0] @ image.cam_from_world().rotation.matrix()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        center = np.tile(image.projection_center(), (len(rays), 1))
        parts.append((points[points >= 0], np.full(len(rays), place), center, rays))
    points, places, centers, rays = (np.concatenate(column) for column in zip(*parts, strict=True))
    return points, places, centers, rays


def _points(image: pycolmap.Image) -> Places:
    """Number of the point that each keypoint sees; -1 for none. [K]"""
    return np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], dtype=np.int64)


def _rays(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Array:
    """Directions of the keypoints in the camera, with z = 1. [K, 3]"""
    pixels = np.array([p.xy for p in image.points2D], dtype=np.float64).reshape(-1, 2)
    return np.c_[model.cameras[image.camera_id].cam_from_img(pixels), np.ones(len(pixels))]
