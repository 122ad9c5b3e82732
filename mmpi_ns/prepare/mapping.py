"""Poses and points from matches: COLMAP's incremental mapper, with settings relaxed until it succeeds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from mmpi_ns.capture.matching import SEED, quiet
from mmpi_ns.prepare.features import count_matching_pairs
from mmpi_ns.prepare.stages import PrepareError, progress, say

ENOUGH = 0.95
"""Fraction of registered images at which no further attempt is made."""
CARRIES = 0.5
"""Fraction of images from which a model is continued with looser settings instead of starting over."""
BENT_PX = 0.8
"""Mean reprojection error above which another attempt is made even though the images are registered."""
SNAPSHOT = 40
"""Images registered between two snapshots, from which an interrupted run resumes."""
STILL = 1e-6
"""Relative change of the cost at which an adjustment ends. COLMAP goes on to 100 iterations: of 64 images of a drive
that took four times as long, and moved the focal length by 0.002 px."""
MANY = 100
"""Number of images from which repeated global bundle adjustment would dominate the time."""


@dataclass(frozen=True)
class Attempt:
    """One way to run the mapper."""

    name: str
    says: str
    min_matches: int = 15
    init_min_tri_angle: float = 16.0
    init_max_forward_motion: float = 0.95
    init_min_num_inliers: int = 100
    filter_min_tri_angle: float = 1.5
    min_angle: float = 1.5
    abs_pose_min_num_inliers: int = 30
    abs_pose_min_inlier_ratio: float = 0.25


ATTEMPTS = (
    Attempt("ordinary", "COLMAP's defaults"),
    Attempt(
        "forward", "small angles and forward motion allowed", 15, 3.0, 1.0, filter_min_tri_angle=0.5, min_angle=0.5
    ),
    Attempt("loose", "few matches and tiny angles allowed", 10, 1.0, 1.0, 40, 0.25, 0.25, 15, 0.12),
)


@dataclass(frozen=True)
class Mapping:
    """Result of the mapper."""

    model: pycolmap.Reconstruction
    folder: Path
    """Folder of the model."""
    attempt: str
    tried: tuple[tuple[str, int], ...]
    """(attempt, images in its largest model) in order."""


def reconstruct(
    database: Path,
    images: Path,
    work: Path,
    refine: bool,
    threads: int,
    is_sequence: bool = False,
    attempts: int = len(ATTEMPTS),
) -> Mapping:
    """Runs the attempts in order until one registers nearly all images; returns the best.

    An attempt continues the best model so far if that is sound and contains the fraction ``CARRIES`` of the images:
    often it stopped at one stretch with few matches, and the rest need not be computed again.

    Args:
        database: features and matches.
        images: folder of the images, for the points' colours.
        work: folder for models and snapshots; holds those of an interrupted run.
        refine: refine intrinsics.
        threads: CPU threads; below 1 for all.
        is_sequence: begin with the settings for forward motion. They carry any motion of a sequence, while COLMAP's
            defaults look through all pairs before they give up (a minute for 64 images).
        attempts: maximum number of attempts.

    Raises:
        PrepareError: no attempt found an initial pair.
    """
    with pycolmap.Database.open(database) as opened:
        total = opened.num_images()
    pairs = count_matching_pairs(database)
    if not pairs:
        raise PrepareError(
            "No two images have enough matches in common: they do not overlap, or show too little texture. "
            "Take views with more overlap (two thirds and more)."
        )
    best: Mapping | None = None
    tried: list[tuple[str, int]] = []
    for attempt in ATTEMPTS[1 if is_sequence else 0 :][:attempts]:
        start = best.folder if best is not None and _carries(best.model, total) else None
        made = _run(attempt, database, images, work / attempt.name, total, refine, threads, start)
        size = made[0].num_reg_images() if made else 0
        tried.append((attempt.name, size))
        says = f", {made[0].compute_mean_reprojection_error():.2f} px" if made else ""
        say(f"Mapping, {attempt.name} ({attempt.says}): {size} of {total} images{says}.")
        if made and (best is None or _quality(made[0]) > _quality(best.model)):
            best = Mapping(*made, attempt.name, ())
        if made and size >= ENOUGH * total and not is_bent(made[0]):
            break
    if best is None:
        raise PrepareError(
            f"No pair of images can start a reconstruction ({pairs} pairs have matches): the camera hardly moved "
            "(turning on the spot gives no depth), or the focal length is far off: check --focal and --camera."
        )
    return replace(best, tried=tuple(tried))


def _error(model: pycolmap.Reconstruction) -> float:
    """Mean reprojection error at an image width of 1,000 pixels, or in pixels of smaller images."""
    widest = max(camera.width for camera in model.cameras.values())
    return model.compute_mean_reprojection_error() / max(1.0, widest / 1000)


def is_bent(model: pycolmap.Reconstruction) -> bool:
    """Whether a model fits its images so badly that it may have started from a wrong pair: squeezed or folded."""
    return _error(model) > BENT_PX


def _carries(model: pycolmap.Reconstruction, total: int) -> bool:
    """Whether another attempt should continue a model instead of starting over."""
    return not is_bent(model) and model.num_reg_images() >= CARRIES * total


def _quality(model: pycolmap.Reconstruction) -> tuple[bool, int, float]:
    """Sorts models: sound ones first, then those with more images, then those that fit better."""
    return not is_bent(model), model.num_reg_images(), -_error(model)


def _run(
    attempt: Attempt,
    database: Path,
    images: Path,
    folder: Path,
    total: int,
    refine: bool,
    threads: int,
    start: Path | None = None,
) -> tuple[pycolmap.Reconstruction, Path] | None:
    """The largest model of one attempt and its folder; read back where it was finished before.

    It begins with the newest snapshot of an interrupted run, or else with the model in ``start``.
    """
    done = folder / "done"
    if not done.exists():
        start = _latest_snapshot(folder / "snapshots") or start
        shutil.rmtree(folder / "models", ignore_errors=True)
        (folder / "models").mkdir(parents=True)
        (folder / "snapshots").mkdir(exist_ok=True)
        options = mapper_options(attempt, refine, threads, total > MANY)
        options.snapshot_path, options.snapshot_frames_freq = folder / "snapshots", SNAPSHOT
        known = pycolmap.Reconstruction(start).num_reg_images() if start is not None else 0
        if known:
            say(f"Mapping, {attempt.name}: goes on from {known} images.")
        with progress(f"Mapping, {attempt.name}", total) as advance, quiet():
            advance(known)
            found = pycolmap.incremental_mapping(
                database,
                images,
                folder / "models",
                options,
                input_path=start or "",
                initial_image_pair_callback=_step(advance, 2, 0),
                next_image_callback=_step(advance, 1),
            )
        for number, model in found.items():  # COLMAP itself does not write a model that it continued
            (folder / "models" / str(number)).mkdir(exist_ok=True)
            model.write(folder / "models" / str(number))
        done.touch()
        shutil.rmtree(folder / "snapshots")
    return largest_model(folder / "models")


def largest_model(folder: Path) -> tuple[pycolmap.Reconstruction, Path] | None:
    """The model with the most images in the subfolders of a folder, and its subfolder; None if there is none."""
    models = [(pycolmap.Reconstruction(p), p) for p in sorted(folder.iterdir()) if p.is_dir()]
    return max(models, key=lambda m: m[0].num_reg_images(), default=None)


def _step(advance: Callable[..., None], count: int, start: int | None = None) -> Callable[[], None]:
    return lambda: advance(count, start)


def _latest_snapshot(folder: Path) -> Path | None:
    """The newest readable snapshot; the last one may be truncated."""
    for path in sorted(folder.glob("*"), reverse=True) if folder.is_dir() else ():
        try:
            pycolmap.Reconstruction(path)
        except (ValueError, RuntimeError, OSError):
            continue
        return path
    return None


def mapper_options(
    attempt: Attempt, refine: bool, threads: int, is_large: bool = False
) -> pycolmap.IncrementalPipelineOptions:
    """The mapper's settings for an attempt, with given intrinsics left alone unless they are to be refined.

    For a large capture, global bundle adjustment runs less often and with fewer points; points that add little to the
    constraints of an image are left out until the end.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches = attempt.min_matches
    options.min_model_size = 3
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = threads
    mapper = options.mapper
    mapper.init_min_tri_angle = attempt.init_min_tri_angle
    mapper.init_max_forward_motion = attempt.init_max_forward_motion
    mapper.init_min_num_inliers = attempt.init_min_num_inliers
    mapper.filter_min_tri_angle = attempt.filter_min_tri_angle
    mapper.abs_pose_min_num_inliers = attempt.abs_pose_min_num_inliers
    mapper.abs_pose_min_inlier_ratio = attempt.abs_pose_min_inlier_ratio
    options.triangulation.min_angle = attempt.min_angle
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = STILL
    if is_large:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
        options.ba_global_max_refinements = 2
        mapper.ba_global_ignore_redundant_points3D = True
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    return options


def bundle_options(
    refine_poses: bool, refine: bool, principal_point: bool, threads: int, robust: bool = False
) -> pycolmap.BundleAdjustmentOptions:
    """Bundle adjustment of points, and of poses and intrinsics on request."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_rig_from_world = refine_poses
    options.refine_focal_length = options.refine_extra_params = refine
    options.refine_principal_point = principal_point
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = STILL
    if robust:
        options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, 1.0
    return options


def adjust(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Bundle adjustment over all images, in place. (``pycolmap.bundle_adjustment`` cannot be kept quiet.)"""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    if options.refine_rig_from_world:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with quiet():
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
