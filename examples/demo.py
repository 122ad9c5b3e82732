"""``make demo``: makes a scene, trains on it, evaluates and shows it; a rerun keeps what is finished."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mmpi_ns.scripts.command import run

PARTS = 6
FREE_BYTES = 2 << 30
"""Disk space that a demo may need, mostly for checkpoints."""
OURS = ("runs", "fly", "unfinished.mp4", "fly.mp4", "times.json", "eval.json", "contact-sheet.png", "overview.png",
        "psnr.png")  # fmt: skip
"""Outputs of the demo besides the scene and its page, which are removed on a fresh start."""


class DemoError(ValueError):
    """The demo cannot continue; one sentence that says why and what to do."""


@dataclass
class Demo:
    """Makes a procedural scene, trains mmpi on it, evaluates it, and takes pictures. A rerun continues where the
    last one stopped."""

    folder: Path = Path("demo")
    """Folder for everything that is written."""
    steps: int = 1000
    """Training steps."""
    images: int = 64
    """Images of the scene; half of them are held out for testing, of room and object an eighth."""
    frames: int = 40
    """Frames of the fly-through."""
    kind: Literal["street", "long-road", "room", "object"] = "street"
    """One of the scenes of mmpi-scene."""
    length: float | None = None
    """Metres driven (street: 40, long-road: 1000)."""
    fresh: bool = False
    """Start over instead of keeping the results of an earlier demo."""

    def main(self) -> None:
        start = time.perf_counter()
        results, film = self.learn()
        self._part(5, "PSNR against seconds")
        self._draw_curve()
        self._part(6, "a page to fly through")
        self._write_page()
        self._say_where(results, film, time.perf_counter() - start)

    def learn(self) -> tuple[dict[str, Any], Path]:
        """Makes, trains and evaluates the scene and takes its pictures; returns ``ns-eval``'s figures and the film."""
        self._prepare_folder()
        self._part(1, f"the {self.kind}: {self.images} images")
        self._make_scene()
        self._part(2, f"training mmpi for {self.steps} steps")
        self._train()
        self._part(3, "evaluating on the images held out")
        results = self._evaluate()
        self._part(4, "fly-through and contact sheet")
        return results, self._take_pictures()

    @property
    def scene(self) -> Path:
        return self.folder / self.kind

    @property
    def run(self) -> Path:
        return self.folder / "runs" / self.kind / "mmpi" / "demo"

    @property
    def page(self) -> Path:
        return self.folder / f"{self.kind}.html"

    @property
    def checkpoint(self) -> Path:
        """The last step of training; each window of a long road has this many steps."""
        from mmpi_ns.scene.windows import WindowedPlan

        plan = self.run / "plan.json"
        windows = len(WindowedPlan.load(plan)) if plan.is_file() else 1
        return self.run / "nerfstudio_models" / f"step-{windows * self.steps - 1:09d}.ckpt"

    def _prepare_folder(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.fresh:
            for path in (self.scene, self.page, *(self.folder / name for name in OURS)):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        free = shutil.disk_usage(self.folder).free
        if free < FREE_BYTES and not self.checkpoint.is_file():
            raise DemoError(
                f"{self.folder.resolve()} has {free / 2**30:.1f} GB free and the demo may need "
                f"{FREE_BYTES / 2**30:.0f}: make room, or name another folder with --folder."
            )

    def _part(self, number: int, what: str) -> None:
        print(f"\n=== {number}/{PARTS} {what} ===", flush=True)

    def _make_scene(self) -> None:
        from mmpi_scene.catalogue import make_scene
        from mmpi_scene.dataset import write_dataset

        transforms = self.scene / "transforms.json"
        if transforms.is_file() and len(json.loads(transforms.read_text(encoding="utf-8"))["frames"]) == self.images:
            _kept(self.scene)
            return
        shutil.rmtree(self.run, ignore_errors=True)  # it belongs to the scene of before
        print("Looking for points that several cameras see ...", flush=True)
        scene = make_scene(self.kind, count=self.images, length=self.length)
        write_dataset(scene, self.scene, overwrite=True, progress=lambda items: _track(items, "Rendering the scene"))

    def _train(self) -> None:
        if self.checkpoint.is_file():
            _kept(self.run)
            return
        newest = self._resumable()
        if newest is None:
            shutil.rmtree(self.run, ignore_errors=True)
            begun = {"started": time.time(), "steps": self.steps}
            (self.folder / "times.json").write_text(json.dumps(begun), encoding="utf-8")
        else:
            print(f"Continuing from step {newest}.")
        every = str(max(1, self.steps // 6))
        self._command(
            "ns-train", "mmpi", "--data", str(self.scene), "--output-dir", str(self.folder / "runs"),
            "--experiment-name", self.kind, "--timestamp", "demo", "--max-num-iterations", str(self.steps),
            "--vis", "tensorboard", "--steps-per-save", str(max(1, self.steps // 3)),
            "--steps-per-eval-all-images", every,
            "--pipeline.datamanager.eval-num-rays-per-batch", "8192", "--logging.steps-per-log", "20",
            "--pipeline.model.lpips-net", "none",  # would download half a gigabyte of weights
            "--pipeline.datamanager.priors.depth-images", "False",  # exact depths, which captures have not
            *(["--load-dir", str(self.run / "nerfstudio_models")] if newest is not None else []),
        )  # fmt: skip
        if not self.checkpoint.is_file():
            raise DemoError(f"ns-train ended before its last step: start again, it goes on from {self.run}.")

    def _resumable(self) -> int | None:
        """The last saved step of an interrupted training of the same length."""
        times = self.folder / "times.json"
        if not times.is_file() or json.loads(times.read_text(encoding="utf-8")).get("steps") != self.steps:
            return None
        return max((int(p.stem.split("-")[1]) for p in self.run.glob("nerfstudio_models/step-*.ckpt")), default=None)

    def _evaluate(self) -> dict[str, Any]:
        target = self.folder / "eval.json"
        if not self._is_newer(target):
            self._command("ns-eval", "--load-config", str(self.run / "config.yml"), "--output-path", str(target))
        return json.loads(target.read_text(encoding="utf-8"))["results"]

    def _take_pictures(self) -> Path:
        from film import film_frames, write_film
        from sheet import contact_sheet, nearest_of, overview, show_views, spread
        from views import load_run

        sheet, film = self.folder / "contact-sheet.png", self.folder / "fly.mp4"
        if self._is_newer(sheet) and self._is_newer(film):
            return film
        run = load_run(self.run / "config.yml")
        indices = spread(len(run.tests))
        shown = show_views(run, indices, lambda items: _track(items, "Test views, each MPI alone"))
        overview(run, shown[len(shown) // 2]).save(self.folder / "overview.png")
        contact_sheet(run, shown).save(sheet)
        images = film_frames(run, self.frames, nearest_of(shown), lambda items: _track(items, "Fly-through"))
        return write_film(images, self.folder)

    def _draw_curve(self) -> None:
        from curve import draw_curve

        times = self.folder / "times.json"
        if not times.is_file():
            raise DemoError(f"{times} is gone, so nobody knows when training began: start afresh with --fresh.")
        started = json.loads(times.read_text(encoding="utf-8"))["started"]
        draw_curve(self.run, self.folder / "psnr.png", started, f"mmpi, {self.steps} steps on the demo's {self.kind}")

    def _write_page(self) -> None:
        if not self._is_newer(self.page):
            self._command(
                "mmpi-export", "web", "--load-config", str(self.run / "config.yml"), "--output", str(self.page),
                "--single-file", "--overwrite", "--compare", "0",
            )  # fmt: skip

    def _say_where(self, results: dict[str, Any], film: Path, seconds: float) -> None:
        held_out = json.loads((self.scene / "transforms.json").read_text(encoding="utf-8"))["test_filenames"]
        film_note = "the fly-through" if film.suffix else "the fly-through as frames (no encoder was found)"
        print(
            f"\nDone in {seconds // 60:.0f} min {seconds % 60:.0f} s. PSNR {results['psnr']:.2f} dB, "
            f"SSIM {results['ssim']:.3f} over {len(held_out)} images held out.\n\nOpen first:\n"
            f"  {self.folder / 'contact-sheet.png'}   what each MPI does\n"
            f"  {self.page}   the {self.kind} in a browser: open it by a double click, drag and press W\n"
            f"  {film}   {film_note}\n"
            f"  {self.folder / 'psnr.png'}   PSNR against seconds\n"
            f"  {self.folder / 'overview.png'}   one view, and where the MPIs stand\n\n"
            f"Walk through it: {_program('ns-viewer')} --load-config {self.run / 'config.yml'}"
        )

    def _is_newer(self, path: Path) -> bool:
        """Whether an output was made from the current checkpoint."""
        newer = path.exists() and path.stat().st_mtime >= self.checkpoint.stat().st_mtime
        if newer:
            _kept(path)
        return newer

    def _command(self, name: str, *arguments: str) -> None:
        """Prints and runs a command of this environment."""
        program = _program(name)
        if not program.is_file():
            raise DemoError(f"{program} does not exist: install the package into this environment (make venv).")
        print(f"$ {shlex.join([name, *arguments])}", flush=True)
        quiet = {**os.environ, "PYTHONWARNINGS": "ignore"}  # warnings of libraries, which would bury the progress
        code = subprocess.run([str(program), *arguments], env=quiet, check=False).returncode
        if code:
            raise DemoError(f"{name} ended with status {code}: what it said is above.")


def _program(name: str) -> Path:
    return Path(sys.executable).with_name(name)


def _kept(path: Path) -> None:
    print(f"{path} is kept from an earlier demo (--fresh makes it anew).", flush=True)


def _track(items: Iterable[Any], what: str) -> Iterator[Any]:
    from rich.progress import track

    yield from track(list(items), description=what)


def main() -> int:
    """Runs the demo; an error is one sentence and status 1."""
    warnings.simplefilter("ignore")
    try:
        return run("demo", Demo)
    except KeyboardInterrupt:
        print("\nInterrupted: the same command goes on from here.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
