"""``make gallery``: trains four procedural scenes for some minutes each and writes their page in the documentation."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from demo import Demo
from figures import animate, shrink

from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.scripts.command import run
from mmpi_ns.utils.machine import processor

SHOWN = {
    "street": (
        Demo(kind="street", images=64),
        "A drive of 40 m past houses and parked cars.",
    ),
    "long-road": (
        Demo(kind="long-road", images=100, length=150.0, steps=400),
        "Split into windows, each with its own MPIs.",
    ),
    "room": (
        Demo(kind="room", images=64, steps=600),
        "A walk around a table, looking in all directions.",
    ),
    "object": (
        Demo(kind="object", images=48, steps=600),
        "Filmed from all sides, for which MPIs are not made: from behind, the edges of planes are visible.",
    ),
}
"""Each scene with the options of making and training it, and a sentence about it."""
MOST_PICTURE, MOST_CLIP = 200_000, 500_000
"""Bytes of a scene's picture and clip."""
COLUMNS = {
    "scene": "[{name}](#{name})",
    "training images": "{train}",
    "size": "{size}",
    "steps": "{steps}",
    "MPIs": "{mpis}",
    "M texels": "{texels:.1f}",
    "training": "{seconds:.0f} s",
    "PSNR": "{psnr:.2f}",
    "SSIM": "{ssim:.3f}",
}


@dataclass
class Gallery:
    """Trains each procedural scene with mmpi and writes gallery.md with a picture and a clip of it. Results of an
    earlier run are kept."""

    folder: Path = Path("gallery")
    """Scenes and runs go here."""
    output: Path = Path("docs")
    """gallery.md goes here, its pictures to images/gallery below."""
    frames: int = 24
    """Frames of each clip."""
    only: tuple[str, ...] = tuple(SHOWN)
    """Scenes to show: street, long-road, room, object."""

    def main(self) -> None:
        rows = [self._show(name) for name in self.only]
        (self.output / "gallery.md").write_text(markdown(rows), encoding="utf-8")
        print(f"Wrote {self.output / 'gallery.md'}.")

    def _show(self, name: str) -> dict[str, Any]:
        """Makes, trains and evaluates a scene; writes its picture and clip; returns its row."""
        if name not in SHOWN:
            raise ValueError(f"There is no scene {name!r} in the gallery: choose from {', '.join(SHOWN)}.")
        made, says = SHOWN[name]
        demo = replace(made, folder=self.folder / name, frames=self.frames)
        results, film = demo.learn()
        started = json.loads((demo.folder / "times.json").read_text(encoding="utf-8"))["started"]
        scene = json.loads((demo.scene / "transforms.json").read_text(encoding="utf-8"))
        pictures = self.output / "images" / "gallery"
        pictures.mkdir(parents=True, exist_ok=True)
        shrink(demo.folder / "overview.png", pictures / f"{name}.jpg", MOST_PICTURE)
        animate(film, pictures / f"{name}.webp", width=320, most=MOST_CLIP)
        windows = WindowedPlan.load(demo.run / "plan.json")
        row = {"name": name, "says": says, "train": len(scene["train_filenames"]), "size": "{w} x {h}".format(**scene)}
        row |= {"seconds": demo.checkpoint.stat().st_mtime - started}
        row |= {"steps": f"{len(windows)} x {demo.steps}" if len(windows) > 1 else demo.steps}
        row |= {"mpis": sum(len(plan.mpis) for plan in windows.plans), "psnr": results["psnr"], "ssim": results["ssim"]}
        return row | {"texels": sum(plan.texels for plan in windows.plans) / 1e6}


def markdown(rows: list[dict[str, Any]]) -> str:
    """The page."""
    words = ["git", "-C", str(Path(__file__).resolve().parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    lines = [f"| {' | '.join(cell.format(**row) for cell in COLUMNS.values())} |" for row in rows]
    parts = [
        "# Gallery",
        "Four procedural scenes, trained for minutes on one core; means over the test images. The exact depths are not "
        "used.",
        "\n".join([f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS), *lines]),
        f"Made by `make gallery` on {processor()}, commit {commit}; seconds of `ns-train`, on a shared machine.",
    ]
    for row in rows:
        name = row["name"]
        parts += [
            f"## {name}",
            row["says"],
            f"![{name}: truth, rendering, depth, winning MPI, plan](images/gallery/{name}.jpg)",
            f"![{name}, from a moving camera](images/gallery/{name}.webp)",
        ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.exit(run("gallery", Gallery))
