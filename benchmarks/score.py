"""PSNR, SSIM and LPIPS of test images that any program has rendered, as a row of a table."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from report import Bench, Report, Row, page, table

from mmpi_ns.bench.score import PROTOCOL, Score
from mmpi_ns.scripts.command import run


@dataclass(kw_only=True)
class ScoreRow(Bench, Score):
    """Scores renderings as mmpi-bench score does, and writes a row into score.json and score.md."""

    method: str
    """Name of what made the images."""
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
        report = Report(self)
        scene = f"{self.data.resolve().name} /{self.downscale_factor}"
        row: Row = {"method": self.method, "scene": scene, "given": self.given, "seconds": self.seconds}
        row |= {"frame": self.frame, "memory": self.memory, "remark": self.remark}
        row |= {"images": len(scores), **means, "each": dict(scores)}
        row |= {"command": report.content["made"]["command"]}
        report.rows[f"{self.method} on {scene}, {len(scores)} images"] = row
        head = {f"{key}: {k}": r[k] for key, r in report.rows.items() for k in means if k in r}
        report.finish(head, markdown(report.content))


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
    return page("Images rendered by other programs", content["made"], PROTOCOL, table(columns, rows))


if __name__ == "__main__":
    sys.exit(run("score", ScoreRow))
