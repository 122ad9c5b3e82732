"""``mmpi-bench dense``: made-up MPIs rendered by us and by a plain dense evaluation of all their planes."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from mmpi_ns.bench.apart import run_apart
from mmpi_ns.bench.report import Bench, Report, page, table
from mmpi_ns.bench.speed.scaling import BASE, measure


@dataclass
class Dense(Bench):
    """Steps of a joint training on K = 4 MPIs of 64 planes of 96 x 256 with 1,024 rays: ours and plain dense."""

    steps: int = 30
    """Timed steps of each path, after as many untimed ones (densities sharpen, which ours profits from)."""
    rays: int = 1024
    """Rays a step."""

    name = "dense"

    def run(self) -> None:
        report = Report(self, self.key())
        request = {**asdict(replace(BASE, rays=self.rays)), "steps": self.steps}
        for path in ("ours", "dense"):
            asked = {**request, "dense": path == "dense"}
            row = report.row(path, lambda asked=asked: run_apart(measure, asked, self.folder, self.cores))
            row["rays_per_s"] = 1e3 * self.rays / row["step_ms"]
        ours, dense = report.rows["ours"], report.rows["dense"]
        head = {"rays_per_s": ours["rays_per_s"], "dense_rays_per_s": dense["rays_per_s"]}
        head["ratio"] = dense["step_ms"] / ours["step_ms"]
        columns = {"path": "{path}", "ms a step (median)": "{step_ms:.0f}", "rays/s": "{rays_per_s:.0f}"}
        columns |= {"peak memory, GiB": "{peak_gib:.2f}", "samples a ray": "{live:.0f}"}
        said = f"Ours takes 1/{head['ratio']:.1f} of the time of the dense evaluation of the same planes."
        rows = table(columns, ({"path": k} | r for k, r in report.rows.items()))
        report.finish(head, page("Cost follows live samples", report.content["made"], rows, said))
        print(rows, said, sep="\n")
