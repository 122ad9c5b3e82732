"""``mmpi-bench gpu``: all that matters on a GPU in under ten minutes, correctness first, without a network."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from mmpi_ns.bench.apart import run_apart
from mmpi_ns.bench.gpu.parts import run_part
from mmpi_ns.bench.gpu.quick import run_quick
from mmpi_ns.bench.gpu.report import draw, markdown
from mmpi_ns.bench.methods import JOINT, METHODS, Method, has_pycolmap
from mmpi_ns.bench.report import Bench, Report, Row, Scene, slug
from mmpi_ns.bench.trainings import Request, train_apart

SHARES = {
    "checks": 0.15,
    "operations": 0.1,
    "training triton": 0.15,
    "training torch": 0.12,
    "kitti": 0.2,
    "quality": 0.28,
}
"""The parts in the order in which they run, and their shares of the time; what one leaves, the next ones have."""
PEERS = {"mmpi": 3000, "nerfacto": 3000, "splatfacto": 5000}
"""Whose error is followed over time, and for how many steps at most."""
QUICK_RAYS = 1024
"""Of a step that ``--quick`` times."""
GRACE = 60.0
"""Seconds that a part may run beyond its time before it is ended from outside: starting Python takes ten."""


@dataclass
class Gpu(Bench):
    """Kernels against float64, then training, frames, the paper's KITTI size, and error over time, on one GPU.

    Every part runs in a process of its own within its share of the time: one that fails is recorded, and the others go
    on. Ends with status 1 where a kernel is wrong.
    """

    data: Path | None = None
    """A drive (a folder with transforms.json); a procedural street is made where none is given."""
    downscale_factor: int = 1
    """Image size to use."""
    seconds: float = 560.0
    """For everything."""
    parts: tuple[str, ...] = tuple(SHARES)
    """Which parts to run."""
    rehearse: bool = False
    """Run everything in miniature on a CPU, the kernels by Triton's interpreter: to see that it runs, not how fast."""
    quick: bool = False
    """In a minute: what there is, whether every kernel does what it should, and the time of a step and a frame. Without
    a GPU, the same of this processor."""

    name = "gpu"

    def run(self) -> None:
        if self.quick:
            data = self._street(self.folder / "quick-street", 10, 155, 47, 400)
            report = Report(self, key=None, file="gpu-quick")
            report.rows.update(run_quick(data, (self.folder / "quick").resolve(), QUICK_RAYS))
            report.save()
            return
        self._check()
        start, report = time.monotonic(), Report(self, key=None)
        made, rows = report.content["made"], report.rows
        data, report.content["rehearsal"] = self._scene(), self.rehearse
        made["scene_seconds"] = time.monotonic() - start
        made["tracks"] = "of the data set" if has_pycolmap() else "none: pycolmap is not installed"
        for number, name in enumerate(self.parts):
            left = self.seconds - (time.monotonic() - start)
            share = SHARES[name] / sum(SHARES[n] for n in self.parts[number:])
            print(f"{name}: {max(0.0, left * share):.0f} s ...", flush=True)
            begin = time.monotonic()
            found = self._part(name, data, left * share) if left > 0 else {"not_run": "no time was left"}
            rows[name] = {**found, "wall_s": time.monotonic() - begin}
            head = {k: v for part in rows.values() for k, v in part.get("headline", {}).items()}
            curves = rows.get("quality", {}).get("curves", {})
            report.finish(head, markdown(report.content, head), lambda path, curves=curves: draw(path, curves))
        head = report.content["headline"]
        print(head)
        wrong = [name for name, part in rows.items() if "not_run" in part] if self.rehearse else []
        if head.get("failed_checks") or wrong:
            raise SystemExit(
                f"mmpi-bench: a kernel is wrong or a rehearsed part failed ({', '.join(wrong) or 'checks'})."
            )

    def _check(self) -> None:
        """Raises ValueError where nothing could be measured."""
        if unknown := set(self.parts) - set(SHARES):
            raise ValueError(f"There is no part {sorted(unknown)[0]!r}: choose from {', '.join(SHARES)}.")
        if not self.rehearse and not torch.cuda.is_available():
            raise ValueError(
                "gpu measures a CUDA device, and torch sees none: run it where there is one, or --rehearse on a CPU."
            )
        if self.data is not None and not self.data.exists():
            raise ValueError(f"There is no scene at {self.data}: check --data.")

    def _scene(self) -> Path:
        """The data set, or a street that is made now."""
        if self.data is not None:
            return self.data.resolve()
        sizes = (10, 40, 12, 150) if self.rehearse else (40, 621, 188, 4000)
        return self._street(self.folder / "street", *sizes)

    @staticmethod
    def _street(folder: Path, count: int, width: int, height: int, points: int) -> Path:
        """A procedural scene, made where it is not there yet."""
        from mmpi_ns.synthetic.catalogue import make_scene
        from mmpi_ns.synthetic.dataset import write_dataset

        if not (folder / "transforms.json").is_file():
            print(f"Making a street of {width} x {height} pixels ...", flush=True)
            scene = make_scene("street", count=count, width=width, height=height)
            write_dataset(scene, folder, points=points, tracks=has_pycolmap(), overwrite=True)
        return folder.resolve()

    def _part(self, name: str, data: Path, seconds: float) -> Row:
        if name == "quality":
            return self._quality(data, seconds)
        part, _, ops = name.partition(" ")
        request = {"part": part, "ops": ops, "device": self._device, "rehearse": self.rehearse}
        request |= {"data": str(data), "downscale_factor": self.downscale_factor, "work": str(self.folder.resolve())}
        request["seconds"] = max(5.0, seconds - 15)  # less what it takes to start
        return run_apart(run_part, request, self.folder / slug(name, "-"), *self._how(seconds + GRACE))

    @property
    def _device(self) -> str:
        return "cpu" if self.rehearse else "cuda"

    def _how(self, seconds: float) -> tuple[int, float, dict[str, str]]:
        """Threads, seconds and variables of a part's process; this one runs no kernel."""
        hidden = {"TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": ""} if self.rehearse else {}
        return 1 if self.rehearse else self.cores, seconds, hidden

    def _quality(self, data: Path, seconds: float) -> Row:
        """PSNR of test views against seconds of training: ours, nerfacto and splatfacto."""
        said, curves, head = {}, {}, {}
        names, few = (("mmpi",), 1) if self.rehearse else (tuple(PEERS), 4)
        for number, name in enumerate(names):
            begin, method = time.monotonic(), METHODS[name]
            if method.ours:
                method = Method(name, name, (*JOINT, *(TINY if self.rehearse else ())))
            if reason := method.why_not():
                said[name] = {"curve (s: dB)": f"not run: {reason}"}
                continue
            limit = seconds / (len(names) - number) + (GRACE if self.rehearse else 0)
            steps = 4 if self.rehearse else PEERS[name]
            checks = sorted({max(1, round(steps * 2.0**-i)) for i in range(9)} | {round(steps * 3 / 4)})
            looks: Row = {"checks": tuple(checks), "check_images": few, "check_pixels": 1024 * few, "final_images": few}
            scene, folder = Scene(data, self.downscale_factor), self.folder / f"quality-{name}"
            row = train_apart(Request.of(method, scene, folder, steps, device=self._device, **looks), *self._how(limit))
            curve = row["curve"] if "curve" in row else told_curve(folder)
            told = ", ".join(f"{p['seconds']:.0f}: {p['psnr']:.2f}" for p in curve)
            said[name] = {"curve (s: dB)": told or f"not run: {row['not_run']}"}
            if curve:
                best, curves[name] = max(curve, key=lambda point: point["psnr"]), curve
                head |= {f"{name}_psnr_db": best["psnr"], f"{name}_seconds": best["seconds"]}
            seconds -= time.monotonic() - begin
        found: Row = {"headline": head, "curves": curves, "tables": {"PSNR of test views on the way.": said}}
        return found if curves else {"not_run": str(said), **found}


TINY = (
    *("--pipeline.datamanager.train-num-rays-per-batch", "16", "--pipeline.datamanager.keypoint-rays", "4"),
    *("--pipeline.model.placement.max-planes", "12", "--pipeline.model.placement.max-texels", "20000"),
    *("--pipeline.model.hidden-width", "8"),
)
"""For a rehearsal."""


def told_curve(folder: Path) -> list[dict[str, float]]:
    """What a training that was ended early had said of itself."""
    log = folder / "output.log"
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    found = re.findall(r"step (\d+): (\d+) s of training, ([\d.]+) dB", text)
    return [{"step": int(a), "seconds": float(b), "psnr": float(c)} for a, b, c in found]
