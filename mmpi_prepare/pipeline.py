"""Input to scene: the stages in order."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from filelock import FileLock, Timeout
from scipy.cluster.hierarchy import DisjointSet

from mmpi_ns.utils.errors import InputError, log, progress, quoted
from mmpi_ns.utils.files import whole, write_text
from mmpi_prepare import checks, export, features, images, panoramas
from mmpi_prepare.adjustment import camera_poses, choose_frame, focal_interval, keeps_focals, map_given_poses
from mmpi_prepare.depths import find_depths, metres_of, write_depths
from mmpi_prepare.gps import Fit, find_fit
from mmpi_prepare.images import Photo, in_short, select_frames, sharpness
from mmpi_prepare.mapping import Task, map_and_judge
from mmpi_prepare.poses import agreeing, make_cameras, opencv_camera, read_poses
from mmpi_prepare.settings import Settings, check
from mmpi_prepare.verdict import Verdict, remedy
from mmpi_priors.sfm import load_pycolmap, match_pairs, new_model, quiet, rigid3d
from mmpi_priors.tracks import near_pairs

WORK = ".prepare"
WORDS = {"features": "features", "matches": "matching", "model": "mapping"}
"""The stages in words, for the times in the report; the others read."""
LEAST_IMAGES = 3
"""Minimum number of images; COLMAP's mappers make no smaller model."""
LEAST_SHARE = 0.5
"""Share of the images that must be registered, unless --allow-partial."""


class Preparation:
    """A run of mmpi-prepare in stages. The work folder has a folder for each stage, also those of an interrupted run.

    A stage is valid while its own settings and those of all earlier ones are unchanged, and is skipped if it was
    finished; the first changed stage and all later ones are emptied. An interrupted stage continues from its own
    partial output.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.work = settings.scene / WORK
        self.image_folder = self.work / "input" / "images"
        self.times: dict[str, float] = {}
        self.key = ""

    def run(self) -> Verdict:
        """Runs all stages. Returns the verdict on the scene."""
        s = self.settings
        self._read()
        source = [[c.summary() for c in self.cameras], self.numbers, s.max_features, bool(self.masks)]
        cameras = self.numbers, self.cameras
        how = self.image_folder, self.photos, cameras, self.masks, s.max_features, s.threads
        folder, _ = self._stage("features", source, partial(features.extract, *how))
        poses = {n: p.tolist() for n, p in self.given_poses.poses.items()} if self.given_poses else None
        source = [s.matching, s.overlap, poses]
        folder, self.matching = self._stage("matches", source, partial(self._match, folder / features.DATABASE))
        log(f"Matching: {self.matching}.")
        names = [p.name for p in self.photos]
        self.is_ordered = self.is_video or features.are_in_order(folder / features.DATABASE, names)
        source = [s.poses_axes, s.refine_poses, s.refine_intrinsics, s.lens, self.is_fixed, s.camera is None]
        folder, self.mapped = self._stage("model", source, partial(self._map, folder / features.DATABASE))
        model, verdict = pycolmap.Reconstruction(folder / "model"), Verdict(**self.mapped["verdict"])
        count, total = model.num_reg_images(), len(self.photos)
        if count < LEAST_SHARE * total and not s.allow_partial:
            groups = "".join(f" Another group of {len(g)}: {in_short(g)}." for g in self.mapped["groups"])
            raise InputError(
                f"Only {count} of {total} images could be registered: {in_short(camera_poses(model)[0])}."
                f"{groups} The groups need images that connect them. For a scene of the {count} alone: "
                "--allow-partial. What was found so far is kept, and a new run goes on from it."
            )
        if verdict.grade == "broken" and not s.allow_doubtful:
            raise InputError(
                f"The track that was found is wrong, so no scene was made. {verdict.summary} {self._remedy()} "
                "To look at it all the same: --allow-doubtful."
            )
        return self._write(model, verdict)

    def _remedy(self) -> str:
        return remedy(len(self.cameras), self.is_video or self.matching.startswith("sequential"), self.is_fixed)

    def _stage(self, name: str, settings: Any, make: Callable[[Path], Any]) -> tuple[Path, Any]:
        """A stage's own folder, and the JSON that ``make``, which fills the folder, returned now or before: by these
        settings, which are all that it depends on besides the earlier stages."""
        text = self.key + name + json.dumps(settings, sort_keys=True, default=str)
        self.key = hashlib.sha256(text.encode()).hexdigest()
        folder, stamp, start = self.work / name, self.work / f"{name}.json", time.monotonic()
        try:
            state = json.loads(stamp.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            state = {}  # missing or truncated: the stage starts over
        if state.get("key") != self.key:
            shutil.rmtree(folder, ignore_errors=True)
            state = {"key": self.key}
            write_text(stamp, json.dumps(state))
        if "result" in state:
            log(f"{name}: done before", "dim")
        else:
            folder.mkdir(exist_ok=True)
            state["result"] = make(folder)
            write_text(stamp, json.dumps(state))
        words = WORDS.get(name, "reading")
        self.times[words] = self.times.get(words, 0.0) + time.monotonic() - start
        return folder, state["result"]

    def _read(self) -> None:
        """Images, masks and given poses; their cameras, and whether intrinsics are kept."""
        s = self.settings
        self.is_video = s.input.is_file()
        if self.is_video and s.input.suffix.lower() not in images.VIDEOS:
            raise InputError(f"{s.input} is neither a folder nor a video ({', '.join(images.VIDEOS)}).")
        files = [s.input] if self.is_video else images.find_images(s.input)
        source = [(str(p), p.stat().st_size, p.stat().st_mtime) for p in files]
        source = [*source[0], s.max_frames, s.frame_motion] if self.is_video else source
        read = partial(images.gather, s.input, files)
        if self.is_video:
            read = partial(select_frames, s.input, max_frames=s.max_frames, step=s.frame_motion)
        _, entries = self._stage("input", source, lambda folder: [asdict(photo) for photo in read(folder)])
        self.photos = [Photo(**entry) for entry in entries]
        self.masks = None
        if s.masks is not None:
            stamps = [(str(p), p.stat().st_mtime) for p in sorted(s.masks.rglob("*"))]
            self.masks, _ = self._stage("masks", stamps, partial(images.gather_masks, s.masks, self.photos))
        how = self.image_folder, self.photos, self.masks
        folder, faces = self._stage("faces", [], lambda folder: [asdict(p) for p in panoramas.cut(*how, folder)])
        self.panoramas = len(self.photos) if faces else 0
        if faces:
            panoramas.check(s)
            self.photos, self.image_folder = [Photo(**face) for face in faces], folder / "images"
            self.settings = s = replace(s, camera=(self.photos[0].width / 2,) * 3)
            self.masks, self.is_video = folder / "masks" if self.masks else None, False
        self.depths = find_depths(s.depths, self.photos) if s.depths is not None else {}
        self.photos = [p for p in self.photos if not self.depths or p.name in self.depths]
        self.given_poses = read_poses(s.poses, s.poses_axes, self.photos) if s.poses else None
        count = self.panoramas or len(self.photos)
        if self.given_poses is None and count < LEAST_IMAGES:
            raise InputError(
                f"Poses cannot be found for {count} images alone, as no third confirms them: take more "
                "(better twenty), or give known poses (--poses)."
            )
        # What is impossible is refused before the work.
        self._split([p.name for p in self.photos])
        smallest = min(self.photos, key=lambda p: min(p.width, p.height))
        for factor in s.downscales:
            if factor > min(smallest.width, smallest.height):
                raise InputError(f"--downscales {factor} leaves no pixel of {smallest.name}: give smaller factors.")
        lenses = self.given_poses.intrinsics if self.given_poses else {}
        if s.camera is not None:
            numbers = (s.camera[0], *s.camera) if len(s.camera) == 3 else s.camera
            lenses = dict.fromkeys((p.name for p in self.photos), opencv_camera(numbers, s.lens == "fisheye"))
        elif s.focal is not None:
            lenses = {}
        self.numbers, self.cameras = make_cameras(self.photos, s.intrinsics, lenses, s.focal, s.lens)
        is_given = bool(lenses) or s.focal is not None
        if self.given_poses is not None and not is_given and not all(p.exif_focal for p in self.photos):
            raise InputError("Known poses need the intrinsics they were made with: give --focal or --camera.")
        if s.refine_intrinsics and any(c.model.name == "FULL_OPENCV" for c in self.cameras):
            raise InputError(f"--refine-intrinsics refines no lens with a k3, as in {s.poses}: leave one of them out.")
        self.is_fixed = (is_given or self.given_poses is not None) and not s.refine_intrinsics

    def _match(self, unmatched: Path, folder: Path) -> str:
        """Makes the database with verified matches. Returns a summary of the matched pairs."""
        s, database, names = self.settings, folder / features.DATABASE, [p.name for p in self.photos]
        if not database.exists():
            with whole(database) as unfinished:
                shutil.copyfile(unmatched, unfinished)
                if self.panoramas:
                    panoramas.join(unfinished)
        if self.given_poses is not None and s.matching == "auto":
            places = [i for i, n in enumerate(names) if n in self.given_poses.poses]
            poses = np.array([self.given_poses.poses[names[i]] for i in places])  # OpenCV axes
            # Poses that are wrong name wrong neighbours: the next images are evidence beside them.
            near = {*near_pairs(poses[:, :3], 2 * s.overlap), *((i, i + 1) for i in range(len(places) - 1))}
            pairs = sorted((places[i], places[j]) for i, j in near)
            summary = f"the {2 * s.overlap} nearest by pose, and the next"
        else:
            alike = features.image_similarity(database, len(names))
            pairs, summary = features.choose_pairs(s.matching, names, alike, s.overlap, self.is_video)
        if self.panoramas:  # faces of one panorama have nothing in common
            pairs = [(i, j) for i, j in pairs if (j - i) % self.panoramas]
        with progress("Matching pairs", len(pairs)) as advance:
            for start in range(0, len(pairs), features.PAIR_BATCH):  # but for those matched before
                batch = [(names[i], names[j]) for i, j in pairs[start : start + features.PAIR_BATCH]]
                match_pairs(database, batch, threads=s.threads)
                advance(len(batch))
        return f"{summary}; {len(features.matching_pairs(database))} of {len(pairs)} pairs match"

    def _map(self, database: Path, folder: Path) -> dict[str, Any]:
        """Makes the model. Returns a summary, the verdict, the interval of a refined focal length, and groups of at
        least three images without a pose that verified matches connect, the largest first."""
        s, names = self.settings, [p.name for p in self.photos]
        verdict, groups, focal = Verdict("right"), [], None
        if self.given_poses is not None:
            known = self.given_poses
            for is_last in (s.poses_axes != "auto", True):
                poses = {n: rigid3d(p) for n, p in known.poses.items()}
                model = new_model(self.cameras, names, self.numbers, poses)
                if is_last:
                    break
                known = agreeing(known, model, database)
            refine = not self.is_fixed and s.refine_intrinsics
            model, summary = map_given_poses(model, database, self.image_folder, s.refine_poses, refine, s.threads)
            summary = f"{known.summary}; {summary}"
        else:
            lens, is_sequence = not self.is_fixed, self.matching.startswith("sequential")
            free = lens, lens and s.lens == "auto", s.camera is None or s.refine_intrinsics
            model, summary, verdict = map_and_judge(
                Task(database, self.image_folder, folder, names, *free, s.threads, is_sequence, self.is_ordered)
            )
            lost = sorted(set(range(1, len(names) + 1)) - set(model.reg_image_ids()))
            connected = DisjointSet(lost)
            for first, second in features.matching_pairs(database):
                if first in connected and second in connected:
                    connected.merge(first, second)
            subsets = sorted((sorted(group) for group in connected.subsets() if len(group) > 2), key=len, reverse=True)
            groups = [[names[i - 1] for i in group] for group in subsets]
        (folder / "model").mkdir(exist_ok=True)
        model.write(folder / "model")
        if not self.is_fixed:
            with progress("Checking the focal length", 1) as advance:
                focal = focal_interval(model, s.threads)
                advance()
        return {"summary": summary, "verdict": asdict(verdict), "focal": focal, "groups": groups}

    def _write(self, model: pycolmap.Reconstruction, verdict: Verdict) -> Verdict:
        """Moves the model into the scene's frame and writes the scene; the verdict, with the findings of the checks."""
        s, summary = self.settings, self.mapped["summary"]
        focal = self.mapped["focal"][1] if self.mapped["focal"] else "given"
        if self.mapped["focal"] and keeps_focals(model, self.cameras):
            focal = f"that of EXIF kept; by the images alone {focal}"
        up = unit = "that of the given poses"
        metres, scale_note = metres_of(model, self.depths) if self.depths else (1.0, "not given")
        scale = 1.0
        if self.given_poses is None or s.camera_height is not None:
            names, poses = camera_poses(model)
            places = {p.name: p.place for p in self.photos}
            fit = Fit(metres, None, scale_note) if self.depths else None
            if s.camera_height is None and not self.depths:
                fit = find_fit(poses, [places[n] for n in names])
            similarity, up, unit = choose_frame(model, s.camera_height, fit)
            scale = similarity.scale
            model.transform(similarity)
        names = set(camera_poses(model)[0])
        photos = [p for p in self.photos if p.name in names]
        split = self._split([p.name for p in photos])
        built = self.work / "scene"
        shutil.rmtree(built, ignore_errors=True)
        findings, masks, moves = self._check(model, photos, split, built)
        grave = [f"{f.summary[:1].upper()}{f.summary[1:]}." for f in findings if f.is_grave]
        if grave and self.given_poses is None and verdict.grade == "right":
            verdict = Verdict("doubtful", " ".join(grave))
        export.write_images(self.image_folder, masks, photos, built, s.downscales)
        depths = write_depths(self.depths, photos, scale / metres, built, s.downscales) if self.depths else {}
        if depths:
            log(f"Depths: {scale_note}; a metre is {scale / metres:.4g} units of the scene.")
        notes = {"unit": unit, "up": up, "mapping": summary, "matching": self.matching}
        (built / "colmap/sparse/0").mkdir(parents=True)
        model.write(built / "colmap/sparse/0")
        model.export_PLY(built / "sparse_pc.ply")
        content = export.transforms(model, split, bool(masks), depths, notes)
        write_text(built / "transforms.json", json.dumps(content, indent=1))
        rows = {
            "images registered": f"{len(photos)} of {len(self.photos)}",
            "matching": self.matching,
            "mapping": summary,
            "verdict": f"{verdict.grade} {verdict.summary}".strip(),
            "focal length": focal,
            "what moves": moves,
            "depths": scale_note,
            "up": up,
            "unit": unit,
            "split": f"{len(split.train)} train, {len(split.test)} test: {split.summary}",
            "times": ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.times.items()),
        }
        intrinsics = "given and kept" if self.is_fixed else "refined"
        note = f"Intrinsics {intrinsics}; {len(self.cameras)} camera(s)."
        groups = self.mapped["groups"]
        lost = [p.name for p in self.photos if p.name not in names.union(*groups)]
        apart = "images form a group of their own, not connected to the scene"
        left_out = [f"{len(lost)} images have no pose and are left out: {in_short(lost, 8)}"] if lost else []
        left_out += [f"{len(group)} {apart}: {in_short(group, 8)}" for group in groups]
        checks.write_report(model, s.input.name, rows, findings, left_out, note, built)
        self._publish([*left_out, *checks.by_kind(findings)], model, verdict, split)
        return verdict

    def _split(self, names: Sequence[str]) -> export.Split:
        s = self.settings
        if self.given_poses is not None and self.given_poses.split and s.test_every is None:
            return export.split_images(names, lists=self.given_poses.split, source=f"{s.poses}")
        split = panoramas.split_panoramas if self.panoramas else export.split_images
        return split(names, s.test_every)

    def _check(
        self, model: pycolmap.Reconstruction, photos: Sequence[Photo], split: export.Split, built: Path
    ) -> tuple[list[checks.Finding], Path | None, str]:
        """Findings on the scene to be built; the folder of its masks, given or of moving objects; a summary of
        these."""
        s, names, sharp = self.settings, [p.name for p in photos], np.zeros(len(photos))
        focal = None if keeps_focals(model, self.cameras) else self.mapped["focal"]
        findings = checks.doubtful_intrinsics(model, self.is_fixed, focal, s.threads)
        with progress("Checking images", len(names)) as advance:
            for i, name in enumerate(names):
                gray = cv2.imread(str(self.image_folder / name), cv2.IMREAD_GRAYSCALE)
                if gray is None:
                    raise InputError(f"{name} cannot be read: repair or remove it.")
                sharp[i] = sharpness(gray)  # type: ignore[arg-type]
                advance(1)
        if self.is_ordered:
            findings += checks.blurred(names, sharp)
            order, poses = camera_poses(model)
            offered = [p.name for p in self.photos]
            findings += checks.misplaced(order, [offered.index(n) for n in order], poses)
        if s.moving == "keep" or self.masks is not None:
            return findings, self.masks, "masks given" if self.masks else "not looked for"
        from mmpi_prepare.moving import write_masks  # imports nerfstudio, which takes seconds

        target, picture = self.work / "moving", built / "report" / "moving.jpg"
        moves, doubt = write_masks(model, photos, split.train, self.image_folder, target, picture, s.threads)
        findings += [checks.Finding("moving?", "", doubt)] if doubt else []
        if not moves:
            return findings, None, "not known" if doubt else "nothing is seen to move"
        moving = sum(moves.values()) / len(split.train)
        summary = f"{moving:.1%} of the training pixels, in {len(moves)} of {len(split.train)} images, are masked"
        log(f"What moves: {summary}; report/moving.jpg shows them.")
        return findings, target, summary

    def _publish(
        self, warnings: Sequence[str], model: pycolmap.Reconstruction, verdict: Verdict, split: export.Split
    ) -> None:
        """Moves the scene into place and reports the result; doubtful ones in red."""
        scene = self.settings.scene
        aside = scene / next(f"previous-{i}" for i in range(1, 10_000) if not (scene / f"previous-{i}").exists())
        export.publish(self.work / "scene", scene, aside)
        if aside.exists():
            log(f"What {scene} held is in {aside}.")
        if not self.settings.keep_work:
            shutil.rmtree(self.work)
        for line in warnings:
            log(line, "yellow")
        is_right = verdict.grade == "right"
        if not is_right:
            log(f"This scene is {verdict.grade}: {verdict.summary} {self._remedy()}", "bold red")
        log(
            f"{scene}: {model.num_reg_images()} images, {model.compute_mean_reprojection_error():.2f} px, "
            f"{len(split.train)} train, {len(split.test)} test; report.md says more. Train with:",
            "bold red" if not is_right else "" if warnings else "green",
        )
        log(f"ns-train mmpi --data {quoted(scene)}")


@contextmanager
def only_one(work: Path) -> Iterator[None]:
    """Locks a work folder against a second run. Raises InputError if one is at work there, or a file cannot be used."""
    try:
        work.mkdir(parents=True, exist_ok=True)
        with FileLock(work / "lock", blocking=False):
            yield
    except Timeout as error:
        raise InputError(f"Another mmpi-prepare is making {work.parent}: wait for it, or name another.") from error
    except InputError:
        raise
    except OSError as error:
        what = f"{error.filename or work} cannot be read or written ({error.strerror or error})"
        raise InputError(f"{what}: check path and disk.") from error


def prepare(s: Settings) -> Verdict:
    """Makes the scene. Returns the verdict on it.

    Before any work it raises InputError if an option is out of range, contradicts another or names no file, the input
    is missing, or files in the scene's folder would be lost; later, if the input cannot be made into a scene.
    """
    load_pycolmap()  # in a version that is new enough
    check(s)
    source, scene = s.input.resolve(), s.scene.resolve()
    taken = export.existing_parts(scene)
    if scene == source or source in scene.parents or any((scene / part) in (source, *source.parents) for part in taken):
        raise InputError(f"The scene {s.scene} would be mixed with its input: name another folder.")
    if taken and not s.overwrite:
        raise InputError(
            f"{s.scene} already holds {', '.join(taken)}: name another folder, or give --overwrite (the old files are "
            "then moved aside)."
        )
    with only_one(s.scene / WORK), quiet():
        return Preparation(s).run()
