"""Exact solids baked into MPIs without training; how errors fall with planes, texels and K."""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lab import figure
from plane_crossings import AHEAD
from random_scenes import Array, bundle_of, render
from report import Bench, Report, Row, page, table
from solids import Solids, bake

from mmpi_ns.ops.composite import median_inverse_distance
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scripts.command import run

SLANTED = Solids((-0.3, 0.2, 1.0), 6.0, ball=(-0.4, 0.3, 4.2, 0.9))
"""A slanted wall with a ball before it."""
EXTENT = (-1.0, 1.0, -0.8, 0.8)
PLANES = (9, 17, 33, 65, 129, 257)
TEXELS = (9, 17, 33, 65, 129)
COUNTS = (1, 2, 3, 4, 6)
THRESHOLD = 1e-4
"""Samples of less weight are not coloured: hundreds lie behind the first that is opaque."""
FORMS = ("joint", "blended")


@dataclass
class Accuracy(Bench):
    """Depth and colour error of exact tables against exact images, over planes, texels and number of MPIs."""

    name = "accuracy"

    def run(self) -> None:
        report = Report(self, key=None)
        report.content["rows"] = rows = {"planes": by_planes(), "texels": by_texels(), "mpis": by_count()}
        head = headline(rows)
        report.finish(head, markdown(rows, head, report.content["made"]), lambda path: draw(path, rows))
        print(head)


def cameras() -> tuple[Array, Array]:
    """Rays of five cameras that stand up to 0.5 units beside the first MPI, all facing the wall."""
    tangents = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 24), np.linspace(-0.35, 0.35, 18)), -1).reshape(-1, 2)
    directions = np.concatenate([tangents, np.ones((len(tangents), 1))], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    places = np.array([[0.5, 0.1, 0.1], [-0.4, 0.3, 0.0], [0.1, -0.4, 0.3], [-0.2, -0.1, -0.3], [0.3, 0.3, 0.2]])
    origins = np.repeat(places, len(directions), axis=0)
    return origins, np.tile(directions, (len(places), 1))


def measure(solids: Solids, mpis: list[MPIPlan], blends: bool = False) -> dict[str, float]:
    """Mean errors over all rays. Depth is compared in inverse distance, in which planes are evenly spaced."""
    origins, directions = cameras()
    field = bake(solids, mpis)
    with torch.no_grad():
        results = render(field, bundle_of(origins, directions), THRESHOLD, blends)
    t = solids.hit(origins, directions)
    exact = solids.color(origins + t[:, None] * directions)
    inverse_t = median_inverse_distance(results.composite.weights, results.samples.inverse_t, results.samples.starts)
    depth = np.abs(inverse_t[:, 0].double().numpy() - 1 / t)
    color = np.abs(results.rgb.double().numpy() - exact).mean(-1)
    return {"depth_error": float(depth.mean()), "color_error": float(color.mean())}


def front(planes: int, height: int, width: int) -> MPIPlan:
    """An MPI at the world's origin that faces the wall."""
    return MPIPlan("front", (0.0, 0.0, 0.0), AHEAD, 2.5, EXTENT, planes, height, width)


def expected_depth_error(solids: Solids, mpi: MPIPlan) -> float:
    """Half the distance between two planes along the ray: a surface lies anywhere between them."""
    origins, directions = cameras()
    t = solids.hit(origins, directions)
    w = 1 / (origins[:, 2] + t * directions[:, 2])
    step = 1 / (mpi.near * (mpi.planes - 1))
    return float((0.5 * step * directions[:, 2] / (1 - w * origins[:, 2]) ** 2).mean())


def by_planes() -> list[Row]:
    """One MPI, ever more planes."""
    rows = []
    for planes in PLANES:
        mpi = front(planes, 97, 121)
        row = {"planes": planes, **measure(SLANTED, [mpi]), "expected_depth_error": expected_depth_error(SLANTED, mpi)}
        print("{planes} planes: depth {depth_error:.2e}, colour {color_error:.2e}".format(**row), flush=True)
        rows.append(row)
    return with_orders(rows, "planes", "depth_error", "color_error")


def by_texels() -> list[Row]:
    """One MPI with a plane in a flat wall: no depth error, the texture's interpolation alone."""
    rows = []
    for texels in TEXELS:
        wall = Solids((0.0, 0.0, 1.0), 2.5 * 8 / 3)  # the plane with disparity 3 steps above infinity
        rows.append({"texels": texels, **measure(wall, [front(9, texels, texels)])})
        print("{texels} x {texels} texels: colour {color_error:.2e}".format(**rows[-1]), flush=True)
    return with_orders(rows, "texels", "color_error")


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


def by_count() -> list[Row]:
    """Ever more MPIs of 17 planes each, merged without reliability and blended with equal reliability."""
    rows = []
    for count in COUNTS:
        row: Row = {"mpis": count} | {form: measure(SLANTED, several(count), form == "blended") for form in FORMS}
        print("{mpis} MPIs: depth {joint[depth_error]:.2e}, colour {joint[color_error]:.2e}".format(**row), flush=True)
        rows.append(row)
    return rows


def order(sizes: list[float], errors: list[float]) -> float:
    """Slope of log error over log size."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def with_orders(rows: list[Row], size: str, *errors: str) -> list[Row]:
    """The rows with the order of each error that is observed between a row and the one before it."""
    for before, row in itertools.pairwise(rows):
        for what in errors:
            both = [1 / (r[size] - 1) for r in (before, row)], [r[what] for r in (before, row)]
            row[f"{what}_order"] = f"{order(*both):.2f}"
    return [dict.fromkeys((f"{e}_order" for e in errors), "-") | row for row in rows]


def headline(rows: dict[str, list[Row]]) -> dict[str, float]:
    """Observed orders, and by how much an added MPI ever raised an error."""
    spacing = [1 / (r["planes"] - 1) for r in rows["planes"]]
    width = [1 / (r["texels"] - 1) for r in rows["texels"]]
    rises = [
        b["joint"][what] / a["joint"][what] - 1
        for a, b in itertools.pairwise(rows["mpis"])
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


def markdown(rows: dict[str, list[Row]], head: dict[str, float], made: Row) -> str:
    """The page."""
    intro = """\
A slanted wall and a ball before it, with a smooth texture, are written into the texels without training: a texel
is opaque where its point lies inside a solid, and has that point's colour. Means over 432 rays of each of five
cameras, up to 0.53 units from the MPI. Depth is compared as 1/t."""
    orders = [
        {"error": "depth", "with": "plane spacing", "expected": 1, "found": head["depth_order_in_planes"]},
        {"error": "colour", "with": "plane spacing", "expected": 1, "found": head["color_order_in_planes"]},
        {"error": "colour", "with": "texel size", "expected": 2, "found": head["color_order_in_texels"]},
    ]
    columns = {"error": "{error}", "falls with": "{with}", "expected order": "{expected}", "observed": "{found:.2f}"}
    half = f"""\
The expected depth error is half a plane spacing along the ray; the finest is \
{head["depth_error_over_expected"]:.2f} times that. The least helpful of all added MPIs changed an error by \
{100 * head["largest_change_with_an_added_mpi"]:+.0f} % (merged jointly)."""
    planes = table(
        {
            "planes": "{planes}",
            "depth error": "{depth_error:.2e}",
            "half a spacing": "{expected_depth_error:.2e}",
            "order": "{depth_error_order}",
            "colour error": "{color_error:.2e}",
            "order ": "{color_error_order}",
        },
        rows["planes"],
    )
    texels = {"texels": "{texels} x {texels}", "colour error": "{color_error:.2e}", "order": "{color_error_order}"}
    by_form = {"K": "{mpis}"}
    for form in FORMS:
        by_form |= {f"{form}: depth": f"{{{form}[depth_error]:.2e}}", f"{form}: colour": f"{{{form}[color_error]:.2e}}"}
    merged = """\
K MPIs of 17 planes around the cameras. *Joint*: merged without reliability. *Blended*: with equal reliability
everywhere, so that K opaque samples have a transmittance of (1 - 1/K)^K."""
    blocks = [intro, table(columns, orders), half, "![Errors over planes, texels and MPIs](accuracy.png)"]
    blocks += ["## Planes", "One MPI, 121 x 97 texels.", planes, "## Texels"]
    blocks += ["A flat wall in a plane of the MPI: only the texture is interpolated."]
    blocks += [table(texels, rows["texels"]), "## MPIs", merged, table(by_form, rows["mpis"])]
    return page("Accuracy on exact geometry", made, blocks)


def draw(path: Path, rows: dict[str, list[Row]]) -> None:
    """Three panels: planes, texels, MPIs."""
    planes, texels, mpis = rows["planes"], rows["texels"], rows["mpis"]
    with figure(path, 1, 3, (10, 3.2)) as ((left, middle, right),):
        x = [r["planes"] - 1 for r in planes]
        left.loglog(x, [r["depth_error"] for r in planes], "o-", label="depth (1/t)")
        left.loglog(x, [r["color_error"] for r in planes], "s-", label="colour")
        left.loglog(x, [r["expected_depth_error"] for r in planes], "k--", lw=1, label="half a spacing (order 1)")
        left.set(xlabel="planes - 1", ylabel="mean error", title="one MPI, wall and ball")
        x, errors = np.array([r["texels"] - 1.0 for r in texels]), np.array([r["color_error"] for r in texels])
        middle.loglog(x, errors, "s-", color="C1", label="colour")
        middle.loglog(x, errors[0] * (x[0] / x) ** 2, "k--", lw=1, label="order 2")
        middle.set(xlabel="texels - 1", title="one MPI, wall in a plane")
        for form, style in zip(FORMS, ("o-", "^:"), strict=True):
            for what, color in (("depth", "C0"), ("color", "C1")):
                errors = [r[form][f"{what}_error"] for r in mpis]
                right.plot([r["mpis"] for r in mpis], errors, style, color=color, label=f"{what}, {form}")
        right.set(xlabel="MPIs of 17 planes", title="K MPIs", ylim=(0, None))


if __name__ == "__main__":
    sys.exit(run("accuracy", Accuracy))
