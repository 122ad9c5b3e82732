"""Features of the images and their matches, in a COLMAP database that a resumed run continues to fill."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mmpi_ns.capture.matching import MIN_INLIERS, match_pairs, quiet
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import PrepareError, progress, whole

BATCH = 8
"""Images extracted at a time: the most that an interruption loses."""
PAIR_BATCH = 64
PIXELS_A_FEATURE = 100
"""At most one feature for this many pixels: more are redundant, and the cost of matching is quadratic."""
LEAST_FEATURES = 2048
"""Small images may have this many."""
FAINT = 0.003
"""SIFT's peak threshold for images with few features: weak ones count too."""
SAMPLE = 4
"""Images that are looked at to find whether they have few."""


def create_database(
    path: Path, photos: Sequence[Photo], numbers: Sequence[int], cameras: Sequence[pycolmap.Camera]
) -> None:
    """A database of the images and cameras; image ids follow the order of the images, independent of threads."""
    if path.exists():
        return
    path.with_name(path.name + ".partial").unlink(missing_ok=True)
    model = empty_model(photos, numbers, cameras)
    with whole(path) as partial, pycolmap.Database.open(partial) as database:
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for image_id in range(1, len(photos) + 1):
            database.write_frame(model.frames[model.images[image_id].frame_id], use_frame_id=True)
            database.write_image(model.images[image_id], use_image_id=True)


def empty_model(
    photos: Sequence[Photo],
    numbers: Sequence[int],
    cameras: Sequence[pycolmap.Camera],
    poses: dict[str, pycolmap.Rigid3d] | None = None,
) -> pycolmap.Reconstruction:
    """A reconstruction without points: image i has id i + 1. With poses, only the images that have one."""
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for i, (photo, number) in enumerate(zip(photos, numbers, strict=True)):
        image = pycolmap.Image(name=photo.name, camera_id=number, image_id=i + 1)
        if poses is None:
            model.add_image_with_trivial_frame(image)
        elif photo.name in poses:
            model.add_image_with_trivial_frame(image, poses[photo.name])
    return model


def extract(
    database: Path, images: Path, photos: Sequence[Photo], masks: Path | None, max_features: int, threads: int
) -> list[int]:
    """SIFT features of all images; images that have theirs are skipped.

    Returns:
        Features of each image.

    Raises:
        PrepareError: an image cannot be read, or hardly any has features.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    most = max(p.width * p.height for p in photos) // PIXELS_A_FEATURE
    options.sift.max_num_features = min(max_features, max(most, LEAST_FEATURES))
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    names = [p.name for p in photos]
    sample = [names[i] for i in sorted({round(i) for i in np.linspace(0, len(names) - 1, SAMPLE)})]
    if most < LEAST_FEATURES or _are_poor(sample, images, database.with_name("sample.db"), reader, options):
        options.sift.peak_threshold = FAINT
    with progress("Finding features", len(names)) as advance, quiet():
        for start in range(0, len(names), BATCH):
            batch = names[start : start + BATCH]
            pycolmap.extract_features(
                database, images, image_names=batch, reader_options=reader, extraction_options=options
            )
            advance(len(batch))
    with pycolmap.Database.open(database) as opened:
        counts = [opened.num_keypoints_for_image(i + 1) for i in range(len(names))]
        for i, name in enumerate(names):
            if not opened.exists_keypoints(i + 1):
                raise PrepareError(f"{name} cannot be read by COLMAP: repair or remove it.")
    if sum(c >= 50 for c in counts) < 2:
        raise PrepareError(
            f"Hardly any features: {max(counts)} in the best image. The images are blank, blurred or masked over."
        )
    return counts


def _are_poor(
    names: Sequence[str],
    images: Path,
    unused: Path,
    reader: pycolmap.ImageReaderOptions,
    options: pycolmap.FeatureExtractionOptions,
) -> bool:
    """Whether most of some images have less than half of the features that they may have; ``unused`` is a database."""
    unused.unlink(missing_ok=True)
    with quiet():
        pycolmap.extract_features(unused, images, image_names=names, reader_options=reader, extraction_options=options)
    with pycolmap.Database.open(unused) as opened:
        counts = [opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()]
    unused.unlink()
    return float(np.median(counts or [0])) < 0.5 * options.sift.max_num_features


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
    return count_matching_pairs(database)


def count_matching_pairs(database: Path) -> int:
    """Pairs with enough matches that one motion of the camera explains."""
    with pycolmap.Database.open(database) as opened:
        _, inliers = opened.read_two_view_geometry_num_inliers()
    return sum(n >= MIN_INLIERS for n in inliers)


def connected(database: Path, places: Sequence[int]) -> list[list[int]]:
    """Groups of at least three of some images (by their places) that verified matches connect, the largest first."""
    place = {p + 1: n for n, p in enumerate(places)}
    with pycolmap.Database.open(database) as opened:
        numbers, inliers = opened.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(n) for n, c in zip(numbers, inliers, strict=True) if c >= MIN_INLIERS]
    edges = np.array([(place[a], place[b]) for a, b in pairs if a in place and b in place], int).reshape(-1, 2)
    graph = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(places), len(places)))
    _, labels = connected_components(graph, directed=False)
    groups = [[places[i] for i in np.flatnonzero(labels == label)] for label in np.unique(labels)]
    return sorted((g for g in groups if len(g) > 2), key=len, reverse=True)


def matched_keypoints(database: Path, image_ids: Sequence[int]) -> int:
    """Keypoints of these images with a verified match in another of them."""
    wanted, found = set(image_ids), {i: set() for i in image_ids}
    with pycolmap.Database.open(database) as opened:
        pairs, geometries = opened.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        if a in wanted and b in wanted:
            found[a].update(geometry.inlier_matches[:, 0].tolist())
            found[b].update(geometry.inlier_matches[:, 1].tolist())
    return sum(len(keypoints) for keypoints in found.values())
