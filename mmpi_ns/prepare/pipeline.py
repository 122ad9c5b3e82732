"""Input to scene: the stages in order."""

from __future__ import annotations

import json
import shlex
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.sfm import load_pycolmap
from mmpi_ns.capture.tracks import near_pairs
from mmpi_ns.prepare import checks, export, features, images, pairs, report
from mmpi_ns.prepare.cameras import Intrinsics, make_cameras, parse_camera, share
from mmpi_ns.prepare.focal import WIDE, focal_in_words, focal_interval
from mmpi_ns.prepare.frame import SceneFrame, camera_poses, choose_frame
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.known import solve_known
from mmpi_ns.prepare.mappers import Task, map_and_judge
from mmpi_ns.prepare.polish import Free
from mmpi_ns.prepare.poses import read_poses, rigid3d
from mmpi_ns.prepare.settings import Settings, check_options, read_lists
from mmpi_ns.prepare.stages import PrepareError, Stages, only_one, progress, say, whole
from mmpi_ns.prepare.undistort import undistort
from mmpi_ns.prepare.verdict import REMEDY, Verdict
from mmpi_ns.prepare.video import select_frames

WORK = ".prepare"
LEAST_SHARE = 0.5
"""Share of the images that must be registered, unless --allow-partial."""


@dataclass
class Solved:
    """Poses and points, and how they were found."""

    model: pycolmap.Reconstruction
    mapping: str
    groups: list[list[str]] = field(default_factory=list)
    verdict: Verdict = field(default_factory=lambda: Verdict("right"))
    focal: tuple[float, float] | None = None
    """The interval of the focal length in pixels, where it was refined."""


class Preparation:
    """One run of mmpi-prepare; the work folder holds what an interrupted one left."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.work = settings.scene / WORK
        self.times: dict[str, float] = {}
        self.notes: list[str] = []
        self.stages = Stages(self.work)

    def run(self) -> Verdict:
        """Input to scene; how far it can be believed."""
        s = self.settings
        with self._timed("reading"):
            self.photos = self._read_input()
            self.masks = self._read_masks()
            self.known = read_poses(s.poses, s.poses_format, s.poses_axes, self.photos) if s.poses else None
            self._split([p.name for p in self.photos])  # refuse a split that is impossible before the work
        self.is_fixed = self._set_cameras()
        with self._timed("features"):
            database = self._features()
        with self._timed("matching"):
            database = self._matches(database)
        with self._timed("mapping"):
            solved = self._solve(database)
        scene_frame = self._move(solved.model)
        self._check_share(solved)
        self._check_verdict(solved.verdict)
        with self._timed("writing"):
            self._write(solved, scene_frame, database)
        return solved.verdict

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.times[name] = self.times.get(name, 0.0) + time.monotonic() - start

    def _read_input(self) -> list[Photo]:
        s = self.settings
        self.is_video = s.input.is_file()
        if self.is_video:
            if s.input.suffix.lower() not in images.VIDEOS:
                raise PrepareError(f"{s.input} is neither a folder nor a video ({', '.join(images.VIDEOS)}).")
            made_from = [str(s.input), s.input.stat().st_size, s.input.stat().st_mtime, s.max_frames, s.frame_motion]
            return self.stages.run(
                "input",
                made_from,
                lambda folder: select_frames(s.input, folder, s.max_frames, s.frame_motion),
                images.read_photos,
            )
        files = images.find_images(s.input)
        made_from = [(str(p), p.stat().st_size, p.stat().st_mtime) for p in files]
        return self.stages.run(
            "input", made_from, lambda folder: images.gather(s.input, files, folder), images.read_photos
        )

    def _read_masks(self) -> Path | None:
        folder = self.settings.masks
        if folder is None:
            return None
        made_from = [(str(p), p.stat().st_mtime) for p in sorted(folder.rglob("*"))] if folder.is_dir() else str(folder)
        self.stages.run(
            "masks", made_from, lambda target: images.gather_masks(folder, self.photos, target), lambda _: 0
        )
        return self.work / "masks"

    def _set_cameras(self) -> bool:
        """Numbers and cameras of the images; returns whether their intrinsics are to be kept."""
        s = self.settings
        given: dict[str, Intrinsics] = dict(self.known.intrinsics) if self.known else {}
        if s.camera is not None:
            camera = parse_camera(s.camera, s.lens == "fisheye")
            given = {p.name: camera for p in self.photos}
        elif s.focal is not None:
            given = {}
        self.numbers = share(self.photos, s.intrinsics, given)
        self.cameras = make_cameras(self.photos, self.numbers, given, s.focal, s.lens)
        is_given = bool(given) or s.focal is not None
        if self.known is not None and not is_given and not all(p.exif_focal for p in self.photos):
            raise PrepareError("Known poses need the intrinsics they were made with: give --focal or --camera.")
        return (is_given or self.known is not None) and not s.refine_intrinsics

    def _features(self) -> Path:
        s = self.settings

        def stage(folder: Path) -> Path:
            path = folder / "database.db"
            features.create_database(path, self.photos, self.numbers, self.cameras)
            features.extract(path, self.image_folder, self.photos, self.masks, s.max_features, s.threads)
            return path

        made_from = [[c.summary() for c in self.cameras], self.numbers, s.max_features, bool(self.masks)]
        return self.stages.run("features", made_from, stage, lambda folder: folder / "database.db")

    @property
    def is_ordered(self) -> bool:
        """Whether the images come in the order of the motion."""
        return self.is_video or pairs.are_numbered([p.name for p in self.photos])

    @property
    def image_folder(self) -> Path:
        return self.work / "input" / "images"

    def _matches(self, database: Path) -> Path:
        s = self.settings

        def stage(folder: Path) -> Path:
            path = folder / "database.db"
            if not path.exists():
                with whole(path) as partial:
                    shutil.copyfile(database, partial)
            wanted, says = self._pairs(path)
            verified = features.match(path, self.photos, wanted, s.threads)
            says = f"{says}; {verified} of {len(wanted)} pairs match"
            (folder / "says.txt").write_text(says, encoding="utf-8")
            return path

        poses = {n: p.tolist() for n, p in self.known.poses.items()} if self.known else None
        path = self.stages.run("matches", [s.matching, s.overlap, poses], stage, lambda folder: folder / "database.db")
        self.matching = (path.parent / "says.txt").read_text(encoding="utf-8")
        say(f"Matching: {self.matching}.")
        return path

    def _pairs(self, database: Path) -> tuple[pairs.Pairs, str]:
        s, names = self.settings, [p.name for p in self.photos]
        if self.known is not None and s.matching == "auto":
            places = [i for i, n in enumerate(names) if n in self.known.poses]
            poses = np.array([self.known.poses[names[i]] for i in places])  # OpenCV axes
            near = near_pairs(poses[:, :3, 3], poses[:, :3, 2], 2 * s.overlap)
            return [(places[i], places[j]) for i, j in near], f"the {2 * s.overlap} nearest by pose"
        alike = pairs.similarity(pairs.describe_images(database, len(names)))
        chosen, why = pairs.choose(s.matching, names, alike, self.is_video)
        listed = pairs.list_pairs(chosen, alike, s.overlap)
        loops = (
            f", {len(pairs.revisits(alike, s.overlap))} pairs that may be revisits" if chosen == "sequential" else ""
        )
        return listed, f"{chosen} ({why}){loops}"

    def _solve(self, database: Path) -> Solved:
        s = self.settings

        def stage(folder: Path) -> Solved:
            solved = self._known(database) if self.known else self._map(database, folder)
            (folder / "model").mkdir(exist_ok=True)
            solved.model.write(folder / "model")
            if not self.is_fixed:
                with progress("Checking the focal length", 1) as advance:
                    solved.focal = focal_interval(solved.model, s.threads)
                    advance()
            says = {"mapping": solved.mapping, "groups": solved.groups, "notes": self.notes, "focal": solved.focal}
            says |= {"grade": solved.verdict.grade, "reasons": solved.verdict.reasons}
            (folder / "says.json").write_text(json.dumps(says), encoding="utf-8")
            return solved

        def load(folder: Path) -> Solved:
            says = json.loads((folder / "says.json").read_text(encoding="utf-8"))
            self.notes = says["notes"]
            verdict = Verdict(says["grade"], tuple(says["reasons"]))
            model = pycolmap.Reconstruction(folder / "model")
            return Solved(model, says["mapping"], says["groups"], verdict, says["focal"])

        made_from = [s.refine_poses, s.refine_intrinsics, s.refine_principal_point, s.lens, self.is_fixed]
        return self.stages.run("model", made_from, stage, load)

    def _map(self, database: Path, folder: Path) -> Solved:
        s = self.settings
        names = [p.name for p in self.photos]
        lens, place = not self.is_fixed, s.camera is None or s.refine_intrinsics
        free = Free(lens, lens and s.lens == "auto", principal_point=place, always=s.refine_principal_point)
        task = Task(
            database, self.image_folder, folder, names, free, s.threads,
            is_sequence=self.matching.startswith("sequential"), is_ordered=self.is_ordered,
        )  # fmt: skip
        believed = map_and_judge(task)
        model = believed.model
        places = sorted(set(range(len(names))) - {i - 1 for i in model.reg_image_ids()})
        groups = [[names[i] for i in group] for group in features.connected(database, places)]
        return Solved(model, believed.says, groups, believed.verdict)

    def _known(self, database: Path) -> Solved:
        s = self.settings
        assert self.known is not None
        poses = {n: rigid3d(p) for n, p in self.known.poses.items()}
        model = features.empty_model(self.photos, self.numbers, self.cameras, poses)
        refine = not self.is_fixed and s.refine_intrinsics
        result = solve_known(model, database, self.image_folder, s.refine_poses, refine, s.threads)
        return Solved(result.model, f"{self.known.says}; {result.says}")

    def _move(self, model: pycolmap.Reconstruction) -> SceneFrame:
        if self.known is not None and self.settings.camera_height is None:
            return SceneFrame(pycolmap.Sim3d(), "that of the given poses", "that of the given poses")
        frame = choose_frame(model, self.settings.camera_height)
        model.transform(frame.similarity)
        return frame

    def _check_share(self, solved: Solved) -> None:
        count, total = solved.model.num_reg_images(), len(self.photos)
        if count >= LEAST_SHARE * total or self.settings.allow_partial:
            return
        groups = "".join(f" Another group of {len(g)}: {report.in_short(g, 4)}." for g in solved.groups)
        raise PrepareError(
            f"Only {count} of {total} images could be registered: {report.in_short(camera_poses(solved.model)[0], 4)}."
            f"{groups} The groups need images that connect them. For a scene of the {count} alone: --allow-partial. "
            "What was found so far is kept, and a new run goes on from it."
        )

    def _check_verdict(self, verdict: Verdict) -> None:
        if verdict.grade == "broken" and not self.settings.allow_doubtful:
            raise PrepareError(
                f"The track that was found is wrong, so no scene was made. {verdict.words()} {REMEDY} "
                "To look at it all the same: --allow-doubtful."
            )

    def _write(self, solved: Solved, frame: SceneFrame, database: Path) -> None:
        s, model = self.settings, solved.model
        names = set(camera_poses(model)[0])
        photos = [p for p in self.photos if p.name in names]
        split = self._split([p.name for p in photos])
        findings = [*_focal_findings(solved), *self._findings(model, photos, database)]
        grave = [f"{f.says[:1].upper()}{f.says[1:]}." for f in findings if f.is_grave]
        if grave and self.known is None and solved.verdict.grade == "right":
            solved.verdict = Verdict("doubtful", tuple(grave))
        folder, masks = self.image_folder, self.masks
        if s.undistort:
            flat = self.work / "undistorted"
            shutil.rmtree(flat, ignore_errors=True)
            model, photos = undistort(model, photos, folder, masks, flat, s.threads)
            folder, masks = flat / "images", flat / "masks" if masks else None
        built = self.work / "scene"
        shutil.rmtree(built, ignore_errors=True)
        export.write_images(folder, photos, built, s.downscales)
        if masks is not None:
            export.write_masks(masks, photos, built, s.downscales)
        notes = {"unit": frame.unit, "up": frame.up, "mapping": solved.mapping, "matching": self.matching}
        export.write_scene(model, built, export.transforms(model, split, masks is not None, notes))
        missing = [p.name for p in self.photos if p.name not in names and not any(p.name in g for g in solved.groups)]
        exposure = report.exposure_in_words([built / "images" / p.name for p in photos])
        facts = report.Facts(
            s.input.name, len(self.photos), missing, solved.groups, self.matching, solved.mapping, exposure,
            frame.up, frame.unit, split, findings, self._lens_notes(), self.times,
            solved.verdict, solved.focal,
        )  # fmt: skip
        report.write_report(model, facts, built)
        publish(built, s, findings, solved, split)

    def _lens_notes(self) -> list[str]:
        s = self.settings
        kept = "given and kept" if self.is_fixed else "refined"
        lens = "undone" if s.undistort else "kept in transforms.json"
        return [*self.notes, f"Intrinsics {kept}; {len(self.cameras)} camera(s); lens distortion {lens}."]

    def _split(self, names: Sequence[str]) -> export.Split:
        s = self.settings
        if s.split_from is not None:
            return export.split_from(read_lists(s.split_from), names, s.split_from.name)
        if self.known is not None and self.known.split and s.test_every is None and s.train_every is None:
            return export.split_from(self.known.split, names, f"{s.poses}")
        return export.split_by_count(names, s.test_every, s.train_every)

    def _findings(
        self, model: pycolmap.Reconstruction, photos: Sequence[Photo], database: Path
    ) -> list[checks.Finding]:
        names = [p.name for p in photos]
        found = checks.doubtful_intrinsics(model, self.is_fixed, self.settings.threads)
        sharp = np.zeros(len(names))
        with progress("Checking images", len(names)) as advance:
            for i, name in enumerate(names):
                sharp[i] = checks.sharpness(checks.read_gray(self.image_folder / name))
                advance(1)
        found += checks.blurred(names, sharp, self.is_ordered)
        if self.is_ordered:
            order, poses = camera_poses(model)
            offered = [p.name for p in self.photos]
            found += checks.misplaced(order, [offered.index(n) for n in order], poses)
        return found + checks.moving(model, database, names)


def _focal_findings(solved: Solved) -> list[checks.Finding]:
    """A focal length that the images hardly determine."""
    if solved.focal is None or solved.focal[1] - solved.focal[0] < WIDE * solved.focal[1]:
        return []
    says = f"the images hardly determine the focal length ({focal_in_words(*solved.focal)})"
    return [checks.Finding("intrinsics?", "", f"{says}: give --focal if you know it")]


def check_folders(settings: Settings) -> None:
    """Refuses output folders whose use would lose something.

    Raises:
        PrepareError: the input is missing or in the scene's way, or the scene folder is in use.
    """
    source, scene = settings.input.resolve(), settings.scene.resolve()
    if not source.exists():
        raise PrepareError(f"{settings.input} does not exist.")
    if settings.scene.is_file():
        raise PrepareError(f"{settings.scene} is a file: name a folder for the scene.")
    taken = export.existing_parts(scene)
    if scene == source or source in scene.parents or any((scene / part) in (source, *source.parents) for part in taken):
        raise PrepareError(f"The scene {settings.scene} would be mixed with its input: name another folder.")
    if taken and not settings.overwrite:
        raise PrepareError(
            f"{settings.scene} already holds {', '.join(taken)}: name another folder, or give --overwrite "
            "(the old files are then moved aside)."
        )


def publish(
    built: Path,
    settings: Settings,
    findings: Sequence[checks.Finding],
    solved: Solved,
    split: export.Split,
) -> None:
    """Moves the scene into place and reports the result; doubtful ones in red."""
    scene = settings.scene
    aside = scene / next(f"previous-{i}" for i in range(1, 10_000) if not (scene / f"previous-{i}").exists())
    export.publish(built, scene, aside)
    if aside.exists():
        say(f"What {scene} held is in {aside}.")
    if not settings.keep_work:
        shutil.rmtree(scene / WORK)
    for line in checks.by_kind(findings):
        say(line, "yellow")
    model, verdict = solved.model, solved.verdict
    is_right = verdict.grade == "right"
    if not is_right:
        say(f"This scene is {verdict.grade}: {verdict.words()} {REMEDY}", "bold red")
    say(
        f"{scene}: {model.num_reg_images()} images, {model.compute_mean_reprojection_error():.2f} px, "
        f"{len(split.train)} train, {len(split.test)} test; report.md says more. Train with:",
        "bold red" if not is_right else "" if findings else "green",
    )
    say(f"ns-train mmpi-small --data {shlex.quote(str(scene))}")


def prepare(settings: Settings) -> Verdict:
    """Makes the scene; returns how far it can be believed.

    Raises:
        PrepareError: the input cannot be made into a scene.
    """
    load_pycolmap()  # in a version that is new enough
    check_options(settings)
    check_folders(settings)
    with only_one(settings.scene / WORK):
        return Preparation(settings).run()
