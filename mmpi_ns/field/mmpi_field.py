"""The field: K MPI heads and the cube, their densities, colours and reliabilities (paper sec. III-B to III-D).

Its tables are in ``tables.py``.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor

from mmpi_ns.blending import head_shares, log_shares
from mmpi_ns.field.shading import ColorNetworks, RayShader
from mmpi_ns.field.tables import Lookup, TexelTables
from mmpi_ns.heads import heads_of
from mmpi_ns.ops.composite import Composite, ray_numbers, render_colors, sum_by_ray
from mmpi_ns.ops.gather import RaySums, Taps, activate, gather_taps
from mmpi_ns.ops.interpolate import index_rows, read_rows, texel_rows
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MergedSamples
from mmpi_ns.ops.variation import total_variation
from mmpi_ns.scene import geometry
from mmpi_ns.scene.geometry import FACING_EPS, local_rays, sample_disparity
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.settings import Shading

POSITION_FREQUENCIES, DIRECTION_FREQUENCIES = 2, 2
"""Octaves of the positional encodings of NDC positions, where samples are shaded, and of directions."""


class MMPIField(TexelTables):
    """Density, colour and reliability of all heads.

    Args:
        plan: frames and resolutions.
        shading: with the next two, see ``ColourConfig``.
        shares_depth: K MPIs train jointly from the start, so each has 1/K of the optical depth.
        learns_reliability: training has a phase of reliability (``training/reliability.py``).
        samples_per_voxel: samples along a ray per voxel side of the cube.
        cube_alpha: initial alpha of a cube sample.
        factor: texels in use, as a share of the plan's.
        views: training images; texels that none of them can reach are not stored. None stores all.
    """

    def __init__(
        self,
        plan: ScenePlan,
        *,
        shading: Shading = "sample",
        feature_channels: int = 9,
        hidden_width: int = 64,
        shares_depth: bool = False,
        learns_reliability: bool = False,
        samples_per_voxel: float = 1.0,
        cube_alpha: float = 1e-3,
        factor: float = 1.0,
        views: TrainingViews | None = None,
    ) -> None:
        super().__init__(plan, feature_channels, factor, views)
        self.shares_depth = shares_depth
        self.samples_per_voxel = samples_per_voxel
        self.cube_alpha = cube_alpha
        self.learns_reliability = learns_reliability
        self.marks_texels = True
        """Whether training rays mark the texels that they read (``training/reliability.py``)."""
        self.shading = shading
        sizes = (feature_channels, hidden_width)
        if shading == "ray":
            self.networks = RayShader(1, *sizes, DIRECTION_FREQUENCIES)
        else:
            self.networks = ColorNetworks(plan.num_heads, *sizes, POSITION_FREQUENCIES, DIRECTION_FREQUENCIES)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of colour networks from the checkpoint first."""
        stored = state_dict.get(prefix + "networks.weights")
        if stored is not None and stored.shape[0] != len(self.networks.weights):
            self.networks.resize(stored.shape[0])
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # Inputs of the operations ----------------------------------------------------------------------------------

    @property
    def layout(self) -> SceneLayout:
        """The plan's constants at the resolution in use, on the parameters' device.

        All planes start at equal rendering weight 1/L: biases b_l give alpha_l = 1 / (L - l), the last one clamped, by
        alpha = 1 - exp(-softplus(b) 256 / L). An MPI with a finite far starts like one to infinity without its last
        planes, whose weight goes to content behind it. Source: DVGO v2's MPI; docs/how_it_works.md, "Density".
        """
        if (layout := self.cached("layout")) is not None:
            return layout
        mpis, device, cube, biases = self.plan.mpis, self.density.device, self.plan.cube, []
        for m in mpis:
            missing = 1 / m.far / m.disparity_step
            alpha = (1.0 / (m.planes + missing - torch.arange(m.planes, dtype=torch.float64))).clamp(max=0.999)
            raw = torch.log(torch.expm1(-torch.log1p(-alpha) / (256.0 / m.planes)))
            biases.append(raw.float().to(device))
        frames = geometry.Frames.pack(mpis, device=device)
        packed = None if cube is None else geometry.Cube.pack(cube, self.samples_per_voxel, device=device)
        interval = 1.0 / self.samples_per_voxel
        bias = math.log(math.expm1(-math.log1p(-self.cube_alpha) / interval))
        if packed is not None and self.full_plan.cube is not None:  # coarse samples are longer, as in DVGO
            interval = packed.step / geometry.Cube.pack(self.full_plan.cube, 1.0).step
        # From the current plan: that of a checkpoint has its own K.
        scale = 1.0 / len(self.full_plan.mpis) if self.shares_depth else 1.0
        depths = (biases, scale, packed, bias, interval)
        return self.cached("layout", lambda: SceneLayout(mpis, frames, self.grids, *depths, self.plan.content_near))

    @property
    def tables(self) -> Tables:
        """Tables for the march."""
        return Tables(self.density.data, self.reliability.data, self.touched)

    @property
    def blends(self) -> bool:
        """Whether heads are blended by reliability where several cover a point; False for a single head."""
        return self.learns_reliability and self.plan.num_heads > 1

    @property
    def nbytes(self) -> int:
        """Bytes of its tables."""
        return sum(x.nbytes for x in self.state_dict().values())

    # nerfstudio's Field ------------------------------------------------------------------------------------------

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "*batch 1"], Float[Tensor, "*batch C"]]:
        """Densities, and mean colours and features, at the positions of any samples.

        A plane has an optical depth and no thickness. A density is that depth over the distance to the next plane along
        the head's axis (``MPIHead.density``), so its integral through a head in that direction is the optical depth of
        the head's planes. Heads that cover a point add up, each by its share: alpha becomes P alpha (paper sec. III-C),
        and in the limit of thin samples tau becomes P tau. Without reliability all shares are 1, as in rendering.

        Args:
            ray_samples: with ``frustums.get_positions()`` in world axes.

        Returns:
            Densities, 1 / scene units, 0 outside all heads; and colours and features, weighted by the density of each
            head, 0 outside all heads.
        """
        positions = ray_samples.frustums.get_positions()
        points, heads = positions.reshape(-1, 3), heads_of(self.layout)
        places = [head.place_points(points) for head in heads]
        if self.blends:
            shares = head_shares(heads, places, self.reliability, self.touched)
        else:
            shares = torch.stack([inside for _, inside in places], -1).to(points.dtype)
        densities, embedding = points.new_zeros(len(points)), points.new_zeros(len(points), self.features.shape[1])
        for head, (ndc, _), share in zip(heads, places, shares.unbind(-1), strict=True):
            index = (share > 0).nonzero()[:, 0]
            density = share[index] * head.density(self.density, points[index], ndc[index])
            densities = densities.index_add(0, index, density)
            values = head.values(self.features, ndc[index])
            if self.shading == "ray":  # a sample's colour is composited, not its logits
                values = activate(values)
            embedding = embedding.index_add(0, index, density[:, None] * values)
        embedding = embedding / densities.clamp(min=torch.finfo(densities.dtype).tiny)[:, None]
        return densities.view(*positions.shape[:-1], 1), embedding.view(*positions.shape[:-1], -1)

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Float[Tensor, "*batch C"] | None = None
    ) -> dict[FieldHeadNames, Float[Tensor, "*batch 3"]]:
        """Colours at the positions of any samples, of the texels that ``get_density`` reads there.

        With a network for every sample, whose input differs by head, the texels' diffuse colour is returned.

        Args:
            ray_samples: positions and directions, world axes.
            density_embedding: colours and features there; None: those of ``get_density``.
        """
        if density_embedding is None:
            density_embedding = self.get_density(ray_samples)[1]
        values = density_embedding.reshape(-1, density_embedding.shape[-1])
        if isinstance(self.networks, RayShader):
            one = torch.ones_like(values[:, :1])
            colors = self.networks.shade(values, one, one, ray_samples.frustums.directions.reshape(-1, 3))
        else:
            colors = torch.sigmoid(values[:, :3])
        return {FieldHeadNames.RGB: colors.view(*density_embedding.shape[:-1], 3)}

    # Merged samples ----------------------------------------------------------------------------------------------

    def optical_depths(self, rays: RayBundle, samples: MergedSamples) -> tuple[Float[Tensor, "N"], Lookup]:
        """Optical depth of each sample, and the lookups.

        A density times an interval: on a plane there is no interval, so the product itself is learned.
        """
        lookup = self._lookup(rays, samples)
        if self.training and self.marks_texels:
            self.touched.index_fill_(0, lookup.rows, 1)
            self.touched[:BRICK].zero_()
        raw = lookup.read(lookup.density)[:, 0]
        return self.layout.optical_depth(samples.heads, raw, samples.planes), lookup

    def _lookup(self, rays: RayBundle, samples: MergedSamples) -> Lookup:
        room, ndc = samples.capacity, samples.ndc
        if rays.origins.requires_grad or rays.directions.requires_grad:
            ndc = moving(self.layout, rays.origins, rays.directions, samples)
        count = None if room is None else samples.starts[-1:]
        rows, weights = texel_rows(self.layout, samples.heads, samples.planes, ndc, count)
        distinct = index_rows(rows, len(self.density), most=None if room is None else room.rows)
        read = (distinct.unique, *(read_rows(table, distinct.unique) for table in (self.density, self.features)))
        return Lookup(ndc, Taps(distinct.positions, weights), *read, distinct=distinct.count)

    def sample_colors(
        self,
        rays: RayBundle,
        samples: MergedSamples,
        lookup: Lookup | None = None,
        chosen: Bool[Tensor, "R"] | None = None,
    ) -> Float[Tensor, "N 3"]:
        """Colours of the samples by a network for each, black on rays that are not chosen.

        Args:
            rays: of the samples.
            samples: of the rays.
            lookup: of the samples in the tables; None computes it.
            chosen: as for ``render_colors``.
        """
        directions, axes = rays.directions, self.layout.frames.axes
        assert isinstance(self.networks, ColorNetworks), "rays that are shaded once have no colours of samples"
        networks = self.planned_heads(torch.arange(self.plan.num_heads)).tolist()  # a copy has its MPI's network
        if self.layout.cube is not None:
            axes = torch.cat([axes, torch.eye(3, device=axes.device)[None]])
        lookup = lookup or self._lookup(rays, samples)
        parts = samples.by_head(len(self.grids), chosen)
        index, sizes = torch.cat(parts), [len(x) for x in parts]
        index_in = index.clamp(max=max(0, len(samples.heads) - 1))
        columns = (lookup.read(lookup.features), lookup.ndc, samples.heads * len(directions) + samples.rays)
        values, ndc, rows = (x.index_select(0, index_in) for x in columns)
        directions = geometry.rotate(axes[:, None], directions).flatten(0, 1)
        colors = self.networks.shade(networks, sizes, values, ndc, directions, rows)
        return lookup.ndc.new_zeros(len(lookup.ndc) + 1, 3).index_copy(0, index, colors)[:-1]

    def render_colors(
        self,
        rays: RayBundle,
        samples: MergedSamples,
        lookup: Lookup | None,
        composite: Composite,
        chosen: Bool[Tensor, "R"] | None = None,
    ) -> tuple[Float[Tensor, "R 3"], RaySums]:
        """Colours of rays without a background, and sums over the colours along them.

        Args:
            rays: of the samples.
            samples: of the rays.
            lookup: of the samples in the tables; None without gradients.
            composite: weights of the samples.
            chosen: rays whose colours are needed; others may be skipped. None for all.
        """
        starts = samples.starts
        if not isinstance(self.networks, RayShader):
            colors, weights = self.sample_colors(rays, samples, lookup, chosen), composite.weights.detach()[:, None]
            values = torch.cat([weights, weights * colors, weights * colors**2], -1)
            sums = sum_by_ray(values, starts, ray_numbers(starts, len(values)))
            mass, first, second = sums.split([1, 3, 3], -1)
            return render_colors(composite, colors, starts), RaySums(first, mass, first, second)
        if lookup is None:
            texels = Taps(*texel_rows(self.layout, samples.heads, samples.planes, samples.ndc))
            sums = gather_taps(self.features.data, texels, starts, composite.weights)
        else:
            sums = gather_taps(lookup.features, lookup.taps, starts, composite.weights, chosen)
        return self.networks.shade(sums.gathered, composite.mass, composite.accumulation, rays.directions), sums

    def total_variation(
        self, lookup: Lookup, density_weight: float, feature_weight: float, chroma_times: float = 0.0
    ) -> Tensor:
        """Weighted total variation of the texels that the batch touched, in DVGO's normalisation (not yet per ray).

        Args:
            lookup: of the batch.
            density_weight: of densities.
            feature_weight: of colours and features.
            chroma_times: additional weight of differences of chroma in the gradient.
        """
        total = self.density.new_zeros(())
        if (scales := self.cached("resolution")) is None:
            longest = ((max(grid.width, grid.height), grid) for grid in self.grids)
            sides = [(g.width, g.height, g.depth) if g.is_cube else (side, side, g.depth) for side, g in longest]
            resolution = torch.tensor(sides, dtype=torch.float32, device=total.device) / 128
            scales = self.cached("resolution", lambda: resolution)
        for table, values, weight, chroma in (
            (self.density, lookup.density, density_weight, 0.0),
            (self.features, lookup.features, feature_weight, chroma_times),
        ):
            if weight > 0:
                total = total + weight * total_variation(values, table.data, lookup.rows, self.layout, scales, chroma)
        return total

    def sample_shares(self, rays: RayBundle, samples: MergedSamples) -> tuple[Tensor, Tensor]:
        """log P and log(1 - P) of the samples of rays, with gradients to the reliability."""
        # Shares have no gradients to poses.
        origins, directions = (x.detach()[samples.rays] for x in (rays.origins, rays.directions))
        tables = self.tables._replace(reliability=self.reliability)
        return log_shares(self.layout, tables, origins, directions, samples.inverse_t, samples.heads)


def moving(
    layout: SceneLayout,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    samples: MergedSamples,
) -> Float[Tensor, "N 3"]:
    """The positions of samples, bit for bit unchanged, with gradients to the rays.

    The march has no gradients. A sample stays on its plane, so it moves within that plane when its ray moves: u(w) =
    dx/dz + w (ox - oz dx/dz) at the plane's disparity w, and likewise v. Depths of planes, intersected planes and kept
    samples are held fixed; a sample of the cube moves with the point at its distance.

    Args:
        layout: of the scene.
        origins: of the rays, world axes.
        directions: likewise, unit.
        samples: of the rays.
    """
    frames, in_cube, rays = layout.frames, samples.heads == len(layout.mpis), samples.rays
    mpis = torch.where(in_cube, 0, samples.heads)
    o, d = local_rays(origins, directions, frames)
    facing = d[..., 2:] > FACING_EPS  # elsewhere there are no samples
    slope = d[..., :2] / torch.where(facing, d[..., 2:], 1)
    bend = o[..., :2] - o[..., 2:] * slope
    line = torch.cat([slope, bend], -1).flatten(0, 1).index_select(0, rays * len(layout.mpis) + mpis)
    m = frames.num_planes[mpis] - 1 - samples.planes
    w = sample_disparity(m, frames.disparity_steps[mpis], frames.last_disparities[mpis])[:, None]
    size = (frames.extents[:, 1::2] - frames.extents[:, ::2])[mpis]
    # NDC (u, v, .) up to a constant.
    moved = torch.nn.functional.pad((line[:, :2] + w * line[:, 2:]) * (2 / size), (0, 1))
    if layout.cube is not None:
        t = 1 / torch.where(in_cube, samples.inverse_t, 1.0)[:, None]
        moved = torch.where(in_cube[:, None], layout.cube.normalised(origins[rays] + directions[rays] * t), moved)
    return samples.ndc + (moved - moved.detach())
