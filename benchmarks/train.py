"""Error against wall time and against rays, ours beside nerfstudio's methods."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from methods import Method, find_method
from report import Bench, Report, Row, slug, stamp
from train_report import QUICK, draw, headline, markdown
from trainers import Scene
from trainings import Request, train_apart

from mmpi_ns.scripts.command import run

SHARES = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
"""Parts of a run after which it is looked at."""


@dataclass
class Train(Bench):
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
    rays_per_batch: tuple[str, ...] = ("nerfacto=1024", "depth-nerfacto=1024")
    """Rays of a step by method."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of every method."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes the GPU where there is one."""
    check_images: int = 0
    """Test images, evenly spaced, for the curve; 0 for all."""
    check_pixels: int = 512
    """Pixels of each of them, the same for every method; 0 for all."""
    final_images: int = 0
    """Test images, evenly spaced, rendered whole at the end for PSNR and SSIM; 0 for all."""
    check_every: int = 0
    """Look every so many steps too, beside the doubling ones; 0: no."""
    quick_hashes: bool = False
    """Give the hash tables of nerfstudio's methods our compiled lookups (the same values to rounding), and let them
    keep the memory that they free: nerfacto is two to three times as fast so on a CPU. Else they run as they are."""
    keep: bool = False
    """Keep checkpoints (a gigabyte each). nerfstudio's methods are then saved at every check, and a longer run, or one
    that was cut off, goes on from there."""

    name = "train"

    def run(self) -> None:
        report = Report(self)
        jobs = [
            (scene, method, steps, seed)
            for scene in self.data
            for seed in self.seeds  # first every method once
            for method in (find_method(name) for name in self.methods)
            for steps in self._lengths(method)
        ]
        for number, job in enumerate(jobs, 1):
            key = self._key(*job)
            print(f"[{number}/{len(jobs)}] {key}", flush=True)
            row = report.row(key, lambda key=key, job=job: self._row(key, *job), needed=False)
            check_equal_data(report.rows)
            print(f"    {_said(row)}", flush=True)
            report.finish(headline(report.rows), markdown(report.content), lambda path: draw(path, report.rows))
        print(report.content["headline"])

    def _lengths(self, method: Method) -> list[int]:
        """Steps of each run of a method."""
        return _by_name(self.steps, "steps").get(method.name, [method.steps])

    @property
    def _device(self) -> str:
        return self.device if self.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"

    def _rays(self, method: Method) -> int | None:
        return _by_name(self.rays_per_batch, "rays-per-batch").get(method.name, [None])[0]

    def _key(self, scene: Path, method: Method, steps: int, seed: int) -> str:
        """Of a row: all that a result depends on."""
        run = f"{self._called(method)}, {steps} steps, {self._rays(method) or 'own'} rays, seed {seed}"
        where = f"{self._device}, {self.cores} threads"
        seen = f"{self.check_pixels} pixels of {self.check_images} images, {self.final_images} whole"
        return f"{scene.resolve().name} /{self.downscale_factor}: {run}; {where}; {seen}"

    def _quick(self, method: Method) -> bool:
        return self.quick_hashes and method.hashes

    def _called(self, method: Method) -> str:
        """The method's name in tables."""
        return method.name + (QUICK if self._quick(method) else "")

    def _row(self, key: str, scene: Path, method: Method, steps: int, seed: int) -> Row:
        row: Row = {"scene": scene.resolve().name, "downscale_factor": self.downscale_factor, "steps": steps}
        row |= {"method": self._called(method), "ours": method.ours, "seed": seed}
        row["what"] = f"{row['method']} on {row['scene']}"
        reason = method.why_not()
        if reason is None and "cuda" in method.needs and self._device != "cuda":
            reason = "it needs a CUDA device, and --device cpu was asked for"
        if reason is not None:
            return {**row, "not_run": reason}
        # Runs that can go on from shorter ones share a folder with them.
        name = key.replace(f"{steps} steps, ", "", 1) if self._goes_on(method) else key
        request = self._request(scene, method, steps, seed, self.folder / slug(name, "-"))
        row |= stamp(self) | {"device": self._device, "options": request.rendered}
        if self._device == "cuda":
            row["gpu"] = torch.cuda.get_device_name()
        return row | train_apart(request, self.cores)

    def _goes_on(self, method: Method) -> bool:
        return self.keep and not method.ours

    def _request(self, scene: Path, method: Method, steps: int, seed: int, folder: Path) -> Request:
        often = range(self.check_every, steps, self.check_every) if self.check_every else ()
        checks = {max(1, round(steps * share)) for share in SHARES} | set(often)
        return Request.of(
            method, Scene(scene, self.downscale_factor), folder, steps, self._rays(method), seed, self._device,
            checks=tuple(sorted(checks)), check_images=self.check_images, check_pixels=self.check_pixels,
            final_images=self.final_images, keep=self.keep, go_on=self._goes_on(method),
            quick_hashes=self._quick(method),
        )  # fmt: skip


def _by_name(words: tuple[str, ...], option: str) -> dict[str, list[int]]:
    """name=number words, several numbers a name."""
    results: dict[str, list[int]] = {}
    for word in words:
        name, _, number = word.partition("=")
        if not number.isdigit() or not int(number):
            raise ValueError(f"--{option} {word}: write it as nerfacto=1500.")
        results.setdefault(find_method(name).name, []).append(int(number))
    return results


def check_equal_data(rows: dict[str, Row]) -> None:
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


def _said(row: Row) -> str:
    if "not_run" in row:
        return f"not run: {row['not_run']}"
    return f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}, {row['seconds']:.0f} s, {row['rays'] / 1e6:.2f} M rays"


if __name__ == "__main__":
    sys.exit(run("train", Train))
