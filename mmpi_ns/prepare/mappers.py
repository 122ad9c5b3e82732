"""Runs both mappers on one database and chooses between them."""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pycolmap

from mmpi_ns.capture.matching import SEED, quiet
from mmpi_ns.prepare.adjustment import polish, with_all_points
from mmpi_ns.prepare.evidence import Witness, agreement, share, witness_of
from mmpi_ns.prepare.mapping import ATTEMPTS, Task, map_globally, reconstruct
from mmpi_ns.prepare.verdict import NEARLY_ALL, ORDER, Verdict, agrees, best_first, judge_alone, judge_together
from mmpi_ns.utils.errors import InputError, progress, say

STARTS = (0.7, 1.2)
"""Focal lengths over the longer side that are tried where none is known: telephones and cars, then COLMAP's guess."""
NEAR = 0.1
"""Relative difference below which two initial focal lengths count as the same."""
LEAST_POINTS = 0.05
"""Share of the matches that must have become points of the global mapper's model, or it is none: it places every image
whatever the focal length, and drops the points that do not fit."""


def map_and_judge(task: Task) -> tuple[pycolmap.Reconstruction, str, Verdict]:
    """Runs the global mapper, then the incremental one from the focal length that fits, and chooses by the evidence.

    The chosen model is given all points and adjusted (``polish``), unless that makes the evidence worse.

    Returns:
        Poses and points, the mappers in words, and how far they can be believed.

    Raises:
        InputError: neither mapper makes a model.
    """
    chosen, *others = _candidates(task)
    with progress("Adding points", 1) as advance:
        model = copy.deepcopy(chosen.model)
        model = with_all_points(model, task.database, task.images, task.free.lens, task.threads)
        advance()
    model = polish(model, task.free, task.threads)
    polished = witness_of(chosen.name, chosen.says, model, task.database, task.offered)
    before, after = (ORDER.index(judge_alone(w, task.is_ordered).grade) for w in (chosen, polished))
    if after > before:
        say("The final bundle adjustment makes the evidence worse: left out.", "yellow")
    else:
        chosen = polished
    verdict = judge_together(chosen, others, task.is_ordered)
    beside = [f"{w.says}, {judge_alone(w, task.is_ordered).grade} by itself" for w in others]
    return chosen.model, "; beside it ".join([chosen.says, *beside]), verdict


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
            is_settled = bool(right) and all(d is not None and agrees(d) for d in differences)
    focals, is_part, failed = {}, len(task.placed) < len(task.offered), None
    if candidates and task.free.lens:
        best = best_first(candidates, task.is_ordered)[0].model
        focals = {n: c.mean_focal_length() for n, c in best.cameras.items()}
    attempts = 1 if is_settled and not is_part else len(ATTEMPTS)
    try:
        start = _start_from(task, "from-global", focals)
        model, says = reconstruct(task, start, attempts)
        candidates.append(witness_of("incremental", says, model, task.database, task.offered))
    except InputError as error:
        failed = error
    large = [w for w in candidates if len(w.images) >= NEARLY_ALL * len(task.offered)]
    if is_part and not any(judge_alone(w, task.is_ordered).grade == "right" for w in large):
        candidates += _globally([("global-all", focals)], task.offered, task)
    if failed and not candidates:
        raise failed
    return best_first(candidates, task.is_ordered)


def _starts(task: Task) -> dict[str, dict[int, float]]:
    """Focal lengths that the global mapper starts from, by name of the start and id of the camera: those of the
    database if they are known, else guesses. The first guess is the focal length for which the fundamental matrices of
    the pairs become essential ones, if they determine it (in a straight drive they do not). The others are fixed
    multiples of the image side."""
    with pycolmap.Database.open(task.database) as opened:
        unknown = [c for c in opened.read_all_cameras() if not c.has_prior_focal_length]
    if not task.free.lens or not unknown:
        return {"global": {}}
    guesses = {f"global-{ratio}": {c.camera_id: ratio * max(c.width, c.height) for c in unknown} for ratio in STARTS}
    calibrated_database = task.work / "calibrated.db"
    shutil.copyfile(task.database, calibrated_database)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = SEED
    options.reestimate_relative_pose = False  # only the focal lengths are taken
    with quiet():
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
                params = camera.params.copy()
                params[camera.focal_length_idxs()] = focals[camera.camera_id]
                camera.params = params
                opened.update_camera(camera)
    return database


def _globally(starts: Sequence[tuple[str, dict[int, float]]], names: Sequence[str], task: Task) -> list[Witness]:
    """Runs the global mapper on some images from all starts in parallel on all cores; failed starts are left out."""
    cores = task.threads if task.threads > 0 else os.cpu_count() or 1
    workers = min(cores, len(starts))

    def run(start: tuple[str, dict[int, float]]) -> pycolmap.Reconstruction | None:
        name, focals = start
        model = map_globally(task, name, _start_from(task, name, focals), names, max(1, cores // workers))
        advance()
        return model

    with (
        progress("Global mapping", len(starts)) as advance,
        quiet(),  # outermost: each mapper's own would end before the other is done
        ThreadPoolExecutor(workers) as pool,
    ):
        models = list(pool.map(run, starts))
    candidates = []
    for (name, _), model in zip(starts, models, strict=True):
        if model is None:
            say(f"Mapping, {name}: no model.")
            continue
        focal = ", ".join(f"{c.mean_focal_length():.1f}" for _, c in sorted(model.cameras.items())[:3])
        error = model.compute_mean_reprojection_error()
        says = f"{model.num_reg_images()} of {len(names)} images, {error:.2f} px, focal length {focal} px"
        witness = witness_of("global", f"{name} ({says})", model, task.database, task.offered)
        if share(witness.pairs.tracked, witness.pairs.matches) < LEAST_POINTS:
            says += "; left out, as hardly any match became a point"
        else:
            candidates.append(witness)
        say(f"Mapping, {name}: {says}.")
    return candidates
