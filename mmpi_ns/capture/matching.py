"""Features, matches and triangulation from known poses in one COLMAP database, for training and ``mmpi-prepare``."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.capture.sfm import load_pycolmap

MIN_ANGLE = 0.5
"""Minimum angle in degrees between the rays of a point; driving forward gives little more."""
MIN_INLIERS = 15
"""Minimum number of matches of a pair: COLMAP's own limit."""
SEED = 0


@contextmanager
def quiet(shows_errors: bool = True) -> Iterator[None]:
    """Keeps COLMAP's log to errors, or to what ends the program."""
    log = load_pycolmap().logging
    level, log.minloglevel = log.minloglevel, int(log.Level.ERROR if shows_errors else log.Level.FATAL)
    try:
        yield
    finally:
        log.minloglevel = level


def rigid3d(camera_to_world: NDArray[np.float64]) -> Any:
    """World to camera, as COLMAP has it, of a pose with OpenCV axes. [3, 4] or [4, 4]"""
    pycolmap, rotation = load_pycolmap(), camera_to_world[:3, :3]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.T), -rotation.T @ camera_to_world[:3, 3])


def new_model(
    cameras: Iterable[Any], names: Sequence[str], camera_ids: Sequence[int], poses: Mapping[str, Any] | None = None
) -> Any:
    """A reconstruction without points: image i has id i + 1. With poses (by name), only the images that have one."""
    pycolmap = load_pycolmap()
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for i, (name, camera_id) in enumerate(zip(names, camera_ids, strict=True)):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=i + 1)
        if poses is None:
            model.add_image_with_trivial_frame(image)
        elif name in poses:
            model.add_image_with_trivial_frame(image, poses[name])
    return model


def write_images(model: Any, database: Path) -> None:
    """Writes cameras and images of a model to a new database; features keep these ids, whatever the threads do."""
    with load_pycolmap().Database.open(database) as opened:
        for _, camera in sorted(model.cameras.items()):
            opened.write_camera(camera, use_camera_id=True)
        for _, rig in sorted(model.rigs.items()):
            opened.write_rig(rig, use_rig_id=True)
        for _, image in sorted(model.images.items()):
            opened.write_frame(model.frames[image.frame_id], use_frame_id=True)
            opened.write_image(image, use_image_id=True)


def find_features(database: Path, images: Path, names: Sequence[str], options: Any, masks: Path | None = None) -> None:
    """SIFT features of images that the database lists; images that have theirs are skipped.

    Args:
        database: gets keypoints and descriptors.
        images: folder of the images.
        names: of the images, below the folder.
        options: pycolmap.FeatureExtractionOptions.
        masks: folder of masks (``NAME.png``): no features where they are black.
    """
    pycolmap = load_pycolmap()
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    pycolmap.extract_features(
        database, images, image_names=list(names), reader_options=reader, extraction_options=options
    )


def count_features(database: Path) -> list[int | None]:
    """Number of features of each image by id; None of an image that could not be read."""
    with load_pycolmap().Database.open(database) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images())
        return [opened.num_keypoints_for_image(i) if opened.exists_keypoints(i) else None for i in ids]


def match_pairs(
    database: Path, pairs: Iterable[tuple[str, str]], threads: int = -1, guided: bool = False, least: int = MIN_INLIERS
) -> None:
    """Matches and verifies pairs of images, by name, in a database of their features, unless it has their matches.

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


def verified_matches(database: Path) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """(image, image, keypoints [N, 2] of both) of every pair of images with verified matches; images by their ids."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        pairs, geometries = opened.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        yield *pycolmap.pair_id_to_image_pair(pair), np.asarray(geometry.inlier_matches).astype(int).reshape(-1, 2)


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


def epipolar_distances(
    model: Any, first: int, second: int, rays: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Sampson distances of matches from the epipolar lines of two images' poses, over the focal length. [M]

    Args:
        model: poses and cameras.
        first, second: ids of the images.
        rays: matched keypoints of each image in the plane z = 1. [M, 2]
    """
    pycolmap = load_pycolmap()
    relative = model.images[second].cam_from_world() * model.images[first].cam_from_world().inverse()
    essential = pycolmap.essential_matrix_from_pose(relative)
    return np.sqrt(pycolmap.compute_squared_sampson_error(*rays, essential))
