"""Images with poses, and tracks triangulated from their features by pycolmap if a scene has none.

Poses and intrinsics are kept fixed. The result is what a COLMAP model would contain: points, and their keypoints in the
training images. Placement uses them to locate content, and training to supervise depth.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.files import opened
from mmpi_priors import sfm
from mmpi_priors.conventions import FINE, Matches, misfit
from mmpi_priors.sfm import SfmModel, load_pycolmap, read_reconstruction

NEIGHBOURS = 8
"""Maximum number of images that each image is matched with: the nearest with a similar viewing direction."""
SMALL, LARGE = 800, 1600
"""Images up to the first size are doubled to find fine features; images above the second are reduced to it."""
MAX_ANGLE = 60.0
"""Maximum angle in degrees between the viewing directions of matched images."""
MIN_TRACK = 2
"""Minimum number of images of a point; with given poses, two are enough."""
EFFORTS = ((0.0067, False, 15), (0.002, True, 8))
"""SIFT contrast threshold, guided matching, and minimum inliers of a pair: for textured images, and for rooms at low
resolution (two to four times slower)."""
FORMATS = {"PNG": ".png", "JPEG": ".jpg", "MPO": ".jpg", "BMP": ".bmp", "TIFF": ".tif"}
"""Formats that pycolmap reads, as Pillow calls them, and their endings."""
ENOUGH = 100
"""Average number of keypoints in an image above which the thorough search is skipped."""


def near_pairs(camera_to_worlds: NDArray[np.float64], neighbours: int) -> list[tuple[int, int]]:
    """Pairs (i, j) with i < j, in order, of each camera, by poses [M, 3, 4], with its nearest ones that have a similar
    viewing direction, ``neighbours`` at most."""
    near = [
        nearest_views(camera_to_worlds, i, neighbours, MAX_ANGLE, apart=False) for i in range(len(camera_to_worlds))
    ]
    return sorted({(min(i, j), max(i, j)) for i, others in enumerate(near) for j in others})


def _gathered(files: tuple[Path, ...], folder: Path) -> list[str]:
    """Names in a folder of images by their indices, since two of other folders may be called the same: linked, or
    gray PNGs of formats that COLMAP does not read. Raises InputError if an image file cannot be read."""
    names = []
    for i, file in enumerate(files):
        with opened(file) as image:
            ending = FORMATS.get(str(image.format))
            gray = None if ending else image.convert("L")
        names.append(f"{i:06d}{ending or '.png'}")
        if gray is None:
            os.symlink(file.resolve(), folder / names[i])
        else:
            gray.save(folder / names[i], compress_level=1)
    return names


def triangulate(images: PosedImages) -> SfmModel:
    """Points triangulated from several images, in the frame of their poses, and their keypoints; images are named by
    their indices.

    Deterministic for equal images and poses. A quick search is followed by a thorough one if it finds too little. The
    quick search takes about a third of a second for each image on one core, the thorough one a second. Raises
    InputError if an image file cannot be read."""
    pycolmap, tracks, error, matches = load_pycolmap(), None, np.nan, None
    cameras = []
    for i, (width, height) in enumerate(images.sizes.astype(int).tolist()):
        lens, params = "OPENCV_FISHEYE" if images.is_fisheye(i) else "OPENCV", [*images.intrinsics[i], *images.lens(i)]
        lens, params = ("FULL_OPENCV", [*params, 0.0, 0.0, 0.0]) if any(params[8:]) else (lens, params[:8])
        camera = pycolmap.Camera(model=lens, width=width, height=height, params=params, camera_id=i + 1)
        camera.has_prior_focal_length = True
        cameras.append(camera)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = LARGE
    options.sift.first_octave = -1 if images.sizes.max() <= SMALL else 0
    with sfm.quiet(), tempfile.TemporaryDirectory(prefix="mmpi-tracks-") as folder:
        work = database = Path(folder)
        names = _gathered(images.files, work)
        pairs = [(names[i], names[j]) for i, j in near_pairs(images.camera_to_worlds, NEIGHBOURS)]
        opencv = images.camera_to_worlds @ np.diag([1.0, -1.0, -1.0, 1.0])
        lens = images.intrinsics[:, 0] / images.sizes[:, 0], images.intrinsics[:, :2], images.intrinsics[:, 2:]
        poses = dict(zip(names, map(sfm.rigid3d, opencv), strict=True))
        for contrast, guided, least in EFFORTS:
            if tracks is not None and len(tracks.seen_by) >= ENOUGH * len(names):
                break
            model, database = sfm.new_model(cameras, names, range(1, len(names) + 1), poses), work / f"{contrast}.db"
            sfm.write_images(model, database)
            options.sift.peak_threshold = contrast
            sfm.find_features(database, work, names, options)
            for file, features in zip(images.files, sfm.count_features(database), strict=True):
                if features is None:
                    raise InputError(f"Image {file} cannot be read (by COLMAP): repair it or leave it out.")
            if pairs:
                sfm.match_pairs(database, pairs, guided=guided, least=least)
                error = misfit(opencv, lens, Matches.of(model, database))
                model = sfm.triangulate_points(model, database, work, pairs_alone=True)
            tracks = read_reconstruction(model, MIN_TRACK)
        posed = sfm.new_model(cameras, names, range(1, len(names) + 1), poses)
        if not error <= FINE and len(names) > 1:
            # Wrong poses give wrong neighbours, so consecutive images are matched as well.
            sfm.match_pairs(database, [(a, b) for k in (1, 2) for a, b in zip(names, names[k:], strict=False)])
        matches = Matches.of(posed, database)
    assert tracks is not None and matches is not None
    table = np.concatenate([matches.images, *(x.reshape(-1, 4) for x in (matches.rays, matches.flat))], -1)
    order = np.array([str(names.index(name)) for name in tracks.names], np.str_)
    return replace(tracks, names=order, off=error, matches=table)
