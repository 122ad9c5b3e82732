"""Points of a cloud (``ply_file_path``), and which training images see them.

A cloud does not record which images see its points, and projection alone would see through walls. Where a pixel has a
depth from matches, a point is visible if it lies there, occluded if it lies behind, and contradicted if it lies in
front: then the image sees through it. Elsewhere coarse depth images of the cloud decide: a point is visible if no other
one lies clearly in front of it, in its cell or a neighbouring one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from mmpi_ns.data.checks import log_once
from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import Array, Observations
from mmpi_priors.views import Map, project

CELLS, BEHIND = 48, 1.15
"""Cells of a coarse depth image along the longer side; a point farther away than the nearest one around it by this
factor is hidden."""
POINT_ERROR = 0.01
"""Minimum relative error of the distance of a point."""
CONTRADICTS = 6.0
"""Difference of two sources, in expected errors of both, from which one of them is wrong."""
MOST_POINTS, FARTHEST = 100_000, 1e5
"""Maximum number of points, a random subset of a larger cloud such as a laser scan; distance of a point from the
cameras, over their extent, above which it is an outlier."""


def point_cloud(outputs: DataparserOutputs, parser: DataParserConfig) -> Array | None:
    """Points of a capture's cloud [P, 3] in the scene's frame; None if it has none, or they are not asked for."""
    given = outputs.metadata.get("points3D_xyz")
    if given is not None:
        return given.double().numpy()
    data = Path(parser.data)
    file = data if data.suffix == ".json" else data / "transforms.json"
    if not getattr(parser, "load_3D_points", False) or not file.is_file():
        return None
    meta = json.loads(file.read_text(encoding="utf-8"))
    if "ply_file_path" not in meta:
        return None
    points = read_ply(file.parent / meta["ply_file_path"])
    if points is None:
        return None
    transform, applied = outputs.dataparser_transform.double().numpy(), np.eye(4)
    if "applied_transform" in meta:
        applied[:3] = meta["applied_transform"]
    elif (file.parent / "colmap/sparse/0").exists():  # nerfstudio then takes the axes of its older exports
        applied[:3] = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    transform = transform @ np.linalg.inv(applied)  # from the axes of the file
    return (points @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale


def read_ply(path: Path) -> Array | None:
    """The points of a PLY file [P, 3]; None, with a warning, if it is no such file or holds none."""
    from plyfile import PlyData, PlyParseError  # slow to import; comes with nerfstudio's viewer

    try:
        points = PlyData.read(path)["vertex"]
        xyz = np.stack([np.asarray(points[name], dtype=np.float64) for name in "xyz"], -1)
        if not len(xyz):
            raise ValueError("it holds none")
    except (PlyParseError, KeyError, ValueError, TypeError, OSError, MemoryError) as error:
        message = f"{path} is not a PLY file of points ({error}): write it again."
        log_once(f"[bold yellow]{message} Training goes on without the point cloud.")
        return None
    return xyz


def contradict(a: Map, b: Map) -> NDArray[np.bool_]:
    """Mask [...] of two sources' inverse distances [..., 2] that differ by more than their errors allow."""
    apart = np.abs(a[..., 0] - b[..., 0]) > CONTRADICTS * np.hypot(a[..., 1], b[..., 1])
    return apart & (a[..., 0] > 0) & (b[..., 0] > 0)


def usable_points(points: Array, centers: Array) -> Array:
    """Usable points of a cloud [P, 3], a random subset of ``MOST_POINTS`` if there are more; prints how many are NaN or
    too far from the cameras [M, 3]."""
    middle = np.median(centers, axis=0)
    extent = float(np.ptp(centers, axis=0).max())
    with np.errstate(invalid="ignore"):
        usable = np.abs(points - middle).max(-1) < (FARTHEST * extent or np.inf)
    if not usable.all():
        log_once(
            f"{(~usable).sum():,} of {len(usable):,} points of the point cloud are not used: they are no finite "
            "numbers, or absurdly far away."
        )
    points = points[usable]
    if len(points) <= MOST_POINTS:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False))]


@dataclass(frozen=True)
class Sightings:
    """Pixels at which training images see the points of a cloud."""

    points: Array
    """[P, 3]"""
    seen_by: NDArray[np.int64]
    """[Q] camera."""
    seen_point: NDArray[np.int64]
    """[Q] point."""
    seen_at: Array
    """[Q, 2] pixel (x, y)."""
    confirmed: NDArray[np.int64]
    """[P] number of images in which a point lies at the depth of its pixel."""
    contradicted: NDArray[np.int64]
    """[P] number of images whose depth there is behind the point."""

    @property
    def fits(self) -> bool:
        """Whether at least as many points are confirmed as contradicted."""
        return bool((self.confirmed > self.contradicted).sum() >= (self.contradicted > self.confirmed).sum())

    def added_to(self, tracks: Observations) -> Observations:
        """The observations with these sightings after the keypoints of their tracks; contradicted points are
        dropped."""
        kept = (self.contradicted <= self.confirmed)[self.seen_point]
        count, first = len(tracks.seen_at), len(tracks.points)
        return replace(
            tracks,
            points=np.concatenate([tracks.points, self.points]),
            seen_by=np.concatenate([tracks.seen_by[:count], self.seen_by[kept], tracks.seen_by[count:]]),
            seen_point=np.concatenate(
                [tracks.seen_point[:count], first + self.seen_point[kept], tracks.seen_point[count:]]
            ),
            seen_at=np.concatenate([tracks.seen_at, self.seen_at[kept]]),
            loose=None,
        )

    def describe(self) -> str:
        """Number of points that are used, and their use, in one line."""
        out = self.contradicted > self.confirmed
        if not self.fits:
            return (
                f"The point cloud does not fit the images, which look through {out.sum():,} of its points where they "
                f"confirm {(self.confirmed > 0).sum():,}, so it is not used: state its frame as applied_transform in "
                "transforms.json."
            )
        used = np.unique(self.seen_point[~out[self.seen_point]])
        left_out = f"; {out.sum():,} are dropped, because images see through them" if out.any() else ""
        return (
            f"Point cloud: {len(used):,} of {len(self.points):,} points are seen, {(self.confirmed > 0).sum():,} of "
            f"them where matches have a depth{left_out}. They are used for placement and depths."
        )


def see_points(points: Array, posed: PosedImages, depths: Callable[[int], Map] | None = None) -> Sightings:
    """Sightings of points [P, 3] in the training images; ``depths`` gives an image's inverse distances and their
    errors, 0 where there are none. [H, W, 2]"""
    seen: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
    confirmed, contradicted = np.zeros((2, len(points)), np.int64)
    for i, size in enumerate(posed.sizes):
        at = project(posed, i, points)
        inside = np.nonzero(((at >= 0) & (at < size)).all(-1))[0]
        at = at[inside]
        distance = np.linalg.norm(points[inside] - posed.camera_to_worlds[i, :, 3], axis=-1)
        cell = max(size) / CELLS
        columns, rows = (at / cell).astype(int).T
        nearest = np.full((int(size[1] / cell) + 1, int(size[0] / cell) + 1), np.inf)
        np.minimum.at(nearest, (rows, columns), distance)
        visible = distance < BEHIND * minimum_filter(nearest, 3, mode="nearest")[rows, columns]
        if depths is not None:
            columns, rows = at.astype(int).T
            measured = depths(i)[rows, columns]
            expected = np.outer(1 / np.maximum(distance, 1e-30), [1, POINT_ERROR]).astype(np.float32)
            has_depth, apart = measured[:, 0] > 0, contradict(expected, measured)
            visible = np.where(has_depth, ~apart, visible)
            confirmed[inside] += has_depth & ~apart
            contradicted[inside] += apart & (expected[:, 0] > measured[:, 0])
        seen.append((np.full(visible.sum(), i), inside[visible], at[visible]))
    seen_by, seen_point, seen_at = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return Sightings(points, seen_by, seen_point, seen_at, confirmed, contradicted)
