"""What of the cars and people on procedural streets is masked, and what masking them is worth; shares of captures."""

from __future__ import annotations

import copy
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from lab import train_and_evaluate
from numpy.typing import NDArray
from PIL import Image
from report import Bench, Report, Row, page, table
from trainers import Scene

from mmpi_ns.config import mmpi_small
from mmpi_ns.data.posed_images import at_full_size, posed_images
from mmpi_ns.scripts.command import run
from mmpi_priors.dense import find_depths
from mmpi_priors.moving import COMPARED, ROUNDS, SIDE, key_images, moving_masks
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset
from mmpi_scene.movers import MOVER, with_movers

STREETS = (*(("street", seed) for seed in range(5)), *(("walk", seed) for seed in range(3)))
"""Names and seeds of the procedural scenes with movers."""
CACHED = 0.01
"""Processor seconds for an image below which masks came from the cache."""
VIDEO = 120, 16.0
"""Images and metres of a street whose frames follow closely, as in a video."""


@dataclass(kw_only=True)
class MovingBench(Bench):
    """Masks what moves on procedural streets, of which it is known, and in captures; with --steps also trains."""

    data: tuple[Path, ...] = ()
    """Captures (folders with transforms.json) beside the streets, at half size if there are copies of it, else a
    quarter."""
    count: int = 48
    """Images of a street."""
    movers: int = 5
    """Cars and people on a street."""
    width: int = 384
    """Of a street's images, pixels."""
    height: int = 216
    """Of a street's images, pixels."""
    steps: int = 0
    """Steps of trainings on the first street: with movers and masks, without masks, and without movers; 0: none."""

    name = "moving"

    def run(self) -> None:
        report = Report(self, key=self.key("data", "steps"))
        for name, seed in STREETS:
            data = self._street(name, seed, self.movers)
            report.row(f"{name}, seed {seed}", lambda data=data: masked_shares(data, 1))
        video = self._street("street", 0, self.movers, *VIDEO)
        report.row("a video on street, seed 0", lambda: masked_shares(video, 1))
        for data in self.data:
            factor = next((f for f in (2, 4) if (data / f"images_{f}").is_dir()), 1)
            report.row(data.resolve().name, lambda data=data, factor=factor: masked_shares(data, factor))
        if self.steps:
            for movers, mask in ((self.movers, True), (self.movers, False), (0, True)):
                title = f"{self.steps} steps, {movers} movers{', masked' if mask and movers else ''}"
                report.row(title, lambda movers=movers, mask=mask: self._trained(movers, mask))
        report.finish({}, markdown(report.content))

    def _street(self, name: str, seed: int, movers: int, count: int = 0, length: float | None = None) -> Path:
        """A procedural scene, written unless it is there; of ``count`` images and its own length, if none are given."""
        folder = self.folder / (f"{name}-{seed}-{movers}" + (f"-{count}" if count else ""))
        if not (folder / "transforms.json").is_file():
            scene = make_scene(name, seed, count or self.count, self.width, self.height, length)
            write_dataset(with_movers(scene, movers) if movers else scene, folder, processes=self.cores)
        return folder

    def _trained(self, movers: int, mask: bool) -> Row:
        """Scores of the test images, which hold no movers."""
        options = ["--pipeline.datamanager.priors.mask-moving", str(mask), "--max-num-iterations", str(self.steps)]
        options += ["--pipeline.model.lpips-net", "none"]
        data, place = self._street(*STREETS[0], movers), self.folder / f"trained-{movers}-{mask}"
        _, scores, made = train_and_evaluate(Scene(data, 1), place, "mmpi-small", options, (), self.cores)
        return {"psnr": scores["psnr"], "ssim": scores["ssim"], "train_seconds": made["train_seconds"]}


def masked_shares(data: Path, downscale_factor: int) -> Row:
    """Shares of a capture's training pixels that are masked, and of what moves and stands where that is known."""
    config: Any = copy.deepcopy(mmpi_small.config.pipeline.datamanager)
    config.data, config.new_view_share = data, 0.0
    none = {"dense_depth": False, "depth_images": False, "mask_moving": False, "correct_exposure": False}
    config.priors = replace(config.priors, **none)
    config.dataparser.downscale_factor = downscale_factor
    manager = config.setup(device="cpu", test_mode="val")
    dataset, observations = manager.train_dataset, manager.observations
    posed = posed_images(observations, dataset)
    assert posed is not None
    original, (seen_by, points) = at_full_size(posed), observations.tracked
    start = time.process_time()
    masks, _ = moving_masks(original, [(int(h), int(w)) for w, h in observations.sizes], seen_by, points)
    seconds = (time.process_time() - start) / len(masks)
    row: Row = {"images": len(masks), "seconds_an_image": seconds}
    if seconds > CACHED:
        keys = key_images(original, lambda i: points[seen_by == i], COMPARED)
        start = time.process_time()
        deque(find_depths(original, lambda i: points[seen_by == i], SIDE, rounds=ROUNDS, among=keys), maxlen=0)
        row["matching_an_image"] = (time.process_time() - start) / len(masks)
    row |= {"masked": mean_of(masks), "most": max(float(mask.mean()) for mask in masks)}
    truths = [data / "moving" / Path(name).name for name in dataset.image_filenames]
    if truths[0].is_file():
        truth = np.stack([np.asarray(Image.open(path)) for path in truths])
        rendered = np.stack(masks)
        row |= {"moving": float((truth == MOVER).mean()), "of_moving": float(rendered[truth == MOVER].mean())}
        row |= {"of_static": float(rendered[truth == 0].mean())}
    return row


def mean_of(masks: Sequence[NDArray[np.bool_]]) -> float:
    """Share of all pixels."""
    return sum(int(mask.sum()) for mask in masks) / sum(mask.size for mask in masks)


def markdown(content: Row) -> str:
    rows = [{"name": name, **row} for name, row in content["rows"].items()]

    def percent(name: str) -> Any:
        return lambda row: f"{100 * row[name]:.1f} %" if name in row else ""

    shares = {
        "capture": "{name}",
        "training images": "{images}",
        "masked": lambda row: f"{100 * row['masked']:.2f} %",
        "most of an image": percent("most"),
        "moves": percent("moving"),
        "masked of what moves": percent("of_moving"),
        "masked of what stands": percent("of_static"),
        "processor s an image": lambda row: (
            f"{row['seconds_an_image']:.2f}" if row["seconds_an_image"] > CACHED else "cached"
        ),
        "... of which matching": lambda row: f"{row['matching_an_image']:.2f}" if "matching_an_image" in row else "",
    }
    trained = {"training": "{name}", "PSNR": "{psnr:.2f}", "SSIM": "{ssim:.3f}", "s": "{train_seconds:.0f}"}
    intro = (
        "Movers of procedural streets are known exactly; what stands is without their shadows. Asked are 90 % of what "
        "moves and at most 2 % of what stands. Seconds are for all that finding movers takes, dense matching at its "
        "size and exposures included. Test images of the trainings show the first street without movers."
    )
    text = table(shares, [row for row in rows if "images" in row])
    if any("psnr" in row for row in rows):
        text += "\n\n" + table(trained, [row for row in rows if "psnr" in row])
    return page("What moves", content["made"], intro, text)


if __name__ == "__main__":
    sys.exit(run("moving", MovingBench))
