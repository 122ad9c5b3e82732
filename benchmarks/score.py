"""PSNR, SSIM and LPIPS of test images that any program has rendered, and a row of a table with them."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from numpy.typing import NDArray
from report import Bench, Report, Row, cell, page, table
from torch import Tensor

from mmpi_ns.data.checks import check_transforms
from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.rendering.pipeline import summary
from mmpi_ns.scripts.command import run

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
SAME_DB = 119.0
"""Images whose PSNR is above this are equal but for rounding (``ImageMetrics`` ends at 120)."""
PROTOCOL = """\
PSNR of an image is -10 log10 of the mean squared error over its pixels and colours (0 to 1), SSIM torchmetrics' with
its defaults, LPIPS torchmetrics' with the network that is named. Colours are fitted by an affine map of each rendering
to its test image. All are means over the test images."""
Scores = list[tuple[str, dict[str, float]]]
"""Name and metrics of each image."""


@dataclass(kw_only=True)
class Score(Bench):
    """Scores renderings of a scene's test images by any program, with the metrics of all other tables.

    A rendering has the name of its test image, with any ending: frame_00002.png for images/frame_00002.jpg. Other
    images in the folder are ignored. All pixels count, masked ones too.
    """

    images: Path
    """Folder of the renderings."""
    data: Path
    """The scene (a folder with transforms.json; its test list is used)."""
    downscale_factor: int = 1
    """Size of the test images that were rendered."""
    test_images: int = 0
    """Number of test images to score, evenly spaced; 0 for all."""
    lpips: Literal["vgg", "alex", "none"] = "vgg"
    """Network of LPIPS, which is omitted if the weights are not available."""

    method: str = ""
    """Name of what made the images; a row of score.json and score.md is written if it is given."""
    given: str = ""
    """What that was given beside the training images, for the row."""
    seconds: float = 0.0
    """How long it was trained, for the row."""
    frame: float = 0.0
    """Seconds in which it renders a test image, for the row."""
    memory: float = 0.0
    """Peak of its training, GiB, for the row."""
    remark: str = ""
    """For the row."""

    name = "score"

    def run(self) -> None:
        scores, means = self.score()
        if not self.method:
            return
        report = Report(self)
        scene = f"{self.data.resolve().name} /{self.downscale_factor}"
        row: Row = {"method": self.method, "scene": scene, "given": self.given, "seconds": self.seconds}
        row |= {"frame": self.frame, "memory": self.memory, "remark": self.remark}
        row |= {"images": len(scores), **means, "each": dict(scores)}
        row |= {"command": report.content["made"]["command"]}
        report.rows[f"{self.method} on {scene}, {len(scores)} images"] = row
        head = {f"{key}: {k}": r[k] for key, r in report.rows.items() for k in means if k in r}
        report.finish(head, markdown(report.content))

    def score(self) -> tuple[Scores, dict[str, float]]:
        """Scores, prints and returns name and metrics of each image, and the means."""
        parser = NerfstudioDataParserConfig(data=self.data, downscale_factor=self.downscale_factor)
        check_transforms(parser, self.data, opens=True)
        outputs = parser.setup().get_dataparser_outputs(split="test")
        if not outputs.image_filenames:
            raise ValueError(f"{self.data} has no test images: list them as test_filenames in its transforms.json.")
        truths = MMPIDataset(outputs)
        chosen = evenly(len(truths), self.test_images)
        tests = [truths.image_filenames[i] for i in chosen]
        if not self.images.is_dir():
            raise ValueError(f"There is no folder {self.images}: give the one that holds the renderings.")
        by_name: dict[str, list[Path]] = {}
        for path in sorted(p for p in self.images.iterdir() if p.suffix.lower() in ENDINGS):
            by_name.setdefault(path.stem, []).append(path)
        missing = [test.stem for test in tests if test.stem not in by_name]
        if missing:
            first_there = next(iter(by_name.values()), [None])[0]
            there = f"the first image there is {first_there.name}" if first_there else "no image is there"
            raise ValueError(
                f"{self.images} lacks {len(missing)} of {len(tests)} test images, {missing[0]}.png to begin with "
                f"({there}): name each rendering as its test image."
            )
        for first, *others in (by_name[test.stem] for test in tests):
            if others:
                raise ValueError(f"{self.images} holds {first.name} and {others[0].name}: keep one of them.")
        metrics = ImageMetrics(self.lpips)
        scores: Scores = []
        for i, (file, *_) in zip(chosen, (by_name[test.stem] for test in tests), strict=True):
            truth, name = truths.get_data(i)["image"], truths.image_filenames[i]
            if truth.shape[-1] != 3:
                raise ValueError(f"{name} is see-through: there is no one truth to compare with.")
            rendering = MMPIDataset(replace(truths._dataparser_outputs, image_filenames=[file]))
            scores.append((name.name, metrics(colors_of(rendering.get_numpy_image(0), file, truth), truth)))
        if min(values["psnr"] for _, values in scores) > SAME_DB:
            raise ValueError(f"{self.images} holds the test images themselves: give the folder of the renderings.")
        means = {k: float(np.mean([values[k] for _, values in scores])) for k in scores[0][1]}
        others = (f", {k} {v:.3f}" for k, v in means.items() if k.startswith(("cc_psnr", "lpips")))
        print(summary(scores) + "".join(others))
        print(PROTOCOL)
        return scores, means


def colors_of(pixels: NDArray[np.uint8], file: Path, truth: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Colours of a rendering. Raises ValueError where it is see-through or of another size than its test image."""
    if pixels.shape[-1] == 4 and pixels[..., 3].min() < 255:
        raise ValueError(f"{file} is see-through: put it over the background that the test images have.")
    if pixels.shape[:2] != truth.shape[:2]:
        (height, width), (high, wide) = pixels.shape[:2], truth.shape[:2]
        raise ValueError(
            f"{file} has {width} x {height} pixels and its test image {wide} x {high}: render at that size, or give "
            "the --downscale-factor that was rendered at."
        )
    return torch.from_numpy(pixels[..., :3].astype(np.float32) / 255)


def evenly(count: int, most: int) -> list[int]:
    """``most`` of 0 ... count - 1, evenly spaced from half a spacing on; all where that is 0 or more than count."""
    if most <= 0 or most >= count:
        return list(range(count))
    return [int((i + 0.5) * count / most) for i in range(most)]


def markdown(content: Row) -> str:
    """The page."""
    columns = {
        "method": "{method}",
        "scene": "{scene}",
        "was given": "{given}",
        "training, s": lambda r: f"{r['seconds']:.0f}" if r["seconds"] else "",
        "memory, GiB": lambda r: f"{r['memory']:.1f}" if r.get("memory") else "",
        "frame, s": lambda r: f"{r['frame']:.2g}" if r.get("frame") else "",
        "test images": "{images}",
        "PSNR": "{psnr:.2f}",
        "SSIM": lambda r: f"{r['ssim']:.3f}" if "ssim" in r else "",
        "PSNR, colours fitted": lambda r: f"{r['cc_psnr']:.2f}" if "cc_psnr" in r else "",
        "LPIPS": lambda r: next((f"{v:.3f} ({k[6:]})" for k, v in r.items() if k.startswith("lpips")), "no weights"),
        "remark": "{remark}",
    }
    rows = list(content["rows"].values())
    values = {name: {cell(columns[name], row) for row in rows} for name in columns}
    equal = {name: v.pop() for name, v in values.items() if len(rows) > 1 and len(v) == 1}
    same = f"In all rows: {', '.join(f'{name} {value}' for name, value in equal.items())}." if equal else ""
    made = content["made"] | {"command": "python benchmarks/score.py"}  # the rows in score.json have their options
    columns = {name: c for name, c in columns.items() if name not in equal}
    return page("Images rendered by other programs", made, PROTOCOL, same, table(columns, rows))


if __name__ == "__main__":
    sys.exit(run("score", Score))
