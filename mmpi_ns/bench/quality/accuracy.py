"""``mmpi-bench accuracy``: exact solids baked into MPIs without training; how errors fall with planes, texels and K."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mmpi_ns.bench.provenance import stamp, stamp_line, write_json
from mmpi_ns.bench.quality.solids import Solids, bake
from mmpi_ns.bench.rendering import bundle_of, render
from mmpi_ns.bench.stability.exact import Array
from mmpi_ns.ops.compositing import BlendForm
from mmpi_ns.scene.plan import MPIPlan

SLANTED = Solids((-0.3, 0.2, 1.0), 6.0, ball=(-0.4, 0.3, 4.2, 0.9))
"""A slanted wall with a ball before it."""
EXTENT = (-1.0, 1.0, -0.8, 0.8)
PLANES = (9, 17, 33, 65, 129, 257)
TEXELS = (9, 17, 33, 65, 129)
COUNTS = (1, 2, 3, 4, 6)
THRESHOLD = 1e-4
"""Samples of less weight are not coloured: hundreds lie behind the first that is opaque."""
FORMS: tuple[BlendForm | None, ...] = (None, "paper", "opacity")


@dataclass
class Accuracy:
    """Depth and colour error of exact tables against exact images, over planes, texels and number of MPIs."""

    output: Path = Path("docs/results")
    """Where accuracy.json, accuracy.md and accuracy.png go."""

    def run(self) -> None:
        made = stamp("accuracy", self)
        rows = {"planes": by_planes(), "texels": by_texels(), "mpis": by_count()}
        content = {"headline": headline(rows), "made": made, **rows}
        write_json(self.output / "accuracy.json", content)
        (self.output / "accuracy.md").write_text(table(content), encoding="utf-8")
        draw(self.output / "accuracy.png", content)
        print(content["headline"])


def cameras() -> tuple[Array, Array]:
    """Rays of five cameras that stand up to 0.5 units beside the first MPI, all facing the wall."""
    tangents = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 24), np.linspace(-0.35, 0.35, 18)), -1).reshape(-1, 2)
    directions = np.concatenate([tangents, np.ones((len(tangents), 1))], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    places = np.array([[0.5, 0.1, 0.1], [-0.4, 0.3, 0.0], [0.1, -0.4, 0.3], [-0.2, -0.1, -0.3], [0.3, 0.3, 0.2]])
    origins = np.repeat(places, len(directions), axis=0)
    return origins, np.tile(directions, (len(places), 1))


def measure(solids: Solids, mpis: list[MPIPlan], form: BlendForm | None = None) -> dict[str, float]:
    """Mean errors over all rays. Depth is compared in inverse distance, in which planes are evenly spaced."""
    origins, directions = cameras()
    field = bake(solids, mpis)
    with torch.no_grad():
        found = render(field, bundle_of(origins, directions), THRESHOLD, form)
    t = solids.hit(origins, directions)
    exact = solids.color(origins + t[:, None] * directions)
    depth = np.abs(found.median_inverse_distance().double().numpy() - 1 / t)
    color = np.abs(found.rgb.double().numpy() - exact).mean(-1)
    return {"depth_error": float(depth.mean()), "color_error": float(color.mean())}


def front(planes: int, height: int, width: int) -> MPIPlan:
    """An MPI at the world's origin that faces the wall."""
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return MPIPlan("front", (0.0, 0.0, 0.0), axes, 2.5, EXTENT, planes, height, width)


def expected_depth_error(solids: Solids, mpi: MPIPlan) -> float:
    """Half the distance between two planes along the ray: a surface lies anywhere between them."""
    origins, directions = cameras()
    t = solids.hit(origins, directions)
    w = 1 / (origins[:, 2] + t * directions[:, 2])
    step = 1 / (mpi.near * (mpi.planes - 1))
    return float((0.5 * step * directions[:, 2] / (1 - w * origins[:, 2]) ** 2).mean())


def by_planes() -> list[dict[str, Any]]:
    """One MPI, ever more planes."""
    rows = []
    for planes in PLANES:
        mpi = front(planes, 97, 121)
        row = {"planes": planes, **measure(SLANTED, [mpi]), "expected_depth_error": expected_depth_error(SLANTED, mpi)}
        print(f"{planes} planes: depth {row['depth_error']:.2e}, colour {row['color_error']:.2e}", flush=True)
        rows.append(row)
    return rows


def by_texels() -> list[dict[str, Any]]:
    """One MPI with a plane in a flat wall: no depth error, the texture's interpolation alone."""
    rows = []
    for texels in TEXELS:
        mpi = front(9, texels, texels)
        wall = Solids((0.0, 0.0, 1.0), 2.5 * 8 / 3)  # the plane with disparity 3 steps above infinity
        row = {"texels": texels, **measure(wall, [mpi])}
        print(f"{texels} x {texels} texels: colour {row['color_error']:.2e}", flush=True)
        rows.append(row)
    return rows


def several(count: int, planes: int = 17) -> list[MPIPlan]:
    """MPIs around the cameras, turned and with other near planes; the first ``count`` of one list."""
    rng = np.random.default_rng(0)
    mpis = [front(planes, 97, 121)]
    for k in range(1, count):
        a, b = rng.uniform(-0.08, 0.08, 2)
        turn = np.array([[1, 0, -a], [0, 1, -b], [a, b, 1.0]])
        q, r = np.linalg.qr(turn.T)
        axes = tuple(tuple(float(x) for x in row) for row in (q * np.sign(np.diag(r))).T)
        origin = tuple(float(x) for x in rng.uniform([-0.6, -0.5, -0.5], [0.6, 0.5, 0.1]))
        mpis.append(MPIPlan(f"mpi{k}", origin, axes, float(rng.uniform(2.2, 2.8)), EXTENT, planes, 97, 121))  # type: ignore[arg-type]
    return mpis


def by_count() -> list[dict[str, Any]]:
    """Ever more MPIs of 17 planes each, merged without reliability and with equal reliability in both forms."""
    rows = []
    for count in COUNTS:
        row: dict[str, Any] = {"mpis": count}
        for form in FORMS:
            row[form or "joint"] = measure(SLANTED, several(count), form)
        print(
            f"{count} MPIs: depth {row['joint']['depth_error']:.2e}, colour {row['joint']['color_error']:.2e}",
            flush=True,
        )
        rows.append(row)
    return rows


def order(sizes: list[float], errors: list[float]) -> float:
    """Slope of log error over log size."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def headline(rows: dict[str, list[dict[str, Any]]]) -> dict[str, float]:
    """Observed orders, and by how much an added MPI ever raised an error."""
    spacing = [1 / (r["planes"] - 1) for r in rows["planes"]]
    width = [1 / (r["texels"] - 1) for r in rows["texels"]]
    rises = [
        b["joint"][what] / a["joint"][what] - 1
        for a, b in zip(rows["mpis"], rows["mpis"][1:], strict=False)
        for what in ("depth_error", "color_error")
    ]
    finest = rows["planes"][-1]
    return {
        "depth_order_in_planes": order(spacing, [r["depth_error"] for r in rows["planes"]]),
        "color_order_in_planes": order(spacing, [r["color_error"] for r in rows["planes"]]),
        "color_order_in_texels": order(width, [r["color_error"] for r in rows["texels"]]),
        "depth_error_over_expected": finest["depth_error"] / finest["expected_depth_error"],
        "largest_change_with_an_added_mpi": max(rises),
    }


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    head = content["headline"]
    lines = [
        "# Accuracy on exact geometry",
        "",
        stamp_line(content["made"]),
        "",
        "A slanted wall and a ball before it, both filled with a smooth texture, are written into the texels as they",
        "are: a texel is opaque where its point lies inside a solid, and has that point's colour. No training. Five",
        "cameras up to 0.53 units from the MPI, 432 rays each; errors are means over all rays. Depth is compared as",
        "1/t, in which planes are evenly spaced.",
        "",
        "| error | falls with | expected order | observed |",
        "|---|---|---|---|",
        f"| depth | plane spacing | 1 | {head['depth_order_in_planes']:.2f} |",
        f"| colour | plane spacing | 1 | {head['color_order_in_planes']:.2f} |",
        f"| colour | texel size | 2 | {head['color_order_in_texels']:.2f} |",
        "",
        "The first plane inside a solid is hit, so the depth error should be half a plane's spacing along the ray: the",
        f"finest is {head['depth_error_over_expected']:.2f} times that. Of all added MPIs the least helpful changed an "
        f"error by {100 * head['largest_change_with_an_added_mpi']:+.0f} % (merged jointly).",
        "",
        "![Errors over planes, texels and MPIs](accuracy.png)",
        "",
        *_planes_table(content["planes"]),
        *_texels_table(content["texels"]),
        *_count_table(content["mpis"]),
    ]
    return "\n".join([*lines, ""])


def _planes_table(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["## Planes", "", "One MPI, 121 x 97 texels.", ""]
    lines += ["| planes | depth error | half a spacing | order | colour error | order |", "|---|---|---|---|---|---|"]
    for row, before in zip(rows, [None, *rows], strict=False):
        orders = [_step(before, row, what, "planes") for what in ("depth_error", "color_error")]
        cells = f"{row['depth_error']:.2e} | {row['expected_depth_error']:.2e} | {orders[0]} | {row['color_error']:.2e}"
        lines.append(f"| {row['planes']} | {cells} | {orders[1]} |")
    return lines


def _texels_table(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["", "## Texels", "", "A flat wall that lies in a plane of the MPI: only the texture is interpolated.", ""]
    lines += ["| texels | colour error | order |", "|---|---|---|"]
    for row, before in zip(rows, [None, *rows], strict=False):
        cells = f"{row['color_error']:.2e} | {_step(before, row, 'color_error', 'texels')}"
        lines.append(f"| {row['texels']} x {row['texels']} | {cells} |")
    return lines


def _count_table(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "",
        "## MPIs",
        "",
        "K MPIs of 17 planes around the cameras. *Joint*: merged without reliability, as trained together. *Paper* and",
        "*opacity*: blended with equal reliability everywhere, before it has learned anything. The paper's form then",
        "lets (1 - 1/K)^K of the light through K opaque samples and mixes in what lies deeper.",
        "",
    ]
    lines += ["| K | joint: depth | colour | paper: depth | colour | opacity: depth | colour |", "|---" * 7 + "|"]
    for row in rows:
        cells = [f"{row[f or 'joint'][what]:.2e}" for f in FORMS for what in ("depth_error", "color_error")]
        lines.append(f"| {row['mpis']} | {' | '.join(cells)} |")
    return lines


def _step(before: dict[str, Any] | None, row: dict[str, Any], what: str, size: str) -> str:
    """Order observed between two neighbouring rows."""
    if before is None:
        return "-"
    return f"{order([1 / (r[size] - 1) for r in (before, row)], [r[what] for r in (before, row)]):.2f}"


def draw(path: Path, content: dict[str, Any]) -> None:
    """Three panels: planes, texels, MPIs."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
    planes, texels, mpis = content["planes"], content["texels"], content["mpis"]
    x = np.array([r["planes"] - 1.0 for r in planes])
    left.loglog(x, [r["depth_error"] for r in planes], "o-", label="depth (1/t)")
    left.loglog(x, [r["color_error"] for r in planes], "s-", label="colour")
    left.loglog(x, [r["expected_depth_error"] for r in planes], "k--", lw=1, label="half a spacing (order 1)")
    left.set(xlabel="planes - 1", ylabel="mean error", title="one MPI, wall and ball")
    x = np.array([r["texels"] - 1.0 for r in texels])
    errors = np.array([r["color_error"] for r in texels])
    middle.loglog(x, errors, "s-", color="C1", label="colour")
    middle.loglog(x, errors[0] * (x[0] / x) ** 2, "k--", lw=1, label="order 2")
    middle.set(xlabel="texels - 1", title="one MPI, wall in a plane")
    for form, style in zip(FORMS, ("o-", "^:", "v:"), strict=True):
        name = form or "joint"
        right.plot(
            [r["mpis"] for r in mpis], [r[name]["depth_error"] for r in mpis], style, color="C0", label=f"depth, {name}"
        )
        right.plot(
            [r["mpis"] for r in mpis],
            [r[name]["color_error"] for r in mpis],
            style,
            color="C1",
            label=f"colour, {name}",
        )
    right.set(xlabel="MPIs of 17 planes", title="K MPIs", ylim=(0, None))
    for axes in (left, middle, right):
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=90)
    plt.close(figure)
