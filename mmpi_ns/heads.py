"""The heads of a field: K multi-plane images, and the cube (paper sec. III-A and III-B).

A head is a view of its part of the pooled tables. It maps points to its NDC, samples rays on its planes, and
interpolates its texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.ops.march import Rays
from mmpi_ns.scene.geometry import Frames, PlaneHits, inverse_distance, local_rays, local_to_ndc, sample_disparity
from mmpi_ns.scene.texels import TexelGrid

Texels = tuple[Int[Tensor, "N T"], Float[Tensor, "N T"]]
"""Rows of the pooled tables and their weights: four on a plane, eight between planes and in the cube."""


@dataclass(frozen=True)
class Head:
    """One head of a scene."""

    layout: SceneLayout
    number: int
    """Index among the heads of the field; the cube comes last."""

    @property
    def grid(self) -> TexelGrid:
        """Its texels in the pooled tables."""
        return self.layout.grids[self.number]

    def optical_depth(
        self, density: Float[Tensor, "T 1"], texels: Texels, planes: Int[Tensor, "N"]
    ) -> Float[Tensor, "N"]:
        """tau of samples, of which alpha = 1 - exp(-tau) (paper sec. III-A).

        Args:
            density: the pooled table of raw densities.
            texels: of the samples.
            planes: of the samples; meaningless in the cube.
        """
        return self.layout.optical_depth(self.number, interpolate(density, *texels)[:, 0], planes)

    def values(self, table: Float[Tensor, "T C"], ndc: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
        """Interpolated values of a pooled table (features, reliability) at positions in the head, also between
        planes."""
        return interpolate(table, *self.grid.trilinear(ndc))

    def covers(self, touched: Tensor, ndc: Float[Tensor, "N 3"], inside: Bool[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether the head covers positions: inside of it, and the nearest texel was trained (paper sec. III-C)."""
        return inside & (touched[self.grid.nearest(ndc)] > 0)


@dataclass(frozen=True)
class MPIHead(Head):
    """A multi-plane image: planes evenly spaced in disparity in the frustum of its frame."""

    @property
    def frame(self) -> Frames:
        """Its frame alone."""
        return Frames(*(x[self.number : self.number + 1] for x in vars(self.layout.frames).values()))

    def place_on_rays(
        self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], inverse_t: Float[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """NDC (u, v, s) of a point at an inverse distance along each ray, each in [-1, 1] over the frustum, and whether
        the points lie inside of it."""
        frame = self.frame
        o, d = local_rays(origins, directions, frame)
        ndc, inside = local_to_ndc(o * inverse_t[:, None, None] + d, inverse_t[:, None], frame)
        return ndc[:, 0], inside[:, 0]

    def place_points(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """The same of points in world axes."""
        return self.place_on_rays(points, torch.zeros_like(points), torch.ones_like(points[:, 0]))

    def sample(
        self, rays: Rays, hits: PlaneHits, numbers: Int[Tensor, "N"], index: Int[Tensor, "N"], first: Int[Tensor, "R"]
    ) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"], Float[Tensor, "N"], Texels]:
        """Samples of rays on their planes: u(w), v(w) and 1 / t are affine or rational in a plane's disparity w.

        Args:
            rays: R rays.
            hits: their intersections with the planes of all MPIs.
            numbers: ray of each sample.
            index: of each sample among those of its ray, near to far.
            first: m of each ray's nearest plane (``PlaneHits``).

        Returns:
            Plane, NDC and inverse distance of each sample, and the texels that it reads.
        """
        k, frames, mpi = self.number, self.layout.frames, self.layout.mpis[self.number]
        m = first[numbers] - index
        ray = torch.cat(
            [hits.u[:, k], hits.v[:, k], hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]], -1
        ).index_select(0, numbers)
        w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
        u0, u1, v0, v1 = mpi.extent
        u = (ray[:, 0] + w * ray[:, 1] - u0) * (2 / (u1 - u0)) - 1
        v = (ray[:, 2] + w * ray[:, 3] - v0) * (2 / (v1 - v0)) - 1
        ndc = torch.stack([u, v, 1 - 2 * mpi.near / mpi.depth_share * (w - 1 / mpi.far)], -1)
        planes, inverse_t = mpi.planes - 1 - m, inverse_distance(w, ray[:, 4], ray[:, 5])
        return planes, ndc, inverse_t, self.grid.bilinear(planes, ndc)

    def density(
        self, table: Float[Tensor, "T 1"], points: Float[Tensor, "N 3"], ndc: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N"]:
        """Optical depth per unit of distance at points of the frustum, along the head's axis.

        Between two planes tau is interpolated linearly in disparity, and divided by their distance there,
        dz = z^2 dw for planes dw apart in disparity w = 1 / z.
        """
        count, frame = self.grid.depth, self.frame
        position = ((ndc[:, 2] + 1) * (0.5 * (count - 1))).clamp(0, count - 1)
        near = position.floor().clamp(max=count - 2).to(torch.int64)
        far_share = position - near
        tau_near, tau_far = (
            self.optical_depth(table, self.grid.bilinear(plane, ndc), plane) for plane in (near, near + 1)
        )
        z = ((points - frame.origins[0]) * frame.axes[0, 2]).sum(-1)
        tau = (1 - far_share) * tau_near + far_share * tau_far
        return tau / (z**2 * frame.disparity_steps[0]).clamp(min=torch.finfo(z.dtype).tiny)


@dataclass(frozen=True)
class CubeHead(Head):
    """The centred cube of voxels, in world axes (paper sec. III-D)."""

    def place_points(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """Positions in [-1, 1]^3 over the cube, clamped to it, and whether the points lie inside of it."""
        assert self.layout.cube is not None
        ndc = self.layout.cube.normalised(points)
        return ndc.clamp(-1, 1), (ndc.abs() <= 1).all(-1)

    def place_on_rays(
        self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], inverse_t: Float[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """``place_points`` of a point at an inverse distance along each ray; at infinity nothing is inside."""
        ndc, inside = self.place_points(origins + directions / inverse_t.clamp(min=1e-10)[:, None])
        return ndc, inside & (inverse_t > 0)

    def sample(
        self, rays: Rays, hits: PlaneHits, numbers: Int[Tensor, "N"], index: Int[Tensor, "N"], first: Int[Tensor, "R"]
    ) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"], Float[Tensor, "N"], Texels]:
        """Samples of rays at fixed distances (i + 1/2) step from each camera; as ``MPIHead.sample``."""
        assert self.layout.cube is not None
        planes = first[numbers] + index
        t = (planes + 0.5).to(rays.origins.dtype) * self.layout.cube.step
        points = rays.origins[numbers] + rays.directions[numbers] * t[:, None]
        ndc = self.layout.cube.normalised(points)
        return planes, ndc, 1 / t, self.grid.trilinear(ndc)

    def density(
        self, table: Float[Tensor, "T 1"], points: Float[Tensor, "N 3"], ndc: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N"]:
        """Optical depth per unit of distance at points of the cube: that of a sample, by the step between samples."""
        assert self.layout.cube is not None
        planes = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        return self.optical_depth(table, self.grid.trilinear(ndc), planes) / self.layout.cube.step


def heads_of(layout: SceneLayout) -> list[MPIHead | CubeHead]:
    """The heads of a scene: its MPIs, then the cube."""
    num_mpis = len(layout.mpis)
    return [MPIHead(layout, k) if k < num_mpis else CubeHead(layout, k) for k in range(layout.num_heads)]
