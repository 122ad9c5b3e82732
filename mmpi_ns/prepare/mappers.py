"""Runs both mappers on one database and chooses between them."""

from __future__ import annotations

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
from mmpi_ns.prepare.polish import Free, polish
from mmpi_ns.prepare.stages import PrepareError, progress, say
from mmpi_ns.prepare.verdict import ORDER, Verdict, agrees, judge_alone, judge_together, rank

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


def map_and_judge(
    database: Path,
    images: Path,
    work: Path,
    offered: Sequence[str],
    *,
    free: Free,
    threads: int,
    is_sequence: bool,
    is_ordered: bool,
) -> Believed:
    """Runs the global mapper, then the incremental one from the focal length found, and chooses by the evidence.

    The chosen model is adjusted once more (``polish``), unless that makes the evidence worse.

    Args:
        database: features and verified matches.
        images: folder of the images.
        work: folder for databases, models and snapshots; holds those of an interrupted run.
        offered: names of all images, in order.
        free: what may be refined of the intrinsics.
        threads: CPU threads; below 1 for all.
        is_sequence: matched as a sequence: the incremental mapper begins with settings for forward motion.
        is_ordered: the images come in the order of the motion, so that breaks between neighbours can be looked for.

    Raises:
        PrepareError: neither mapper makes a model.
    """
    fixed = not free.lens
    starts = _starts(database, work, fixed)
    found = _globally(starts[:2], images, work, offered, fixed, threads)
    settled = _settled(found, is_ordered)
    if len(starts) > 2 and not settled:
        found += _globally(starts[2:], images, work, offered, fixed, threads)
        settled = _settled(found, is_ordered)
    found = sorted(found, key=lambda c: rank(c.witness, is_ordered), reverse=True)
    start = database
    if found and not fixed:
        start = work / "from-global.db"
        start_from(database, start, {c.camera_id: c.mean_focal_length() for c in found[0].model.cameras.values()})
    try:
        attempts = 1 if settled else len(ATTEMPTS)
        one = reconstruct(start, images, work / "incremental", not fixed, threads, is_sequence, attempts)
        witness = witness_of("incremental", one.model, database, offered)
        tried = ", ".join(f"{name} {size}" for name, size in one.tried)
        found.append(Candidate(one.model, witness, f"incremental, '{one.attempt}' settings ({tried})"))
    except PrepareError:
        if not found:
            raise
    chosen, verdict, says = _choose(found, is_ordered)
    polished = polish(chosen.model, free, threads)
    grade = judge_alone(witness_of("polished", polished, database, offered), is_ordered).grade
    if ORDER.index(grade) > ORDER.index(judge_alone(chosen.witness, is_ordered).grade):
        say("The final bundle adjustment makes the evidence worse: left out.", "yellow")
        polished = chosen.model
    return Believed(polished, verdict, says)


def _settled(found: Sequence[Candidate], is_ordered: bool) -> bool:
    """Whether the global mapper is right by its own evidence, with the same result from all starts for which it is."""
    right = [c.witness for c in found if judge_alone(c.witness, is_ordered).grade == "right"]
    differences = [agreement(right[0], w) for w in right[1:]]
    return bool(right) and all(d is not None and agrees(d) for d in differences)


def _starts(database: Path, work: Path, fixed: bool) -> list[tuple[str, Path]]:
    """Databases for the global mapper, by name: unchanged if the focal length is known, else one for each guess.

    The first guess comes from the fundamental matrices of the pairs, if they determine it (in a straight drive they
    do not); the others are fixed multiples of the image side.
    """
    with pycolmap.Database.open(database) as opened:
        unknown = [c for c in opened.read_all_cameras() if not c.has_prior_focal_length]
    if fixed or not unknown:
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


def _globally(
    starts: Sequence[tuple[str, Path]], images: Path, work: Path, offered: Sequence[str], fixed: bool, threads: int
) -> list[Candidate]:
    """Runs the global mapper from all starts in parallel on all cores; failed starts are left out."""
    cores = threads if threads > 0 else os.cpu_count() or 1
    workers = min(cores, len(starts))

    def run(start: tuple[str, Path]) -> tuple[pycolmap.Reconstruction, Path] | None:
        name, path = start
        made = map_globally(path, images, work / name, not fixed, max(1, cores // workers))
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
        witness = witness_of("global", model, path, offered)
        focal = ", ".join(f"{c.mean_focal_length():.1f}" for _, c in sorted(model.cameras.items())[:3])
        says = f"{model.num_reg_images()} of {len(offered)} images, {witness.error:.2f} px, focal length {focal} px"
        say(f"Mapping, {name}: {says}.")
        found.append(Candidate(model, witness, f"{name} ({says})"))
    return found


def _choose(found: Sequence[Candidate], is_ordered: bool) -> tuple[Candidate, Verdict, str]:
    """The candidate preferred by the evidence, compared with the others, and all of them in words."""
    chosen, *others = sorted(found, key=lambda c: rank(c.witness, is_ordered), reverse=True)
    verdict = judge_together(chosen.witness, [c.witness for c in others], is_ordered)
    beside = [f"{c.says}, {judge_alone(c.witness, is_ordered).grade} by itself" for c in others]
    return chosen, verdict, "; beside it ".join([chosen.says, *beside])
