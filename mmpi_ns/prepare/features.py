"""Features of the images and their matches, in a COLMAP database that a resumed run continues to fill."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mmpi_ns.capture.matching import (
    MIN_INLIERS,
    count_features,
    find_features,
    match_pairs,
    new_model,
    quiet,
    verified_matches,
    write_images,
)
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import PrepareError
from mmpi_ns.utils.errors import progress
from mmpi_ns.utils.files import whole

BATCH = 8
"""Images extracted at a time: the most that an interruption loses."""
PAIR_BATCH = 64
LARGEST_SIDE = 2000
"""Larger images are reduced to this side for SIFT (docs/prepare.md has time and error by size)."""
PIXELS_A_FEATURE = 100
"""At most one feature for this many pixels: more are redundant, and the cost of matching is quadratic."""
LEAST_FEATURES = 2048
"""Small images may have this many."""
FAINT = 0.003
"""SIFT's peak threshold for images with few features: weak ones count too."""
SAMPLE = 4
"""Images that are looked at to find whether they have few."""
FEATURES = 50
"""An image with fewer is of no use."""


def create_database(
    path: Path, photos: Sequence[Photo], numbers: Sequence[int], cameras: Sequence[pycolmap.Camera]
) -> None:
    """A database of the images and cameras, without features, unless it is there."""
    if not path.exists():
        path.with_name(path.name + ".partial").unlink(missing_ok=True)
        with whole(path) as partial:
            write_images(new_model(cameras, [p.name for p in photos], numbers), partial)


def extract(
    database: Path, images: Path, photos: Sequence[Photo], masks: Path | None, max_features: int, threads: int
) -> list[int]:
    """SIFT features of all images; images that have theirs are skipped.

    Weak features count too if most of a sample of the images have less than half of the features that they may have.

    Returns:
        Features of each image.

    Raises:
        PrepareError: an image cannot be read, or hardly any has features.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = threads, LARGEST_SIDE
    most = max(p.width * p.height for p in photos) // PIXELS_A_FEATURE
    options.sift.max_num_features = min(max_features, max(most, LEAST_FEATURES))
    names = [p.name for p in photos]
    with quiet():
        is_poor = most < LEAST_FEATURES
        if not is_poor:
            sample = database.with_name("sample.db")
            sample.unlink(missing_ok=True)
            places = sorted({round(i) for i in np.linspace(0, len(names) - 1, SAMPLE)})
            find_features(sample, images, [names[i] for i in places], options, masks)
            is_poor = float(np.median([n or 0 for n in count_features(sample)])) < 0.5 * options.sift.max_num_features
            sample.unlink()
        if is_poor:
            options.sift.peak_threshold = FAINT
        with progress("Finding features", len(names)) as advance:
            for start in range(0, len(names), BATCH):
                find_features(database, images, names[start : start + BATCH], options, masks)
                advance(len(names[start : start + BATCH]))
    counts = count_features(database)
    if None in counts:
        raise PrepareError(f"{names[counts.index(None)]} cannot be read by COLMAP: repair or remove it.")
    numbers = [n or 0 for n in counts]
    if sum(n >= FEATURES for n in numbers) < 2:
        raise PrepareError(
            f"Hardly any features: {max(numbers)} in the best image. The images are blank, blurred or masked over."
        )
    return numbers


def match(database: Path, photos: Sequence[Photo], pairs: Sequence[tuple[int, int]], threads: int) -> int:
    """Matches and verifies pairs of images (indices into ``photos``); pairs matched before are skipped.

    Returns:
        Pairs with verified matches.
    """
    with progress("Matching pairs", len(pairs)) as advance, quiet():
        for start in range(0, len(pairs), PAIR_BATCH):
            batch = pairs[start : start + PAIR_BATCH]
            match_pairs(database, [(photos[i].name, photos[j].name) for i, j in batch], threads=threads)
            advance(len(batch))
    return len(matching_pairs(database))


def matching_pairs(database: Path) -> list[tuple[int, int]]:
    """Pairs of image ids with enough matches that one motion of the camera explains."""
    with pycolmap.Database.open(database) as opened:
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
    return [pycolmap.pair_id_to_image_pair(p) for p, n in zip(pairs, inliers, strict=True) if n >= MIN_INLIERS]


def connected(database: Path, places: Sequence[int]) -> list[list[int]]:
    """Groups of at least three of some images (by their places) that verified matches connect, the largest first."""
    row = {place + 1: n for n, place in enumerate(places)}
    edges = [(row[a], row[b]) for a, b in matching_pairs(database) if a in row and b in row]
    ends = np.array(edges, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(edges)), tuple(ends)), shape=(len(places), len(places)))
    _, labels = connected_components(graph, directed=False)
    groups = [[places[i] for i in np.flatnonzero(labels == label)] for label in np.unique(labels)]
    return sorted((g for g in groups if len(g) > 2), key=len, reverse=True)


def matched_keypoints(database: Path, image_ids: Sequence[int]) -> int:
    """Keypoints of these images with a verified match in another of them."""
    matched: dict[int, set[int]] = {i: set() for i in image_ids}
    for *pair, matches in verified_matches(database):
        if all(i in matched for i in pair):
            for i, keypoints in zip(pair, matches.T, strict=True):
                matched[i].update(keypoints.tolist())
    return sum(map(len, matched.values()))
