"""Crops of test images of several runs beside the truth, enlarged: what scores do not tell."""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image, ImageDraw

from mmpi_ns.scripts.command import run
from mmpi_ns.utils.errors import InputError

BORDER, TEXT = 4, 14
"""Pixels around a crop, and those of the line of text above it."""


@dataclass(kw_only=True)
class Crops:
    """Writes one row for each crop: the truth, and each run. Images of captures are not to be committed."""

    images: tuple[Path, ...]
    """Folders of ns-eval --render-output-path, one for each run; the first has the truth."""
    names: tuple[str, ...] = ()
    """Of the runs, for the heads of columns (their folders' names if none are given)."""
    crops: Annotated[tuple[tuple[int, int, int, int, int], ...], tyro.conf.arg(metavar="IMAGE LEFT TOP WIDTH HEIGHT")]
    """For each row: number of the test image, left and upper border, width and height in pixels."""
    output: Path = Path("crops.png")
    """The picture."""
    side: int = 240
    """Longer side of a crop in the picture, pixels."""

    def main(self) -> None:
        names = ["truth", *(self.names or (folder.parent.name for folder in self.images))]
        if len(names) != 1 + len(self.images):
            raise InputError("--names needs one name for each folder of --images.")
        rows = [self._row(names, *crop) for crop in self.crops]
        sheet = Image.new("RGB", (max(row.width for row in rows), sum(row.height for row in rows)))
        tops = itertools.accumulate((row.height for row in rows), initial=0)
        for row, top in zip(rows, tops, strict=False):
            sheet.paste(row, (0, top))
        self.output.parent.mkdir(parents=True, exist_ok=True)
        sheet.save(self.output)
        print(self.output)

    def _row(self, names: list[str], number: int, left: int, top: int, width: int, height: int) -> Image.Image:
        """A crop of the truth and of each run, with a line of text above."""
        shown = []
        for folder in self.images:
            path = folder / f"eval_img_{number:04d}.png"
            if not path.is_file():
                raise InputError(f"{path} is missing: run ns-eval --render-output-path {folder}.")
            both = Image.open(path).convert("RGB")
            half = both.width // 2
            if left < 0 or top < 0 or left + width > half or top + height > both.height or min(width, height) < 1:
                raise InputError(f"Crop {number} {left} {top} {width} {height} reaches out of {half} x {both.height}.")
            shown.append([both.crop((x, top, x + width, top + height)) for x in (left, half + left)])
        scale = self.side / max(width, height)
        size = max(1, round(scale * width)), max(1, round(scale * height))
        step = size[0] + BORDER
        row = Image.new("RGB", (step * len(names), size[1] + TEXT + BORDER), "white")
        for n, (name, crop) in enumerate(zip(names, [shown[0][0], *(both[1] for both in shown)], strict=True)):
            row.paste(crop.resize(size, Image.Resampling.BICUBIC), (n * step, TEXT))
            ImageDraw.Draw(row).text((n * step + 2, 1), f"{name}, image {number}", fill="black")
        return row


if __name__ == "__main__":
    sys.exit(run("crops", Crops))
