"""COLMAP models: points, and which image sees which point at which pixel. Read from files, or triangulated with given
poses from features and matches in a database, for training and ``mmpi-prepare``."""

from __future__ import annotations

import signal
import struct
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import current_thread, main_thread
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from nerfstudio.data.utils.colmap_parsing_utils import read_model
from numpy.typing import NDArray

from mmpi_ns.utils.errors import InputError, brief

if TYPE_CHECKING:
    import pycolmap

OLDEST_PYCOLMAP = 4
"""First major version with the functions that this package calls."""
MIN_TRACK, MAX_ERROR_PX = 3, 2.0
"""Minimum number of images and maximum mean reprojection error of points that supervise depth."""
MIN_ANGLE = 0.5
"""Minimum triangulation angle of a point, degrees; a forward drive gives little more."""
MIN_INLIERS = 15
"""Minimum number of matches of a pair: COLMAP's own limit."""
SEED = 0


@dataclass(frozen=True)
class SfmModel:
    """Sparse points and their keypoints, sorted by image."""

    points: NDArray[np.float64]
    """[P, 3] in the model's frame."""
    names: NDArray[np.str_]
    """[M] image names: file names, with folders where the images are in several."""
    seen_by: NDArray[np.int64]
    """[Q] image of each keypoint."""
    seen_point: NDArray[np.int64]
    """[Q] point of each keypoint."""
    seen_at: NDArray[np.float64]
    """[Q, 2] position of each keypoint relative to width and height."""
    off: float = np.nan
    """Median distance of the matches from the epipolar lines of given poses, relative to the width of the image; NaN
    for a model read from files."""
    matches: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 10)))
    """[N, 10] some of the verified matches: two images, their rays, and their rays without lens distortion
    (``Matches``)."""


def find_sfm_model(path: Path) -> SfmModel | None:
    """The COLMAP model in a folder; None if there is none. Raises InputError if it cannot be read."""
    if not (path / "images.bin").is_file() and not (path / "images.txt").is_file():
        return None
    try:
        cameras, images, points = cast(Any, read_model(str(path)))
        seen_by = np.unique(np.concatenate([[], *(p.image_ids for p in points.values())]))
        if not np.isin(seen_by, list(images)).all():
            raise LookupError("its points are seen by images that it lacks")
        images = [image for _, image in sorted(images.items())]
        sizes = [(cameras[image.camera_id].width, cameras[image.camera_id].height) for image in images]
    except (ValueError, TypeError, OSError, LookupError, MemoryError, AssertionError, struct.error) as error:
        raise InputError(f"The COLMAP model in {path} cannot be read ({brief(error)}): repair or remove it.") from error
    good = {n: p.xyz for n, p in sorted(points.items()) if len(p.image_ids) >= MIN_TRACK and p.error <= MAX_ERROR_PX}
    return _joined(good, [(x.name, np.array(s), x.xys, x.point3D_ids) for x, s in zip(images, sizes, strict=True)])


def _joined(points: Mapping[int, Any], images: Sequence[tuple[str, NDArray[Any], Any, Any]]) -> SfmModel:
    """A model of points [3] by their numbers, in order, and of each image its name, size, keypoints [N, 2] in pixels
    and the points that these see [N], of which others are left out."""
    numbers, parts = np.array(list(points), np.int64), [np.zeros((0, 4))]
    for m, (_, size, places, ids) in enumerate(images):
        seen = np.isin(np.asarray(ids, np.int64), numbers)
        rows = np.searchsorted(numbers, np.asarray(ids, np.int64)[seen])
        places = np.asarray(places, np.float64).reshape(-1, 2)[seen] / size
        parts.append(np.c_[np.full(len(rows), m), rows, places])
    table, xyz = np.concatenate(parts), np.array(list(points.values()), np.float64).reshape(-1, 3)
    names, (seen_by, seen_point) = np.array([name for name, *_ in images], np.str_), table[:, :2].astype(np.int64).T
    return SfmModel(xyz, names, seen_by, seen_point, table[:, 2:])


def load_pycolmap() -> ModuleType:
    """pycolmap, which is slow to import. SIGTERM and SIGABRT, by which COLMAP itself ends on a full disk, stay as they
    were: glog's handler prints a stack trace and may wait for ever. Raises InputError if pycolmap is too old."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGABRT)}
    import pycolmap

    for number, handler in before.items():
        if handler is not None and current_thread() is main_thread():
            signal.signal(number, handler)
    if int(pycolmap.__version__.split(".")[0]) < OLDEST_PYCOLMAP:
        raise InputError(
            f"pycolmap {pycolmap.__version__} is installed, which lacks rigs and the global mapper: "
            f"pip install 'pycolmap>={OLDEST_PYCOLMAP}'."
        )
    return pycolmap


def read_reconstruction(model: pycolmap.Reconstruction, min_track: int = MIN_TRACK) -> SfmModel:
    """Well-observed points of a reconstruction, of at least ``min_track`` images, and their keypoints."""
    # In the order of the ids: that of the model itself may differ from one reading to the next.
    points = sorted(model.points3D.items())
    good = {i: p.xyz for i, p in points if p.track.length() >= min_track and p.error <= MAX_ERROR_PX}
    images = []
    for _, image in sorted(model.images.items()):
        camera, seen = model.cameras[image.camera_id], [p for p in image.points2D if p.has_point3D()]
        size, ids = np.array([camera.width, camera.height]), [p.point3D_id for p in seen]
        images.append((image.name, size, [p.xy for p in seen], ids))
    return _joined(good, images)


def numbers_in_model(files: Sequence[Path], names: Sequence[str]) -> NDArray[np.int64]:
    """Which image of a model each file is: the one whose name, with all its folders, the path ends with.

    Without one, a file name that the model has once will do, as images may have been moved. Cameras of a rig have files
    of the same names in their folders: a model's image that several files would be is none of them.

    Returns numbers in ``names``, those of the model's images, -1 where none fits. [F]
    """
    whole = {name: m for m, name in enumerate(names)}
    often = Counter(Path(name).name for name in names)
    moved = {Path(name).name: m for m, name in enumerate(names) if often[Path(name).name] == 1}
    numbers = {}
    for file in map(Path, files):
        endings = ("/".join(file.parts[i:]) for i in range(len(file.parts)))
        numbers[file] = next((whole[ending] for ending in endings if ending in whole), moved.get(file.name, -1))
    claims = Counter(numbers.values())
    return np.array([numbers[file] if claims[numbers[file]] == 1 else -1 for file in map(Path, files)], np.int64)


@contextmanager
def quiet() -> Iterator[None]:
    """Restricts COLMAP's log to fatal errors; other errors are exceptions too."""
    log = load_pycolmap().logging
    level, log.minloglevel = log.minloglevel, int(log.Level.FATAL)
    try:
        yield
    finally:
        log.minloglevel = level


def rigid3d(camera_to_world: NDArray[np.float64]) -> Any:
    """COLMAP's world-to-camera transform of a pose with OpenCV axes. [3, 4] or [4, 4]"""
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
    """SIFT features of images below a folder that the database lists, but for images that have theirs; none where masks
    (``NAME.png``) are black. ``options`` are pycolmap's."""
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
    options.ba_refine_sensor_from_rig = False
    with tempfile.TemporaryDirectory(prefix="mmpi-points-") as unread:
        return pycolmap.triangulate_points(model, database, images, unread, clear_points=True, options=options)


def epipolar_distances(
    model: Any, first: int, second: int, rays: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Sampson distances [M] of matches from the epipolar lines of the poses of two images, by their ids, over the focal
    length; ``rays`` are the matched keypoints of each image in the plane z = 1. [M, 2]"""
    pycolmap = load_pycolmap()
    relative = model.images[second].cam_from_world() * model.images[first].cam_from_world().inverse()
    essential = pycolmap.essential_matrix_from_pose(relative)
    return np.sqrt(pycolmap.compute_squared_sampson_error(*rays, essential))
