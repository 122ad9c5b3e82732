"""Runs both mappers on one database and chooses between them."""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from mmpi_ns.capture.matching import SEED, quiet
from mmpi_ns.prepare.collect import witness_of
from mmpi_ns.prepare.evidence import Witness, agreement
from mmpi_ns.prepare.focal import STARTS
from mmpi_ns.prepare.global_mapping import map_globally, start_from
from mmpi_ns.prepare.mapping import ATTEMPTS, reconstruct
from mmpi_ns.prepare.polish import Free, polish, with_all_points
from mmpi_ns.prepare.stages import PrepareError, progress, say
from mmpi_ns.prepare.verdict import NEARLY_ALL, ORDER, Grade, Verdict, agrees, best_first, judge_alone, judge_together

PLACED = 100
"""Images of a sequence that the global mapper places at least, if there are so many."""
NEAR = 0.1
"""Relative difference below which two initial focal lengths count as the same."""


@dataclass(frozen=True)
class Candidate:
    """A mapper's model and the evidence on it."""

    model: pycolmap.Reconstruction
    witness: Witness
    says: str


@dataclass(frozen=True)
class Believed:
    """The model to use."""

    model: pycolmap.Reconstruction
    verdict: Verdict
    says: str
    """Both mappers in words."""


@dataclass(frozen=True)
class Task:
    """What is to be mapped, and where."""

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
    """Matched as a sequence: the incremental mapper begins with settings for forward motion."""
    is_ordered: bool
    """The images come in the order of the motion, so that breaks between neighbours can be looked for."""

    @property
    def placed(self) -> Sequence[str]:
        """Names of the images that the global mapper places first: of a long sequence every second, third and so on.

        That is enough to find the focal length and to confirm the incremental mapper's track, in a part of the time.
        """
        return self.offered[:: max(1, len(self.offered) // PLACED)] if self.is_ordered else self.offered


def map_and_judge(task: Task) -> Believed:
    """Runs the global mapper, then the incremental one from the focal length found, and chooses by the evidence.

    The chosen model is given all points and adjusted (``polish``), unless that makes the evidence worse.

    Raises:
        PrepareError: neither mapper makes a model.
    """
    found = _candidates(task)
    chosen, *others = _best_first(found, task)
    with progress("Adding points", 1) as advance:
        model = copy.deepcopy(chosen.model)
        model = with_all_points(model, task.database, task.images, task.free.lens, task.threads)
        advance()
    model = polish(model, task.free, task.threads)
    polished = Candidate(model, witness_of(chosen.witness.name, model, task.database, task.offered), chosen.says)
    if ORDER.index(_grade(polished, task)) > ORDER.index(_grade(chosen, task)):
        say("The final bundle adjustment makes the evidence worse: left out.", "yellow")
    else:
        chosen = polished
    verdict = judge_together(chosen.witness, [c.witness for c in others], task.is_ordered)
    beside = [f"{c.says}, {_grade(c, task)} by itself" for c in others]
    return Believed(chosen.model, verdict, "; beside it ".join([chosen.says, *beside]))


def _candidates(task: Task) -> list[Candidate]:
    """The models of both mappers, of the global one from several focal lengths.

    Where the global mapper has placed a part of a long sequence, it places all images if the incremental one fails.
    """
    starts = _starts(task)
    found = _globally(starts[:2], task.placed, task)
    settled = _settled(found, task)
    if len(starts) > 2 and not settled:
        found += _globally(starts[2:], task.placed, task)
        settled = _settled(found, task)
    found = _best_first(found, task)
    start, is_part = task.database, len(task.placed) < len(task.offered)
    if found and task.free.lens:
        start = task.work / "from-global.db"
        start_from(task.database, start, {n: c.mean_focal_length() for n, c in found[0].model.cameras.items()})
    failed: PrepareError | None = None
    try:
        found.append(_incrementally(start, 1 if settled and not is_part else len(ATTEMPTS), task))
    except PrepareError as error:
        failed = error
    if is_part and not any(_is_whole(c, task) for c in found):
        found += _globally([("global-all", start)], task.offered, task)
    if failed and not found:
        raise failed
    return found


def _is_whole(candidate: Candidate, task: Task) -> bool:
    """Whether a model is right by its own evidence and has nearly all images."""
    return len(candidate.witness.images) >= NEARLY_ALL * len(task.offered) and _grade(candidate, task) == "right"


def _incrementally(start: Path, attempts: int, task: Task) -> Candidate:
    """The incremental mapper's model, from the cameras of a database."""
    work, refine = task.work / "incremental", task.free.lens
    made = reconstruct(start, task.images, work, refine, task.threads, task.is_sequence, attempts)
    witness = witness_of("incremental", made.model, task.database, task.offered)
    tried = ", ".join(f"{name} {size}" for name, size in made.tried)
    return Candidate(made.model, witness, f"incremental, '{made.attempt}' settings ({tried})")


def _grade(candidate: Candidate, task: Task) -> Grade:
    return judge_alone(candidate.witness, task.is_ordered).grade


def _best_first(found: Sequence[Candidate], task: Task) -> list[Candidate]:
    return [found[i] for i in best_first([c.witness for c in found], task.is_ordered)]


def _settled(found: Sequence[Candidate], task: Task) -> bool:
    """Whether the global mapper is right by its own evidence, with the same result from all starts for which it is."""
    right = [c.witness for c in found if _grade(c, task) == "right"]
    differences = [agreement(right[0], w) for w in right[1:]]
    return bool(right) and all(d is not None and agrees(d) for d in differences)


def _starts(task: Task) -> list[tuple[str, Path]]:
    """Databases for the global mapper, by name: unchanged if the focal length is known, else one for each guess.

    The first guess comes from the fundamental matrices of the pairs, if they determine it (in a straight drive they
    do not); the others are fixed multiples of the image side.
    """
    database, work = task.database, task.work
    with pycolmap.Database.open(database) as opened:
        unknown = [c for c in opened.read_all_cameras() if not c.has_prior_focal_length]
    if not task.free.lens or not unknown:
        return [("global", database)]
    guesses = {f"global-{ratio}": {c.camera_id: ratio * max(c.width, c.height) for c in unknown} for ratio in STARTS}
    calibrated = _calibrated(database, work / "calibrated.db")
    if all(abs(calibrated[n] / focal - 1) > NEAR for guess in guesses.values() for n, focal in guess.items()):
        guesses = {"global-calibrated": {c.camera_id: calibrated[c.camera_id] for c in unknown}} | guesses
    for name, focals in guesses.items():
        if not (work / name / "done").exists():
            start_from(database, work / f"{name}.db", focals)
    return [(name, work / f"{name}.db") for name in guesses]


def _calibrated(database: Path, copy: Path) -> dict[int, float]:
    """Focal lengths, by camera, for which the fundamental matrices of the pairs become essential matrices."""
    shutil.copyfile(database, copy)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = SEED
    options.reestimate_relative_pose = False  # only the focal lengths are taken
    with quiet():
        pycolmap.calibrate_view_graph(copy, options)
    with pycolmap.Database.open(copy) as opened:
        focals = {c.camera_id: c.mean_focal_length() for c in opened.read_all_cameras()}
    copy.unlink()
    return focals


def _globally(starts: Sequence[tuple[str, Path]], names: Sequence[str], task: Task) -> list[Candidate]:
    """Runs the global mapper on some images from all starts in parallel on all cores; failed starts are left out."""
    cores = task.threads if task.threads > 0 else os.cpu_count() or 1
    workers = min(cores, len(starts))

    def run(start: tuple[str, Path]) -> tuple[pycolmap.Reconstruction, Path] | None:
        name, path = start
        refine, threads = task.free.lens, max(1, cores // workers)
        made = map_globally(path, task.images, task.work / name, names, refine, threads)
        advance()
        return made

    with (
        progress("Global mapping", len(starts)) as advance,
        quiet(),  # outermost: each mapper's own would end before the other is done
        ThreadPoolExecutor(workers) as pool,
    ):
        results = list(pool.map(run, starts))
    found = []
    for (name, path), made in zip(starts, results, strict=True):
        if not made:
            say(f"Mapping, {name}: no model.")
            continue
        model, _ = made
        witness = witness_of("global", model, path, task.offered)
        focal = ", ".join(f"{c.mean_focal_length():.1f}" for _, c in sorted(model.cameras.items())[:3])
        says = f"{model.num_reg_images()} of {len(names)} images, {witness.error:.2f} px, focal length {focal} px"
        say(f"Mapping, {name}: {says}.")
        found.append(Candidate(model, witness, f"{name} ({says})"))
    return found
