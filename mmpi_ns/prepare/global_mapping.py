"""Poses and points from matches, all images at once: COLMAP's global mapper (GLOMAP).

It averages the rotations of all pairs first, then solves for all positions and points together. Unlike the incremental
mapper it cannot start from a wrong pair, and the track cannot break and continue at another scale; but it needs an
initial focal length that is about right.

Source: Pan et al., Global Structure-from-Motion Revisited (2024), as in COLMAP 4.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from mmpi_ns.capture.matching import MIN_ANGLE, MIN_INLIERS, SEED, quiet
from mmpi_ns.prepare.mapping import largest_model
from mmpi_ns.prepare.polish import with_all_points

ROUNDS = 2
"""Times that a placed model is given all points and adjusted: after one, the focal length may still be far off."""
TRACKS_PER_VIEW = 500
"""Tracks used for placing each image, the longest ones: using all of them takes twice as long on kitti-street and is no
better (docs/log/prepare.md)."""


def map_globally(
    database: Path, images: Path, folder: Path, names: Sequence[str], refine: bool, threads: int
) -> tuple[pycolmap.Reconstruction, Path] | None:
    """The largest model and its folder; read back where it was made before.

    Args:
        database: features, verified matches and the cameras to start from.
        images: folder of the images, for the points' colours.
        folder: for the models.
        names: the images to place.
        refine: refine intrinsics.
        threads: CPU threads; below 1 for all.

    Returns:
        None if there is no model.
    """
    done, models = folder / "done", folder / "models"
    if not done.exists():
        shutil.rmtree(folder, ignore_errors=True)
        models.mkdir(parents=True)
        options = global_options(refine, threads)
        options.image_names = list(names)
        with quiet():
            found = pycolmap.global_mapping(database, images, models, options)
            for number, model in found.items():
                (models / str(number)).mkdir(exist_ok=True)
                with_all_points(model, database, images, refine, threads, ROUNDS).write(models / str(number))
        done.touch()
    return largest_model(models)


def global_options(refine: bool, threads: int) -> pycolmap.GlobalPipelineOptions:
    """The mapper's settings: every random draw seeded, small angles kept, given intrinsics left alone."""
    options = pycolmap.GlobalPipelineOptions()
    options.min_num_matches = MIN_INLIERS
    options.random_seed = SEED
    options.num_threads = threads
    mapper = options.mapper
    mapper.track_required_tracks_per_view = TRACKS_PER_VIEW
    mapper.random_seed = SEED
    mapper.num_threads = threads
    for part in (mapper.rotation_averaging, mapper.global_positioning):
        part.random_seed = SEED
    mapper.min_tri_angle_deg, mapper.skip_retriangulation = MIN_ANGLE, True
    mapper.bundle_adjustment.refine_focal_length = refine
    mapper.bundle_adjustment.refine_extra_params = refine
    return options


def start_from(database: Path, copy: Path, focals: dict[int, float]) -> None:
    """A copy of a database whose cameras start with other focal lengths.

    Args:
        database: features and matches.
        copy: where to; replaced.
        focals: focal length by camera number, in pixels.
    """
    copy.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focals:
                params = camera.params.copy()
                params[camera.focal_length_idxs()] = focals[camera.camera_id]
                camera.params = params
                opened.update_camera(camera)
