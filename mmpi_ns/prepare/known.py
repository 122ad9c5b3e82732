"""Points from known poses, and refinement of the poses on request."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.matching import quiet, triangulate_points
from mmpi_ns.prepare.alignment import degrees_between
from mmpi_ns.prepare.features import matched_keypoints
from mmpi_ns.prepare.frame import camera_poses, similarity_between
from mmpi_ns.prepare.mapping import adjust, bundle_options
from mmpi_ns.prepare.stages import PrepareError, say

ROUNDS = 3
"""Rounds of refining poses and triangulating points again."""
COARSE_PX, FINE_PX = 8.0, 4.0
"""Largest reprojection error of a point: while poses are to be refined, and in the end."""
LEAST_SHARE = 0.2
"""Fraction of the matched keypoints that must become points; few do if poses and images do not belong together."""


@dataclass(frozen=True)
class KnownModel:
    """Known poses with points."""

    model: pycolmap.Reconstruction
    says: str


def solve_known(
    model: pycolmap.Reconstruction,
    database: Path,
    images: Path,
    refine_poses: bool,
    refine_intrinsics: bool,
    threads: int,
) -> KnownModel:
    """Triangulates points from the poses of a model, and refines these.

    Args:
        model: cameras and posed images without points; changed in place.
        database: features and matches.
        images: folder of the images.
        refine_poses: bundle-adjust poses; the result is aligned with the given scale and frame.
        refine_intrinsics: bundle-adjust intrinsics as well.
        threads: CPU threads; below 1 for all.

    Raises:
        PrepareError: the poses do not fit the matches.
    """
    _, given = camera_poses(model)
    refine = refine_poses or refine_intrinsics
    worst = COARSE_PX if refine else FINE_PX
    with quiet():
        model = triangulate_points(model, database, images, max_error=worst, threads=threads)
    share = model.compute_num_observations() / max(matched_keypoints(database, list(model.reg_image_ids())), 1)
    if share < LEAST_SHARE:
        raise PrepareError(
            f"Only {share:.0%} of the matched keypoints become points from the given poses: the camera axes "
            "(--poses-axes opencv or opengl), the order of the images, the direction (camera "
            "to world is wanted) or the intrinsics (--focal, --camera) are not what the poses were made with."
        )
    error = model.compute_mean_reprojection_error()
    says = f"points from known poses: {share:.0%} of the matched keypoints, {error:.2f} px"
    for _ in range(ROUNDS if refine else 0):
        adjust(model, bundle_options(refine_poses, refine_intrinsics, False, threads, robust=True))
        with quiet():
            model = triangulate_points(model, database, images, max_error=FINE_PX, threads=threads)
    if refine:
        _, refined = camera_poses(model)
        model.transform(similarity_between(refined, given))
        says = f"{says}; refined, {model.compute_mean_reprojection_error():.2f} px; {_changes(given, model)}"
    say(says)
    return KnownModel(model, says)


def _changes(given: np.ndarray, model: pycolmap.Reconstruction) -> str:
    _, now = camera_poses(model)
    moved = np.linalg.norm(now[:, :3, 3] - given[:, :3, 3], axis=-1)
    turned = degrees_between(now[:, :3, :3], given[:, :3, :3])
    return (
        f"poses moved by {moved.mean():.3g} units (at most {moved.max():.3g}) "
        f"and turned by {turned.mean():.2f} degrees (at most {turned.max():.2f})"
    )
