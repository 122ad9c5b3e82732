"""Poses and points from matches by COLMAP, image by image and all at once, and the choice between what comes out.

The incremental mapper's settings are relaxed until it succeeds. The global mapper (GLOMAP) averages the rotations of
all pairs first, then solves for all positions and points together. It cannot start from a wrong pair, and the track
cannot break and continue at another scale; but it needs an initial focal length that is about right.

Source: Pan et al., Global Structure-from-Motion Revisited (2024), as in COLMAP 4.
"""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pycolmap

from mmpi_ns.utils.errors import InputError, brief, log, progress
from mmpi_prepare.adjustment import STILL, is_bent, open_focals, polish, quality, with_all_points, with_focals
from mmpi_prepare.evidence import Witness, agreement, share, witness_of
from mmpi_prepare.features import matching_pairs
from mmpi_prepare.verdict import NEARLY_ALL, ORDER, Verdict, best_first, judge_alone, judge_together
from mmpi_priors.sfm import MIN_ANGLE, MIN_INLIERS, SEED

ENOUGH, CARRIES = 0.95, 0.5
"""Fraction of registered images at which no further attempt is made, and from which a model is continued with looser
settings instead of starting over."""
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
no better (docs/ablations.md)."""
STARTS = (0.7, 1.2)
"""Focal lengths over the longer side that are tried where none is known: telephones and cars, then COLMAP's guess."""
NEAR = 0.1
"""Relative difference below which two initial focal lengths count as the same."""
LEAST_POINTS = 0.05
"""Share of the matches that must have become points of the global mapper's model, or it is none: it places every image
whatever the focal length, and drops the points that do not fit."""


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
    lens: bool
    """Whether focal length and distortion may be refined."""
    full_lens: bool
    """Whether OpenCV's four lens terms may take the place of one radial term, if they fit clearly better."""
    principal_point: bool
    """Whether the principal point may be refined, if that fits clearly better: bends show it, straight stretches
    hardly do."""
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
    summary: str
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

    Raises InputError if no attempt, of ``attempts`` at most, finds an initial pair in the database, whose cameras it
    starts from.
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
        summary = f", {result[0].compute_mean_reprojection_error():.2f} px" if result else ""
        log(f"Mapping, {attempt.name} ({attempt.summary}): {size} of {total} images{summary}.")
        if result and (best is None or quality(result[0]) > quality(best[0])):
            best, chosen = result, attempt.name
        if result and size >= ENOUGH * total and not is_bent(result[0]):
            break
    if best is None:
        raise InputError(
            f"No pair of images can start a reconstruction ({pairs} pairs have matches): the camera hardly moved "
            "(turning on the spot gives no depth), or the focal length is far off: check --focal and --camera."
        )
    return best[0], f"incremental, '{chosen}' settings ({', '.join(tried)})"


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
        options = mapper_options(attempt, task.lens, task.threads, total > MANY)
        options.snapshot_path, options.snapshot_frames_freq = folder / "snapshots", SNAPSHOT
        before = pycolmap.Reconstruction(start).num_reg_images() if start is not None else 0
        if before:
            log(f"Mapping, {attempt.name}: goes on from {before} images.")
        with progress(f"Mapping, {attempt.name}", total) as advance:
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
    options.ba_refine_sensor_from_rig = False
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = STILL
    if is_large:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
        options.ba_global_max_refinements = 2
        mapper.ba_global_ignore_redundant_points3D = True
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    return options


def map_globally(
    task: Task, name: str, focals: Mapping[int, float], names: Sequence[str], threads: int
) -> pycolmap.Reconstruction | None:
    """The largest model of the global mapper, None if there is none; read back where it was made before.

    Every random draw is seeded, small angles are kept, and given intrinsics left alone. ``focals`` are focal lengths to
    start from, in pixels by camera id (the others are those of the database), ``name`` is that of the start, whose
    folder gets the models, and ``names`` are the images to place.
    """
    folder, folders, refine = task.work / name, task.work / name / "models", task.lens
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folders.mkdir(parents=True)
        database = _start_from(task, name, focals)
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
        mapper.refine_sensor_from_rig = mapper.bundle_adjustment.refine_sensor_from_rig = False
        models = pycolmap.global_mapping(database, task.images, folders, options)
        for number, model in models.items():
            (folders / str(number)).mkdir(exist_ok=True)
            full = with_all_points(model, database, task.images, refine, threads, PLACED_ROUNDS)
            full.write(folders / str(number))
        (folder / "done").touch()
    largest = largest_model(folders)
    return largest and largest[0]


def _evidence(name: str, summary: str, model: pycolmap.Reconstruction, task: Task) -> Witness | None:
    """The evidence on one candidate model; None, with the reason said, where it has none."""
    try:
        return witness_of(name, summary, model, task.database, task.offered)
    except (ArithmeticError, ValueError, RuntimeError) as error:  # numpy's LinAlgError is a ValueError
        log(f"Mapping, {name}: left out, its model cannot be judged ({brief(error)}).", "yellow")
        return None


def map_and_judge(task: Task) -> tuple[pycolmap.Reconstruction, str, Verdict]:
    """Runs the global mapper, then the incremental one from the focal length that fits, and chooses by the evidence.

    The chosen model is given all points and adjusted (``polish``), unless that makes the evidence worse; where the
    images hardly determine the focal length, let alone more of the lens, all models have that of EXIF instead.

    Returns it, the mappers in words, and how far it can be believed. Raises InputError if neither mapper makes a model.
    """
    chosen, *others = _candidates(task)
    with progress("Adding points", 1) as advance:
        model = copy.deepcopy(chosen.model)
        model = with_all_points(model, task.database, task.images, task.lens, task.threads)
        advance()
    noted = open_focals(model, task.database, task.threads) if task.lens else {}
    if noted:
        model, *rest = (with_focals(m, noted, task.threads) for m in (model, *(w.model for w in others)))
        judged = (_evidence(w.name, w.summary, m, task) for w, m in zip(others, rest, strict=True))
        others = [witness for witness in judged if witness is not None]
        before = None
    else:
        before = chosen
        model = polish(model, task.threads, task.lens, task.full_lens, task.principal_point)
    polished = _evidence(chosen.name, chosen.summary, model, task)
    grades = [ORDER.index(judge_alone(w, task.is_ordered).grade) for w in (chosen, polished) if w is not None]
    if polished is None or grades[1] > grades[0]:
        log("The final bundle adjustment makes the evidence worse: left out.", "yellow")
    else:
        chosen = polished
    verdict = judge_together(chosen, others, task.is_ordered, before)
    beside = [f"{w.summary}, {judge_alone(w, task.is_ordered).grade} by itself" for w in others]
    return chosen.model, "; beside it ".join([chosen.summary, *beside]), verdict


def _candidates(task: Task) -> list[Witness]:
    """The models of both mappers, of the global one from several focal lengths, the most credible first.

    A global mapper that placed a part of a long sequence places all images if the incremental one fails.
    """
    starts, candidates, is_settled = list(_starts(task).items()), [], False
    for some in (starts[:2], starts[2:]):
        if some and not is_settled:
            candidates += _globally(some, task.placed, task)
            right = [w for w in candidates if judge_alone(w, task.is_ordered).grade == "right"]
            differences = [agreement(right[0], w) for w in right[1:]]
            is_settled = bool(right) and all(d is not None and d.is_same for d in differences)
    focals, is_part, failed = {}, len(task.placed) < len(task.offered), None
    if candidates and task.lens:
        best = best_first(candidates, task.is_ordered)[0].model
        focals = {n: c.mean_focal_length() for n, c in best.cameras.items()}
    attempts = 1 if is_settled and not is_part else len(ATTEMPTS)
    try:
        start = _start_from(task, "from-global", focals)
        model, summary = reconstruct(task, start, attempts)
        witness = _evidence("incremental", summary, model, task)
        candidates += [witness] if witness is not None else []
    except InputError as error:
        failed = error
    large = [w for w in candidates if len(w.images) >= NEARLY_ALL * len(task.offered)]
    if is_part and not any(judge_alone(w, task.is_ordered).grade == "right" for w in large):
        candidates += _globally([("global-all", focals)], task.offered, task)
    if not candidates:
        raise failed or InputError(
            "No mapper made a model that can be judged: the lens of each is broken. Give --focal."
        )
    return best_first(candidates, task.is_ordered)


def _starts(task: Task) -> dict[str, dict[int, float]]:
    """Focal lengths that the global mapper starts from, by name of the start and id of the camera: those of the
    database if they are known, else guesses. The first guess is the focal length for which the fundamental matrices of
    the pairs become essential ones, if they determine it (in a straight drive they do not). The others are fixed
    multiples of the image side."""
    with pycolmap.Database.open(task.database) as opened:
        unknown = [c for c in opened.read_all_cameras() if not c.has_prior_focal_length]
    if not task.lens or not unknown:
        return {"global": {}}
    guesses = {f"global-{ratio}": {c.camera_id: ratio * max(c.width, c.height) for c in unknown} for ratio in STARTS}
    calibrated_database = task.work / "calibrated.db"
    shutil.copyfile(task.database, calibrated_database)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = SEED
    options.reestimate_relative_pose = False  # only the focal lengths are taken
    pycolmap.calibrate_view_graph(calibrated_database, options)
    with pycolmap.Database.open(calibrated_database) as opened:
        calibrated = {c.camera_id: c.mean_focal_length() for c in opened.read_all_cameras()}
    calibrated_database.unlink()
    if all(abs(calibrated[n] / focal - 1) > NEAR for guess in guesses.values() for n, focal in guess.items()):
        guesses = {"global-calibrated": {c.camera_id: calibrated[c.camera_id] for c in unknown}} | guesses
    return guesses


def _start_from(task: Task, name: str, focals: Mapping[int, float]) -> Path:
    """A copy of the database whose cameras start with other focal lengths; the database itself where there are none."""
    if not focals:
        return task.database
    database = task.work / f"{name}.db"
    shutil.copyfile(task.database, database)
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focals:
                camera.params[camera.focal_length_idxs()] = focals[camera.camera_id]
                opened.update_camera(camera)
    return database


def _globally(starts: Sequence[tuple[str, dict[int, float]]], names: Sequence[str], task: Task) -> list[Witness]:
    """Runs the global mapper on some images from all starts in parallel on all cores; failed starts are left out."""
    cores = task.threads if task.threads > 0 else os.cpu_count() or 1
    workers, models = min(cores, len(starts)), []
    with (
        progress("Global mapping", len(starts)) as advance,
        ThreadPoolExecutor(workers) as pool,
    ):
        for model in pool.map(lambda s: map_globally(task, s[0], s[1], names, max(1, cores // workers)), starts):
            models.append(model)
            advance()
    candidates = []
    for (name, _), model in zip(starts, models, strict=True):
        if model is None:
            log(f"Mapping, {name}: no model.")
            continue
        focal = ", ".join(f"{c.mean_focal_length():.1f}" for _, c in sorted(model.cameras.items())[:3])
        error = model.compute_mean_reprojection_error()
        summary = f"{model.num_reg_images()} of {len(names)} images, {error:.2f} px, focal length {focal} px"
        witness = _evidence("global", f"{name} ({summary})", model, task)
        if witness is None:
            continue
        if share(witness.pairs.tracked, witness.pairs.matches) < LEAST_POINTS:
            summary += "; left out, as hardly any match became a point"
        else:
            candidates.append(witness)
        log(f"Mapping, {name}: {summary}.")
    return candidates
