"""Matching of image pairs and triangulation from known poses, by pycolmap, for training and ``mmpi-prepare``."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mmpi_ns.capture.sfm import load_pycolmap

MIN_ANGLE = 0.5
"""Minimum angle in degrees between the rays of a point; driving forward gives little more."""
MIN_INLIERS = 15
"""Minimum number of matches of a pair: COLMAP's own limit."""
SEED = 0


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps COLMAP's log to errors."""
    log = load_pycolmap().logging
    level, log.minloglevel = log.minloglevel, int(log.Level.ERROR)
    try:
        yield
    finally:
        log.minloglevel = level


def match_pairs(
    database: Path, pairs: Iterable[tuple[str, str]], threads: int = -1, guided: bool = False, least: int = MIN_INLIERS
) -> None:
    """Matches and verifies pairs of images, by name, in a database of their features; those that it has are skipped.

    ``guided`` matches a pair again along the epipolar lines of its first matches; ``least`` is the minimum of inliers.
    """
    pycolmap = load_pycolmap()
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.guided_matching, matching.num_threads = guided, threads
    verification.ransac.random_seed, verification.min_num_inliers = SEED, least
    pairing = pycolmap.ImportedPairingOptions()
    with tempfile.TemporaryDirectory(prefix="mmpi-pairs-") as folder:
        pairing.match_list_path = listing = Path(folder) / "pairs.txt"
        listing.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        options = {"matching_options": matching, "pairing_options": pairing, "verification_options": verification}
        pycolmap.match_image_pairs(database, **options)


def triangulate_points(
    model: Any, database: Path, images: Path, threads: int = -1, max_error: float = 4.0, pairs_alone: bool = False
) -> Any:
    """Points of a reconstruction's posed images from their verified matches; cameras and poses stay.

    ``max_error`` is a point's largest reprojection error, in pixels; ``pairs_alone`` takes points of two images, too.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = threads
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_ANGLE
    options.triangulation.ignore_two_view_tracks = not pairs_alone
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    options.mapper.filter_max_reproj_error = max_error
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    with tempfile.TemporaryDirectory(prefix="mmpi-points-") as unread:
        return pycolmap.triangulate_points(model, database, images, unread, clear_points=True, options=options)
