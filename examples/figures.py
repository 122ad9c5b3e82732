"""``make figures``: the figures of the documentation, drawn from the formulas and from ``make demo``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from mmpi_ns.scripts.command import run

SHEET, README_PICTURE = "contact-sheet.png", "contact-sheet.jpg"
"""The demo's picture that the documentation shows: source and target."""
FILM, README_FILM = "fly.mp4", "fly.webp"


@dataclass
class Figures:
    """Draws the figures of README.md and docs/."""

    demo: Path = Path("demo")
    """Folder of ``make demo``; its contact sheet is copied. Without it only the explanatory figures are drawn."""
    output: Path = Path("docs/images")
    """Folder to write."""

    def main(self) -> None:
        import drawings

        self.output.mkdir(parents=True, exist_ok=True)
        drawings.draw_merging(self.output / "merging.png")
        drawings.draw_reliability(self.output / "reliability.png")
        drawings.draw_errors(self.output / "errors.png")
        if not (self.demo / SHEET).is_file():
            raise ValueError(f"{self.demo} lacks {SHEET}: run make demo first (the other figures are written).")
        shrink(self.demo / SHEET, self.output / README_PICTURE)
        animate(self.demo / FILM, self.output / README_FILM)
        print(f"Wrote merging.png, reliability.png, errors.png, {README_PICTURE} and {README_FILM} in {self.output}.")


def shrink(source: Path, target: Path, most: int = 400_000) -> None:
    """Copies a picture as JPEG, at the best quality that fits into this many bytes."""
    from PIL import Image

    image = Image.open(source).convert("RGB")
    for quality in (92, 88, 84, 80, 75, 70, 65, 60):
        image.save(target, quality=quality, subsampling=0)
        if target.stat().st_size <= most:
            return
    target.unlink()
    raise ValueError(f"{source} is larger than {most // 1000} kB even as a poor JPEG: draw less in it.")


def animate(source: Path, target: Path, width: int = 480, rate: int = 12, most: int = 1_200_000) -> None:
    """Copies a film as an animated WebP, at the best quality that fits into this many bytes."""
    import av
    from PIL import Image

    with av.open(str(source)) as container:
        frames = [frame.to_image() for frame in container.decode(video=0)]
    height = round(frames[0].height * width / frames[0].width)
    frames = [frame.resize((width, height), Image.Resampling.LANCZOS) for frame in frames]
    for quality in (80, 70, 60, 50, 40, 30):
        times = {"duration": 1000 // rate, "loop": 0}
        frames[0].save(target, save_all=True, append_images=frames[1:], quality=quality, method=4, **times)
        if target.stat().st_size <= most:
            return
    target.unlink()
    raise ValueError(f"{source} is larger than {most // 1000} kB even as a poor WebP: film fewer frames.")


if __name__ == "__main__":
    sys.exit(run("figures", Figures))
