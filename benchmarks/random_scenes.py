"""Rays as arrays through the package's own renderer, and random scenes to check kernels with, also in float64."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering.rendered import RenderedRays, render_rays
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan

Array = NDArray[Any]
"""Of float64; numpy's stubs lose that in too many operations to say so."""
CUBE = CubePlan((-1.5, -1.25, -1.0), (1.5, 1.5, 2.0), (6, 5, 4))
CLEAR = 2.0**-18
"""Rays are left out on which moving the inputs by this share changes which samples there are, their order, or (by more
than ``SAME_DEPTH``) their blended depths: there roundings may decide otherwise."""
SAME_DEPTH = 1e-2
TABLES = ("density", "features", "reliability")


def bundle_of(origins: Array, directions: Array, near: float = 0.05, far: float = math.inf) -> RayBundle:
    """float32 rays from arrays [R, 3]."""
    o, d = (torch.tensor(np.atleast_2d(x), dtype=torch.float32) for x in (origins, directions))
    column = torch.ones(len(o), 1)
    return RayBundle(origins=o, directions=d, pixel_area=column * 1e-4, nears=near * column, fars=far * column)


def in_float64(bundle: RayBundle) -> RayBundle:
    """The rays on the CPU in float64, for which every operation has its reference in plain torch alone."""
    names = ("origins", "directions", "pixel_area", "nears", "fars")
    return RayBundle(**{name: getattr(bundle, name).cpu().double() for name in names})


def render(
    field: MMPIField, rays: RayBundle, threshold: float = 0.0, blends: bool = False, **sampling: Any
) -> RenderedRays:
    """Rays without background; without gradients as images are rendered."""
    return render_rays(rays, field, MarchOptions(threshold, blends=blends), **sampling)


def of_rays(rendered: RenderedRays, values: Tensor) -> list[Tensor]:
    """Values of the samples of each ray."""
    return list(values.split(rendered.samples.starts.diff().tolist()))


@dataclass(frozen=True)
class Scene:
    """A field with random tables, rays into it, and how they are blended."""

    field: MMPIField
    bundle: RayBundle
    blends: bool = False

    def render(self, threshold: float = 0.0) -> RenderedRays:
        return render(self.field, self.bundle.to(self.field.density.device), threshold, self.blends)

    def exact(self) -> Scene:
        """The same in float64 on the CPU, for which there is plain torch alone."""
        return replace(self, field=copy.deepcopy(self.field).cpu().double(), bundle=in_float64(self.bundle))

    def clear(self) -> Scene:
        """With the rays alone on which no decision is close.

        Raises:
            ValueError: fewer than a quarter are left.
        """
        exact, kept = self.exact(), torch.ones(len(self.bundle), dtype=torch.bool)
        with torch.no_grad():
            samples, depths = samples_of(exact.render())
            for draw in range(4):
                # Every number of the rays moved by up to CLEAR of it.
                g, rays = torch.Generator().manual_seed(draw), in_float64(exact.bundle)
                draws = (2 * torch.rand(rays.origins.shape, generator=g, dtype=torch.float64) - 1 for _ in "od")
                by_origin, by_direction = (1 + CLEAR * x for x in draws)
                rays.origins, rays.directions = rays.origins * by_origin, rays.directions * by_direction
                moved = samples_of(replace(exact, bundle=rays).render())
                for i, (still, others, a, b) in enumerate(zip(samples, moved[0], depths, moved[1], strict=True)):
                    kept[i] &= len(still) > 0 and still == others and bool(((a - b).abs() <= SAME_DEPTH * a).all())
        if kept.sum() < len(kept) / 4:
            raise ValueError(f"Only {int(kept.sum())} of {len(kept)} rays are clear: choose another seed.")
        return replace(self, bundle=self.bundle[kept])


def samples_of(rendered: RenderedRays) -> tuple[list[list[tuple[int, int]]], list[Tensor]]:
    """Of each ray the (head, plane) of its samples, nearest first, and their optical depths."""
    samples = rendered.samples
    heads, planes, tau = (of_rays(rendered, x.cpu()) for x in (samples.heads, samples.planes, samples.tau))
    return [list(zip(h.tolist(), p.tolist(), strict=True)) for h, p in zip(heads, planes, strict=True)], tau


def dense_grad(table: Table) -> Tensor | None:
    """The gradient of all rows of a table; None if none was read. [T, C]"""
    if table.grad_rows is None:
        return None
    return torch.zeros_like(table.data).index_add_(0, table.grad_rows, table.grad)  # type: ignore[arg-type]


def gradients_of(field: MMPIField, rendered: RenderedRays, by: Array) -> dict[str, Tensor]:
    """Derivatives of the sum of ``by`` [R, 3] times the rays' colours, by every table."""
    field.zero_grad()
    rendered.rgb.backward(torch.tensor(by).to(rendered.rgb))
    grads = {name: dense_grad(getattr(field, name)) for name in TABLES}
    return {n: g.cpu() for n, g in grads.items() if g is not None}


def random_scene(count: int, rays: int, blends: bool, seed: int = 0, cube: CubePlan | None = None) -> Scene:
    """MPIs side by side that face about the same way, so that most points are covered by several; all texels trained,
    optical depths of a sample from 1e-3 to 1."""
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    mpis: list[MPIPlan] = []
    for k in range(count):
        turn, r = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
        axes = tuple(tuple(row) for row in (turn * np.sign(np.diag(r))).T.tolist())
        extent = tuple((rng.uniform(0.7, 1.3, 4) * [-1, 1, -1, 1]).tolist())
        origin, near = tuple((rng.normal(size=3) * 0.4).tolist()), float(rng.uniform(0.8, 1.6))
        mpis.append(MPIPlan(f"mpi{k}", origin, axes, near, extent, 12, 5, 7))  # type: ignore[arg-type]
    settings: dict[str, Any] = {"feature_channels": 5, "hidden_width": 6, "samples_per_voxel": 1.5}
    field = MMPIField(ScenePlan(tuple(mpis), cube, 0.05, 1.0), **settings).eval().requires_grad_()
    field.density.data.uniform_(-4, 2, generator=g)
    for table, size in ((field.features, 1.0), (field.reliability, 3.0), (field.networks.weights, 0.3)):
        table.data.normal_(generator=g).mul_(size)
    field.touched.fill_(1)
    aimed = [mpis[i % count] for i in range(rays)]
    origins = np.array([m.origin for m in aimed]) + rng.normal(size=(rays, 3)) * 0.6
    tangents = np.concatenate([rng.uniform(-0.6, 0.6, (rays, 2)), np.ones((rays, 1))], -1)
    targets = np.array([m.near / rng.uniform(0.1, 0.9) * (t @ np.array(m.axes)) + m.origin
                        for m, t in zip(aimed, tangents, strict=True)])  # fmt: skip
    away = targets - origins
    return Scene(field, bundle_of(origins, away / np.linalg.norm(away, axis=-1, keepdims=True)), blends)
