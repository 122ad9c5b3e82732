"""Gains that are found in images of known and unknown exposure, and what correcting them is worth."""

from __future__ import annotations

import copy
import json
import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from lab import train_and_evaluate
from numpy.typing import NDArray
from PIL import Image
from report import Bench, Report, Row, page, table
from trainers import Scene

from mmpi_ns.config import mmpi_small
from mmpi_ns.scripts.command import run
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import ExposureName, light_of, make_exposure, tone, write_dataset

STREETS: tuple[ExposureName, ...] = ("none", "auto", "vignetting")
GREYS = (0.3, 0.5, 0.7)
"""Pixel values at which a gain of light is turned into a factor of pixel values."""


@dataclass(kw_only=True)
class ExposureBench(Bench):
    """Calibrates procedural streets, whose exposures are known, and captures; with --steps also trains on them."""

    data: tuple[Path, ...] = ()
    """Captures (folders with transforms.json) beside the streets, at half size if there are copies of it, else a
    quarter."""
    count: int = 48
    """Images of a street; half of them train."""
    width: int = 256
    """Of a street's images, pixels."""
    height: int = 144
    """Of a street's images, pixels."""
    steps: int = 0
    """Steps of a training with and one without correction, for each capture; 0: none."""

    name = "exposure"

    def run(self) -> None:
        report = Report(self, key=self.key("data"))
        for kind, exif in product(STREETS, (True, False)):
            name = f"street, {kind}" + ("" if exif else ", no EXIF")
            report.row(name, lambda kind=kind, exif=exif: self._row(self._street(kind, exif), 1))
        for data in self.data:
            factor = next((f for f in (2, 4) if (data / f"images_{f}").is_dir()), 1)
            report.row(data.resolve().name, lambda data=data, factor=factor: self._row(data, factor))
        report.finish({}, markdown(report.content))

    def _street(self, kind: ExposureName, exif: bool) -> Path:
        """A procedural street, written unless it is there."""
        folder = self.folder / (f"street-{kind}" if exif else f"street-{kind}-no-exif")
        if not (folder / "transforms.json").is_file():
            scene = make_scene("street", 0, self.count, self.width, self.height)
            write_dataset(scene, folder, exposure=make_exposure(kind, scene), processes=self.cores)
            for path in [] if exif else sorted((folder / "images").iterdir()):
                Image.fromarray(np.asarray(Image.open(path))).save(path)
        return folder

    def _row(self, data: Path, downscale_factor: int) -> Row:
        row = calibration(data, downscale_factor)
        for name, option in (("with", "True"), ("without", "False")) if self.steps else ():
            options = [
                "--pipeline.datamanager.priors.correct-exposure",
                option,
                "--max-num-iterations",
                str(self.steps),
            ]
            options += ["--pipeline.model.lpips-net", "none"]
            place = self.folder / f"{data.resolve().name}-{name}"
            _, scores, made = train_and_evaluate(
                Scene(data.resolve(), downscale_factor), place, "mmpi-small", options, (), self.cores
            )
            row |= {f"{score}_{name}": scores[score] for score in ("psnr", "ssim", "cc_psnr")}
            row |= {f"seconds_{name}": made["train_seconds"]}
        return row


def calibration(data: Path, downscale_factor: int) -> Row:
    """Gains of a capture's training images: whether they are used, and their errors where they are known."""
    config: Any = copy.deepcopy(mmpi_small.config.pipeline.datamanager)
    config.data, config.priors.correct_exposure, config.new_view_share = data, False, 0.0
    config.dataparser.downscale_factor = downscale_factor
    manager = config.setup(device="cpu", test_mode="val")
    start = time.process_time()
    gains = manager.maker.gains(manager.priors.observations, manager.priors.depths)
    row: Row = {"images": len(manager.train_dataset), "seconds_an_image": time.process_time() - start}
    row["seconds_an_image"] /= row["images"]
    if gains is None:
        return row | {"corrected": False}
    row |= {"corrected": gains.matter, "span": gains.span, "expected_error": float(np.median(gains.errors))}
    row |= {"disagreement": gains.disagreement, "left": gains.corrected}
    truth = true_factors(data, [Path(name).name for name in manager.train_dataset.image_filenames])
    if truth is None:
        return row
    factors = gains.factors if gains.matter else np.ones_like(truth)
    error = np.abs(np.log(factors / truth) - np.log(factors / truth).mean(0))
    return row | {"median_error": float(np.median(error)), "worst_error": float(error.max())}


def true_factors(data: Path, names: list[str]) -> NDArray[np.float64] | None:
    """Factors [N, 3] of middle greys in images of known exposure; None where it is not known, ones where it is one."""
    path = data / "exposure.json"
    if not path.is_file():
        return np.ones((len(names), 3)) if data.name.startswith("street-none") else None
    told = {Path(name).name: gains for name, gains in json.loads(path.read_text(encoding="utf-8"))["gains"].items()}
    gains = np.array([told[name] for name in names])
    return np.mean([tone(np.minimum(1, gains * light_of(np.array(v)))) / v for v in GREYS], 0)


def markdown(content: Row) -> str:
    rows = [{"name": name, **row} for name, row in content["rows"].items()]

    def percent(name: str) -> Any:
        return lambda row: f"{100 * row[name]:.1f} %" if name in row else ""

    columns: dict[str, Any] = {
        "capture": "{name}",
        "training images": "{images}",
        "corrected": lambda row: "yes" if row["corrected"] else "no",
        "span of 80 %": lambda row: f"{row['span']:.2f}" if "span" in row else "not known",
        "colours differ by": percent("disagreement"),
        "after gains": percent("left"),
        "error of gains, median": percent("median_error"),
        "worst": percent("worst_error"),
        "processor s an image": "{seconds_an_image:.2f}",
    }
    if any("psnr_with" in row for row in rows):
        for score in ("psnr", "cc_psnr"):
            for name in ("without", "with"):
                key = f"{score}_{name}"
                columns[f"{score} {name}"] = lambda row, key=key: f"{row[key]:.2f}" if key in row else ""
    intro = (
        "Exposures of streets are exact: one, three-fold automatic gains with 10 % white balance, and half of the "
        "light lost in the corners. What colours differ by is the median over image pairs that were left out, "
        "after the fall-off towards the corners."
    )
    return page("Exposure", content["made"], intro, table(columns, rows))


if __name__ == "__main__":
    sys.exit(run("exposure", ExposureBench))
