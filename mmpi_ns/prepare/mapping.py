"""Poses and points from matches by COLMAP: image by image, all at once, or points alone where poses are known.

The incremental mapper's settings are relaxed until it succeeds. The global mapper (GLOMAP) averages the rotations of
all pairs first, then solves for all positions and points together. It cannot start from a wrong pair, and the track
cannot break and continue at another scale; but it needs an initial focal length that is about right.

Source: Pan et al., Global Structure-from-Motion Revisited (2024), as in COLMAP 4.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.matching import MIN_ANGLE, MIN_INLIERS, SEED, quiet, triangulate_points
from mmpi_ns.prepare.adjustment import STILL, Free, adjust, with_all_points
from mmpi_ns.prepare.alignment import camera_poses, degrees_between, similarity_between
from mmpi_ns.prepare.features import matched_keypoints, matching_pairs
from mmpi_ns.utils.errors import InputError, progress, say

ENOUGH = 0.95
"""Fraction of registered images at which no further attempt is made."""
CARRIES = 0.5
"""Fraction of images from which a model is continued with looser settings instead of starting over."""
BENT_PX = 0.8
"""Mean reprojection error above which another attempt is made even though the images are registered."""
SNAPSHOT = 40
"""Images registered between two snapshots, from which an interrupted run resumes."""
MANY = 100
"""Number of images from which repeated global bundle adjustment would dominate the time."""
PLACED = 100
"""Images of a sequence that the global mapper places at least; all of fewer."""
PLACED_ROUNDS = 2
"""Times that a globally placed model is given all points and adjusted: after one, the focal length may be far off."""
TRACKS_PER_VIEW = 500
"""Tracks used for placing each image globally, the longest ones: using all takes twice as long on kitti-street and is
no better (docs/log/prepare.md)."""
REFINE_ROUNDS = 3
"""Rounds of refining known poses and triangulating points again."""
COARSE_PX, FINE_PX = 8.0, 4.0
"""Largest reprojection error of a point of known poses: while these are to be refined, and in the end."""
LEAST_SHARE = 0.2
"""Fraction of the matched keypoints that must become points; few do where known poses are those of other images."""


@dataclass(frozen=True)
class Task:
    """Input of a mapping: matches, images, and the folder for its models."""

    database: Path
    """Features and verified matches."""
    images: Path
    """Folder of the images."""
    work: Path
    """Folder for databases, models and snapshots; holds those of an interrupted run."""
    offered: Sequence[str]
    """Names of all images, in order."""
    free: Free
    """What may be refined of the intrinsics."""
    threads: int
    """CPU threads; below 1 for all."""
    is_sequence: bool
    """Matched as a sequence: the incremental mapper begins with the settings for forward motion. They carry any motion
    of a sequence, while COLMAP's defaults try all pairs before they give up (a minute for 64 images)."""
    is_ordered: bool
    """The images come in the order of the motion, so that breaks between neighbours can be looked for."""

    @property
    def placed(self) -> Sequence[str]:
        """Names of the images that the global mapper places first: of a long sequence every second, third and so on.

        That is enough to find the focal length and to confirm the incremental mapper's track, in a part of the time.
        """
        return self.offered[:: max(1, len(self.offered) // PLACED)] if self.is_ordered else self.offered


@dataclass(frozen=True)
class Attempt:
    """One way to run the incremental mapper."""

    name: str
    says: str
    min_matches: int = 15
    min_angle: float = 1.5
    """Degrees between the rays of a point."""
    mapper: dict[str, float] = field(default_factory=dict)
    """Options of ``pycolmap.IncrementalMapperOptions`` that differ from COLMAP's defaults."""


FORWARD = {"init_min_tri_angle": 3.0, "init_max_forward_motion": 1.0, "filter_min_tri_angle": 0.5}
LOOSE = FORWARD | {"init_min_tri_angle": 1.0, "filter_min_tri_angle": 0.25, "init_min_num_inliers": 40}
LOOSE |= {"abs_pose_min_num_inliers": 15, "abs_pose_min_inlier_ratio": 0.12}
ATTEMPTS = (
    Attempt("ordinary", "COLMAP's defaults"),
    Attempt("forward", "small angles and forward motion allowed", 15, 0.5, FORWARD),
    Attempt("loose", "few matches and tiny angles allowed", 10, 0.25, LOOSE),
)


def reconstruct(task: Task, database: Path, attempts: int = len(ATTEMPTS)) -> tuple[pycolmap.Reconstruction, str]:
    """Runs the attempts in order until one registers nearly all images; returns the best model, and words about it.

    An attempt continues the best model of the earlier ones if that is sound and contains the fraction ``CARRIES`` of
    the images: often it stopped at one stretch with few matches, and the rest need not be computed again.

    Args:
        task: what is to be mapped.
        database: features, verified matches and the cameras to start from.
        attempts: maximum number of attempts.

    Raises:
        InputError: no attempt found an initial pair.
    """
    total, pairs = len(task.offered), len(matching_pairs(database))
    if not pairs:
        raise InputError(
            "No two images have enough matches in common: they do not overlap, or show too little texture. "
            "Take views with more overlap (two thirds and more)."
        )
    best: tuple[pycolmap.Reconstruction, Path] | None = None
    chosen, tried = "", []
    for attempt in ATTEMPTS[1 if task.is_sequence else 0 :][:attempts]:
        carries = best and not is_bent(best[0]) and best[0].num_reg_images() >= CARRIES * total
        result = _run(task, attempt, database, best[1] if best and carries else None)
        size = result[0].num_reg_images() if result else 0
        tried.append(f"{attempt.name} {size}")
        says = f", {result[0].compute_mean_reprojection_error():.2f} px" if result else ""
        say(f"Mapping, {attempt.name} ({attempt.says}): {size} of {total} images{says}.")
        if result and (best is None or _quality(result[0]) > _quality(best[0])):
            best, chosen = result, attempt.name
        if result and size >= ENOUGH * total and not is_bent(result[0]):
            break
    if best is None:
        raise InputError(
            f"No pair of images can start a reconstruction ({pairs} pairs have matches): the camera hardly moved "
            "(turning on the spot gives no depth), or the focal length is far off: check --focal and --camera."
        )
    return best[0], f"incremental, '{chosen}' settings ({', '.join(tried)})"


def _quality(model: pycolmap.Reconstruction) -> tuple[bool, int, float]:
    """Sorts models by soundness, then by number of images, then by fit.

    Errors are those at an image width of 1,000 pixels, or in pixels of smaller images.
    """
    widest = max(camera.width for camera in model.cameras.values())
    error = model.compute_mean_reprojection_error() / max(1.0, widest / 1000)
    return error <= BENT_PX, model.num_reg_images(), -error


def is_bent(model: pycolmap.Reconstruction) -> bool:
    """Whether a model fits its images so badly that it may have started from a wrong pair: squeezed or folded."""
    return not _quality(model)[0]


def _run(
    task: Task, attempt: Attempt, database: Path, start: Path | None
) -> tuple[pycolmap.Reconstruction, Path] | None:
    """The largest model of one attempt and its folder; read back where it was finished before.

    It begins with the newest snapshot of an interrupted run, or else with the model in ``start``.
    """
    folder, total = task.work / "incremental" / attempt.name, len(task.offered)
    done = folder / "done"
    if not done.exists():
        for snapshot in sorted((folder / "snapshots").glob("*"), reverse=True):
            with suppress(ValueError, RuntimeError, OSError):  # the last one may be truncated
                pycolmap.Reconstruction(snapshot)
                start = snapshot
                break
        shutil.rmtree(folder / "models", ignore_errors=True)
        (folder / "models").mkdir(parents=True)
        (folder / "snapshots").mkdir(exist_ok=True)
        options = mapper_options(attempt, task.free.lens, task.threads, total > MANY)
        options.snapshot_path, options.snapshot_frames_freq = folder / "snapshots", SNAPSHOT
        before = pycolmap.Reconstruction(start).num_reg_images() if start is not None else 0
        if before:
            say(f"Mapping, {attempt.name}: goes on from {before} images.")
        # An attempt that fails is reported in words.
        with progress(f"Mapping, {attempt.name}", total) as advance, quiet(shows_errors=False):
            advance(before)
            models = pycolmap.incremental_mapping(
                database,
                task.images,
                folder / "models",
                options,
                input_path=start or "",
                initial_image_pair_callback=partial(advance, 2, 0),
                next_image_callback=partial(advance, 1),
            )
        for number, model in models.items():  # COLMAP itself does not write a model that it continued
            (folder / "models" / str(number)).mkdir(exist_ok=True)
            model.write(folder / "models" / str(number))
        done.touch()
        shutil.rmtree(folder / "snapshots")
    return largest_model(folder / "models")


def largest_model(folder: Path) -> tuple[pycolmap.Reconstruction, Path] | None:
    """The model with the most images in the subfolders of a folder, and its subfolder; None without a model."""
    models = [(pycolmap.Reconstruction(p), p) for p in sorted(folder.iterdir()) if p.is_dir()]
    return max(models, key=lambda m: m[0].num_reg_images(), default=None)


def mapper_options(
    attempt: Attempt, refine: bool, threads: int, is_large: bool = False
) -> pycolmap.IncrementalPipelineOptions:
    """The incremental mapper's settings for an attempt; given intrinsics are left alone.

    For a large capture, global bundle adjustment runs less often and with fewer points; points that add little to the
    constraints of an image are left out until the end.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches = attempt.min_matches
    options.min_model_size = 3
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = threads
    mapper = options.mapper
    for name, value in attempt.mapper.items():
        setattr(mapper, name, value)
    options.triangulation.min_angle = attempt.min_angle
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = STILL
    if is_large:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
        options.ba_global_max_refinements = 2
        mapper.ba_global_ignore_redundant_points3D = True
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    return options


def map_globally(
    task: Task, name: str, database: Path, names: Sequence[str], threads: int
) -> pycolmap.Reconstruction | None:
    """The largest model of the global mapper, None if there is none; read back where it was made before.

    Every random draw is seeded, small angles are kept, and given intrinsics left alone.

    Args:
        task: what is to be mapped.
        name: of the folder for the models.
        database: features, verified matches and the cameras to start from.
        names: the images to place.
        threads: CPU threads.
    """
    folder, folders, refine = task.work / name, task.work / name / "models", task.free.lens
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folders.mkdir(parents=True)
        options = pycolmap.GlobalPipelineOptions()
        options.image_names = list(names)
        options.min_num_matches = MIN_INLIERS
        mapper = options.mapper
        options.num_threads = mapper.num_threads = threads
        for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning):
            part.random_seed = SEED
        mapper.track_required_tracks_per_view = TRACKS_PER_VIEW
        mapper.min_tri_angle_deg, mapper.skip_retriangulation = MIN_ANGLE, True
        mapper.bundle_adjustment.refine_focal_length = mapper.bundle_adjustment.refine_extra_params = refine
        with quiet():
            models = pycolmap.global_mapping(database, task.images, folders, options)
            for number, model in models.items():
                (folders / str(number)).mkdir(exist_ok=True)
                full = with_all_points(model, database, task.images, refine, threads, PLACED_ROUNDS)
                full.write(folders / str(number))
        (folder / "done").touch()
    largest = largest_model(folders)
    return largest and largest[0]


def map_known_poses(
    model: pycolmap.Reconstruction, database: Path, images: Path, refine_poses: bool, refine_lens: bool, threads: int
) -> tuple[pycolmap.Reconstruction, str]:
    """Triangulates points from the poses of a model, and refines these.

    Args:
        model: cameras and posed images without points; changed in place.
        database: features and matches.
        images: folder of the images.
        refine_poses: bundle-adjust poses; the result is aligned with the given scale and frame.
        refine_lens: bundle-adjust intrinsics as well.
        threads: CPU threads; below 1 for all.

    Returns:
        The model with points, and what was done in words.

    Raises:
        InputError: the poses do not fit the matches.
    """
    _, before = camera_poses(model)
    refines = refine_poses or refine_lens
    with quiet():
        model = triangulate_points(model, database, images, threads, COARSE_PX if refines else FINE_PX)
    share = model.compute_num_observations() / max(matched_keypoints(database, list(model.reg_image_ids())), 1)
    if share < LEAST_SHARE:
        raise InputError(
            f"Only {share:.0%} of the matched keypoints become points from the given poses: the camera axes "
            "(--poses-axes opencv or opengl), the order of the images, the direction (camera "
            "to world is wanted) or the intrinsics (--focal, --camera) are not what the poses were made with."
        )
    error = model.compute_mean_reprojection_error()
    says = f"points from known poses: {share:.0%} of the matched keypoints, {error:.2f} px"
    if refines:
        for _ in range(REFINE_ROUNDS):
            adjust(model, threads, refine_lens, poses=refine_poses)
            with quiet():
                model = triangulate_points(model, database, images, threads, FINE_PX)
        model.transform(similarity_between(camera_poses(model)[1], before))
        _, after = camera_poses(model)
        moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=-1)
        turned = degrees_between(after[:, :3, :3], before[:, :3, :3])
        says += (
            f"; refined, {model.compute_mean_reprojection_error():.2f} px; poses moved by {moved.mean():.3g} units (at "
            f"most {moved.max():.3g}) and turned by {turned.mean():.2f} degrees (at most {turned.max():.2f})"
        )
    say(says)
    return model, says
