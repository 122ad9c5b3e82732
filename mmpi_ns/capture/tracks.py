"""Tracks for scenes that come with poses alone: features of the training images, matched and triangulated by pycolmap.

Poses and intrinsics are kept fixed. The result is what a COLMAP model would contain: points, and their keypoints in the
training images. Placement uses them to locate content, and training to supervise depth.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.capture.matching import match_pairs, quiet, triangulate_points
from mmpi_ns.capture.sfm import SfmModel, load_pycolmap, read_reconstruction
from mmpi_ns.utils.errors import InputError

NEIGHBOURS = 8
"""Maximum number of images that each image is matched with: the nearest with a similar viewing direction."""
SMALL, LARGE = 800, 1600
"""Images up to the first size are doubled to find fine features; images above the second are reduced to it."""
MAX_ANGLE = 60.0
"""Maximum angle in degrees between the viewing directions of matched images."""
MIN_TRACK = 2
"""Minimum number of images of a point; with given poses, two are enough."""
ENOUGH = 100
"""Average number of keypoints in an image above which the thorough search is skipped."""


@dataclass(frozen=True)
class Effort:
    """Effort of the search for matches."""

    peak_threshold: float
    """Contrast of the faintest features (SIFT)."""
    guided: bool
    """Whether a pair is matched again along the epipolar lines of its first matches."""
    min_matches: int
    """Minimum number of inlier matches of a pair."""


EFFORTS = (Effort(0.0067, False, 15), Effort(0.002, True, 8))
"""Settings for textured images, and for rooms at low resolution (two to four times slower)."""


@dataclass(frozen=True)
class PosedImages:
    """Images and their cameras."""

    files: tuple[Path, ...]
    camera_to_worlds: NDArray[np.float64]
    """[M, 3, 4], OpenGL axes."""
    intrinsics: NDArray[np.float64]
    """[M, 4]: fx, fy, cx, cy in pixels."""
    sizes: NDArray[np.float64]
    """[M, 2]: width, height in pixels."""
    distortion: NDArray[np.float64]
    """[M, 4]: k1, k2, p1, p2 (OpenCV), or k1 to k4 of a fisheye lens."""
    fisheye: bool = False

    def pairs(self) -> list[tuple[int, int]]:
        """Images worth matching."""
        return near_pairs(self.camera_to_worlds[:, :, 3], -self.camera_to_worlds[:, :, 2], NEIGHBOURS)


def near_pairs(centers: NDArray[np.float64], facing: NDArray[np.float64], neighbours: int) -> list[tuple[int, int]]:
    """Pairs of each camera with the nearest ones that have a similar viewing direction.

    Args:
        centers: camera centres. [M, 3]
        facing: unit viewing directions. [M, 3]
        neighbours: maximum number of cameras chosen by each.

    Returns:
        Pairs (i, j) with i < j, in order.
    """
    wanted = set()
    for i, (center, axis) in enumerate(zip(centers, facing, strict=True)):
        distance = np.linalg.norm(centers - center, axis=-1)
        usable = facing @ axis > np.cos(np.radians(MAX_ANGLE))
        usable[i] = False
        order = np.argsort(np.where(usable, distance, np.inf), kind="stable")
        wanted |= {(min(i, int(j)), max(i, int(j))) for j in order[: min(neighbours, int(usable.sum()))]}
    return sorted(wanted)


def triangulate(images: PosedImages) -> SfmModel:
    """Points seen in several images, and their keypoints.

    Deterministic for equal images and poses. A quick search is followed by a thorough one if it finds too little.
    The quick search takes about a third of a second for each image on one core, the thorough one a second.

    Args:
        images: image files with their cameras, whose poses are in any one frame.

    Returns:
        Points in the frame of the poses; none if nothing matches. Image names are their indices in ``images``.

    Raises:
        InputError: an image file cannot be read.
    """
    pycolmap, tracks = load_pycolmap(), None
    with quiet():
        for effort in EFFORTS:
            tracks = _attempt(pycolmap, images, effort)
            if sum(len(points) for points, _ in tracks.keypoints) >= ENOUGH * len(images.files):
                break
    assert tracks is not None
    return tracks


def _attempt(pycolmap: Any, images: PosedImages, effort: Effort) -> SfmModel:
    pairs, off = images.pairs(), None
    with tempfile.TemporaryDirectory(prefix="mmpi-tracks-") as folder:
        work = Path(folder)
        names = _link(images.files, work / "images")
        _extract(pycolmap, work, names, effort, doubled=images.sizes.max() <= SMALL)
        model = _posed_model(pycolmap, work, names, images)
        if pairs:
            named, database = [(names[i], names[j]) for i, j in pairs], work / "database.db"
            match_pairs(database, named, guided=effort.guided, least=effort.min_matches)
            off = _off_epipolar_lines(pycolmap, database, model)
            model = triangulate_points(model, database, work / "images", pairs_alone=True)
        tracks = read_reconstruction(model, MIN_TRACK)
        return replace(tracks, names=tuple(str(names.index(name)) for name in tracks.names), off=off)


def _link(files: Sequence[Path], folder: Path) -> list[str]:
    """Links the images under their indices as names, since two folders may contain files of the same name."""
    folder.mkdir()
    names = []
    for i, file in enumerate(files):
        names.append(f"{i:06d}{file.suffix.lower()}")
        os.symlink(file.resolve(), folder / names[-1])
    return names


def _extract(pycolmap: Any, work: Path, names: list[str], effort: Effort, doubled: bool) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = LARGE
    options.sift.first_octave = -1 if doubled else 0
    options.sift.peak_threshold = effort.peak_threshold
    pycolmap.extract_features(
        work / "features.db",
        work / "images",
        image_names=names,
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        extraction_options=options,
    )


def _off_epipolar_lines(pycolmap: Any, database: Path, model: Any) -> float | None:
    """Median distance of the verified matches from the epipolar lines of a model's poses, relative to the width.

    Unlike reprojection errors of points it is not truncated: matches that fit the poses badly never become points.
    """
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
        keypoints = {i: np.asarray(opened.read_keypoints(i), np.float64).reshape(-1, 6)[:, :2] for i in model.images}
    found = []
    for number, geometry in zip(numbers, geometries, strict=True):
        matches = np.asarray(geometry.inlier_matches).astype(int).reshape(-1, 2)
        images = [model.images[i] for i in pycolmap.pair_id_to_image_pair(number)]
        cameras = [model.cameras[image.camera_id] for image in images]
        rays = [
            camera.cam_from_img(keypoints[image.image_id][matches[:, k]])
            for k, (image, camera) in enumerate(zip(images, cameras, strict=True))
        ]
        relative = images[1].cam_from_world() * images[0].cam_from_world().inverse()
        off = np.sqrt(pycolmap.compute_squared_sampson_error(*rays, pycolmap.essential_matrix_from_pose(relative)))
        found.append(off * cameras[0].mean_focal_length() / cameras[0].width)
    return float(np.median(np.concatenate(found))) if found and sum(map(len, found)) else None


def _posed_model(pycolmap: Any, work: Path, names: list[str], images: PosedImages) -> Any:
    """A model of the given cameras without points, and a database of the features in the order of the images.

    Extraction numbers the images in the order in which its threads finish; the second database makes the tracks
    deterministic.
    """
    model = pycolmap.Reconstruction()
    with (
        pycolmap.Database.open(work / "features.db") as features,
        pycolmap.Database.open(work / "database.db") as database,
    ):
        found = {image.name: image.image_id for image in features.read_all_images()}
        for i, name in enumerate(names):
            if name not in found:
                raise InputError(f"Training image {images.files[i]} cannot be read: repair or remove it.")
            camera = _camera(pycolmap, images, i)
            model.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=i + 1)
            model.add_image_with_trivial_frame(image, _world_to_camera(pycolmap, images.camera_to_worlds[i]))
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(model.rigs[model.frames[model.images[i + 1].frame_id].rig_id], use_rig_id=True)
            database.write_frame(model.frames[model.images[i + 1].frame_id], use_frame_id=True)
            database.write_image(model.images[i + 1], use_image_id=True)
            database.write_keypoints(i + 1, features.read_keypoints(found[name]))
            database.write_descriptors(i + 1, features.read_descriptors(found[name]))
    return model


def _camera(pycolmap: Any, images: PosedImages, i: int) -> Any:
    width, height = (int(n) for n in images.sizes[i])
    params = [*images.intrinsics[i], *images.distortion[i]]
    model = "OPENCV_FISHEYE" if images.fisheye else "OPENCV"
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params, camera_id=i + 1)
    camera.has_prior_focal_length = True
    return camera


def _world_to_camera(pycolmap: Any, camera_to_world: NDArray[np.float64]) -> Any:
    """COLMAP's pose: world to camera, with y down and z forward."""
    rotation = camera_to_world[:, :3] * [1, -1, -1]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.T), -rotation.T @ camera_to_world[:, 3])
