"""``mmpi-bench train``: error against wall time and against rays, ours beside nerfstudio's methods."""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from mmpi_ns.bench.apart import run_apart
from mmpi_ns.bench.methods import Method, Scene, find_method
from mmpi_ns.bench.provenance import commit, read_json, stamp, write_json
from mmpi_ns.bench.quality.train_report import QUICK, draw, headline, table
from mmpi_ns.bench.trainings import Request

SHARES = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
"""Parts of a run after which it is looked at."""


@dataclass
class Train:
    """PSNR of test views against seconds and rays of training, for several methods, scenes and seeds.

    Every method gets the same images, sizes, poses and test images; cameras are not optimised. The clock starts when
    the trainer is set up (images are read, MPIs placed) and stands still while test views are rendered. Rows that are
    finished are kept in train.json: run it again with other --data or --methods, or beside this run, to add to them.
    """

    data: tuple[Path, ...]
    """Scenes (folders with transforms.json, all read at the same --downscale-factor)."""
    downscale_factor: int = 4
    """Image size to use."""
    methods: tuple[str, ...] = ("mmpi-small", "single", "two-phase", "nerfacto", "instant-ngp", "splatfacto")
    """What to train; also mmpi, mmpi-kitti, mmpi-scannet, mmpi-scannet-short."""
    steps: tuple[str, ...] = ()
    """Steps by method, as nerfacto=1500; a method may be named more than once, for runs of several lengths."""
    rays_per_batch: tuple[str, ...] = ("nerfacto=1024",)
    """Rays of a step by method."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of every method."""
    threads: int = 0
    """Threads of each training; 0 for all cores."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes the GPU where there is one."""
    check_images: int = 0
    """Test images, evenly spaced, for the curve; 0 for all."""
    check_pixels: int = 512
    """Pixels of each of them, the same for every method; 0 for all."""
    final_images: int = 0
    """Test images, evenly spaced, rendered whole at the end for PSNR and SSIM; 0 for all."""
    output: Path = Path("docs/results")
    """Where train.json, train.md and train.png go."""
    work: Path = Path("outputs/train")
    """Where runs and their logs go."""
    check_every: int = 0
    """Look every so many steps too, beside the doubling ones; 0: no."""
    quick_hashes: bool = False
    """Give the hash tables of nerfstudio's methods our compiled lookups (the same values to rounding), and let them
    keep the memory that they free: nerfacto is two to three times as fast so on a CPU. Else they run as they are."""
    keep: bool = False
    """Keep checkpoints (a gigabyte each). nerfstudio's methods are then saved at every check, and a longer run, or one
    that was cut off, goes on from there."""

    def run(self) -> None:
        made, path = stamp("train", self), self.output / "train.json"
        made["threads"] = self.threads or os.cpu_count() or 1
        content: dict[str, Any] = {"headline": {}, "made": made, "rows": {}}
        jobs = [
            (scene, method, steps, seed)
            for scene in self.data
            for seed in self.seeds  # first every method once
            for method in (find_method(name) for name in self.methods)
            for steps in self._lengths(method)
        ]
        for number, (scene, method, steps, seed) in enumerate(jobs, 1):
            key = self._key(scene, method, steps, seed)
            print(f"[{number}/{len(jobs)}] {key}", flush=True)
            row = read_json(path).get("rows", {}).get(key, {"not_run": ""})
            if "not_run" in row:
                row = self._row(key, scene, method, steps, seed)
            # Another run may have added rows meanwhile.
            content["rows"] = read_json(path).get("rows", {}) | {key: row}
            _check_equal_data(content["rows"])
            print(f"    {_said(content['rows'][key])}", flush=True)
            content["headline"] = headline(content["rows"])
            write_json(path, content)
            (self.output / "train.md").write_text(table(content), encoding="utf-8")
            draw(self.output / "train.png", content["rows"])
        print(content["headline"])

    def _lengths(self, method: Method) -> list[int]:
        """Steps of each run of a method."""
        return _by_name(self.steps, "steps").get(method.name, [method.steps])

    @property
    def _device(self) -> str:
        return self.device if self.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"

    def _key(self, scene: Path, method: Method, steps: int, seed: int) -> str:
        """Of a row: all that a result depends on."""
        rays = _by_name(self.rays_per_batch, "rays-per-batch").get(method.name, ["own"])[0]
        where = f"{self._device}, {self.threads or os.cpu_count()} threads"
        seen = f"{self.check_pixels} pixels of {self.check_images} images, {self.final_images} whole"
        name = scene.resolve().name
        run = f"{self._called(method)}, {steps} steps, {rays} rays, seed {seed}"
        return f"{name} /{self.downscale_factor}: {run}; {where}; {seen}"

    def _quick(self, method: Method) -> bool:
        return self.quick_hashes and method.hashes

    def _called(self, method: Method) -> str:
        """The method's name in tables."""
        return method.name + (QUICK if self._quick(method) else "")

    def _row(self, key: str, scene: Path, method: Method, steps: int, seed: int) -> dict[str, Any]:
        """Trains in a process of its own, so that memory and threads are the method's alone."""
        row: dict[str, Any] = {
            "scene": scene.resolve().name,
            "downscale_factor": self.downscale_factor,
            "method": self._called(method),
            "ours": method.ours,
            "steps": steps,
            "seed": seed,
        }
        reason = method.why_not()
        if reason is None and "cuda" in method.needs and self._device != "cuda":
            reason = "it needs a CUDA device, and --device cpu was asked for"
        if reason is not None:
            return {**row, "not_run": reason}
        go_on = self.keep and not method.ours
        # Runs that can go on from shorter ones share a folder with them.
        name = key.replace(f"{steps} steps, ", "", 1) if go_on else key
        folder = self.work / re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
        request = self._request(scene, method, steps, seed, folder)
        made = stamp("train", self)
        keep = ("command", "processor", "torch", "date")
        row |= {k: made[k] for k in keep} | {"threads": self.threads or os.cpu_count(), "device": self._device}
        row |= {"commit": commit(), "options": shlex.join(shown(request.words))}
        if self._device == "cuda":
            row["gpu"] = torch.cuda.get_device_name()
        return row | train_apart(request, folder, int(row["threads"]))

    def _request(self, scene: Path, method: Method, steps: int, seed: int, folder: Path) -> Request:
        rays = _by_name(self.rays_per_batch, "rays-per-batch").get(method.name, [None])[0]
        words = method.words(Scene(scene, self.downscale_factor), folder, steps, rays, seed, self._device)
        return Request(
            words=tuple(words),
            data=str(scene),
            downscale_factor=self.downscale_factor,
            work=str(folder),
            checks=self._checks(steps),
            check_images=self.check_images,
            check_pixels=self.check_pixels,
            final_images=self.final_images,
            whole_images=method.whole_images,
            keep=self.keep,
            go_on=self.keep and not method.ours,
            quick_hashes=self._quick(method),
        )

    def _checks(self, steps: int) -> tuple[int, ...]:
        """Steps after which a run is looked at."""
        often = range(self.check_every, steps, self.check_every) if self.check_every else ()
        return tuple(sorted({max(1, round(steps * share)) for share in SHARES} | set(often)))


def train_apart(request: Request, folder: Path, threads: int) -> dict[str, Any]:
    """The row of a training in a fresh process, or why there is none."""
    extra = {}
    if request.quick_hashes:  # else half of nerfacto's time goes into fetching the same pages from the system again
        extra |= {"MALLOC_MMAP_THRESHOLD_": str(8 * 10**9), "MALLOC_TRIM_THRESHOLD_": str(16 * 10**9)}
    if request.go_on:  # nerfstudio's checkpoints hold numpy scalars, which torch refuses unless told otherwise
        extra["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"
    return run_apart("mmpi_ns.bench.trainings", asdict(request), folder, threads, extra=extra)


def _by_name(words: tuple[str, ...], option: str) -> dict[str, list[int]]:
    """name=number words, several numbers a name."""
    found: dict[str, list[int]] = {}
    for word in words:
        name, _, number = word.partition("=")
        if not number.isdigit() or not int(number):
            raise ValueError(f"--{option} {word}: write it as nerfacto=1500.")
        find_method(name)
        found.setdefault(name, []).append(int(number))
    return found


def shown(words: tuple[str, ...]) -> list[str]:
    """The words without where things lie on this machine."""
    hidden = {"--output-dir", "--data", "--experiment-name", "--timestamp"}
    return [w for i, w in enumerate(words) if w not in hidden and (i == 0 or words[i - 1] not in hidden)]


def _check_equal_data(rows: dict[str, Any]) -> None:
    """All methods of a scene must have had the same images.

    Raises:
        RuntimeError: two had not.
    """
    seen: dict[tuple[str, int], tuple[str, str]] = {}
    for key, row in rows.items():
        if "not_run" in row:
            continue
        digest, other = seen.setdefault((row["scene"], row["downscale_factor"]), (row["split"]["digest"], key))
        if row["split"]["digest"] != digest:
            raise RuntimeError(f"{key} and {other} were given different images: their figures cannot be compared.")


def _said(row: dict[str, Any]) -> str:
    if "not_run" in row:
        return f"not run: {row['not_run']}"
    return f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}, {row['seconds']:.0f} s, {row['rays'] / 1e6:.2f} M rays"
