"""The field: K MPI heads and the cube, their densities, colours and reliabilities (paper sec. III-B to III-D).

Its tables are in ``tables.py``.
"""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor

from mmpi_ns.blending import head_shares, log_shares
from mmpi_ns.field.shading import ColorNetworks, RayShader
from mmpi_ns.field.tables import Lookup, TexelTables
from mmpi_ns.heads import heads_of
from mmpi_ns.ops.composite import Composite, render_colors
from mmpi_ns.ops.dispatch import on_gpu
from mmpi_ns.ops.gather import RaySums, Taps, activate, gather_places, gather_taps
from mmpi_ns.ops.interpolate import index_rows, order_by_head, read_rows, texel_rows
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MergedSamples
from mmpi_ns.ops.variation import total_variation
from mmpi_ns.scene import geometry
from mmpi_ns.scene.geometry import FACING_EPS, LocalRays, sample_disparity
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

    def optical_depths(self, rays: RayBundle, samples: MergedSamples) -> tuple[Float[Tensor, "R S"], Lookup]:
        """Optical depth of each valid sample (0 in empty slots), and the lookups.

        A density times an interval: on a plane there is no interval, so the product itself is learned.
        """
        lookup = self._lookup(rays, samples)
        if self.training and self.marks_texels:
            self.touched.index_fill_(0, lookup.rows, 1)
            self.touched[:BRICK].zero_()
        raw = lookup.by_head(lookup.read(lookup.density)[:, 0])
        tau = [self.layout.optical_depth(k, part, lookup.planes[here]) for k, here, part in raw]
        out = lookup.ndc.new_zeros(lookup.shape.numel())
        if tau:
            out = out.index_copy(0, lookup.index, torch.cat(tau))
        return out.view(lookup.shape), lookup

    def _lookup(self, rays: RayBundle, samples: MergedSamples) -> Lookup:
        room = samples.capacity
        index, heads, planes, ndc, counts = order_by_head(
            samples.places, len(self.grids), samples.head_counts, room is not None
        )
        if rays.origins.requires_grad or rays.directions.requires_grad:
            of_rays, inverse_t = index // samples.valid.shape[1], samples.inverse_t.reshape(-1)[index]
            ndc = moving(self.layout, rays.origins, rays.directions, of_rays, heads, planes, inverse_t, ndc)
        spans = [(k, slice(end - n, end)) for k, (n, end) in enumerate(zip(counts, accumulate(counts))) if n]  # noqa: B905
        in_mpis, parts = sum(counts[: len(self.plan.mpis)]), []
        if in_mpis:
            parts.append(texel_rows(self.layout, heads[:in_mpis], planes[:in_mpis], ndc[:in_mpis]))
        if in_mpis < len(index):
            parts.append(self.grids[-1].trilinear(ndc[in_mpis:]))
        if room is not None:  # unused slots read the empty brick
            filled = samples.valid.reshape(-1)[index].split([len(rows) for rows, _ in parts])
            empty = torch.arange(len(index), device=index.device).remainder(BRICK).split([len(x) for x in filled])
            columns = zip(filled, parts, empty, strict=True)
            parts = [(torch.where(here[:, None], rows, none[:, None]), w) for here, (rows, w), none in columns]
        rows = [rows.reshape(-1) for rows, _ in parts] or [heads]
        distinct = index_rows(torch.cat(rows), len(self.density), most=None if room is None else room.rows)
        positions = distinct.positions.split([len(r) for r in rows])
        taps = [Taps(p.view(w.shape), w) for p, (_, w) in zip(positions, parts)]  # noqa: B905
        read = (distinct.unique, *(read_rows(table, distinct.unique) for table in (self.density, self.features)))
        return Lookup(samples.valid.shape, index, heads, planes, ndc, spans, taps, *read, distinct=distinct.count)

    def sample_colors(
        self,
        rays: RayBundle,
        samples: MergedSamples,
        lookup: Lookup | None = None,
        chosen: Bool[Tensor, "R"] | None = None,
    ) -> Float[Tensor, "R S 3"]:
        """Colours of the valid samples by a network for each, black in empty slots.

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
        out = lookup.ndc.new_zeros(lookup.shape.numel(), 3)
        colors, slots = [out[:0]], [lookup.index[:0]]
        for k, here, part in lookup.by_head(lookup.read(lookup.features)):
            index = lookup.index[here]
            of_samples = (part, lookup.ndc[here], index // lookup.shape[1], index)
            if chosen is not None and not on_gpu(chosen):  # a GPU would synchronise
                kept = chosen[of_samples[2]].nonzero()[:, 0]
                of_samples = tuple(x.index_select(0, kept) for x in of_samples)
            values, ndc, numbers, index = of_samples
            in_axes = geometry.rotate(axes[k], directions)
            colors.append(self.networks.shade(networks[k], values, ndc, in_axes, numbers))
            slots.append(index)
        return out.index_copy(0, torch.cat(slots), torch.cat(colors)).view(*lookup.shape, 3)

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
        if not isinstance(self.networks, RayShader):
            colors, weights = self.sample_colors(rays, samples, lookup, chosen), composite.weights.detach()[..., None]
            rgb, first = render_colors(composite, colors), (weights * colors).sum(1)
            return rgb, RaySums(first, weights.sum(1), first, (weights * colors**2).sum(1))
        if lookup is None:
            sums = gather_places(self.layout, self.features.data, samples.places, composite.weights)
        else:
            if chosen is None:
                chosen = torch.ones(lookup.shape[0], dtype=torch.bool, device=lookup.rows.device)
            sums = gather_taps(lookup.features, lookup.taps, lookup.index, composite.weights, chosen)
        mass = composite.weights.sum(-1, keepdim=True)
        return self.networks.shade(sums.gathered, mass, composite.accumulation, rays.directions), sums

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
                term = total_variation(values, table.data, lookup.rows, self.layout, scales, chroma)
                total = total + weight * term
        return total

    def sample_shares(self, rays: RayBundle, samples: MergedSamples, lookup: Lookup) -> tuple[Tensor, Tensor]:
        """log P and log(1 - P) of the valid samples of rays, with gradients to the reliability."""
        # Shares have no gradients to poses.
        local = geometry.LocalRays.of(rays.origins.detach(), rays.directions.detach(), self.layout.frames)
        places = (lookup.index // lookup.shape[1], local, samples.inverse_t.reshape(-1)[lookup.index], lookup.heads)
        return log_shares(self.layout, self.reliability, self.touched, *places)


def moving(
    layout: SceneLayout,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    rays: Int[Tensor, "N"],
    heads: Int[Tensor, "N"],
    planes: Int[Tensor, "N"],
    inverse_t: Float[Tensor, "N"],
    ndc: Float[Tensor, "N 3"],
) -> Float[Tensor, "N 3"]:
    """The positions of samples, bit for bit unchanged, with gradients to the rays.

    The march has no gradients. A sample stays on its plane, so it moves within that plane when its ray moves: u(w) =
    dx/dz + w (ox - oz dx/dz) at the plane's disparity w, and likewise v. Depths of planes, intersected planes and kept
    samples are held fixed; a sample of the cube moves with the point at its distance.

    Args:
        layout: of the scene.
        origins: of the rays, world axes.
        directions: likewise, unit.
        rays: ray of each sample.
        heads: of each sample, ascending; those of the cube come last.
        planes: of each sample.
        inverse_t: inverse distances of the samples.
        ndc: their positions.
    """
    count = len(heads) if layout.cube is None else int(torch.searchsorted(heads, len(layout.mpis)))
    frames, mpis = layout.frames, heads[:count]
    local = LocalRays.of(origins, directions, frames)
    o, d = local.local_origins, local.local_directions
    facing = d[..., 2:] > FACING_EPS  # elsewhere there are no samples
    slope = d[..., :2] / torch.where(facing, d[..., 2:], 1)
    bend = o[..., :2] - o[..., 2:] * slope
    line = torch.cat([slope, bend], -1).flatten(0, 1).index_select(0, rays[:count] * len(layout.mpis) + mpis)
    m = frames.num_planes[mpis] - 1 - planes[:count]
    w = sample_disparity(m, frames.disparity_steps[mpis], frames.last_disparities[mpis])[:, None]
    size = (frames.extents[:, 1::2] - frames.extents[:, ::2])[mpis]
    # NDC (u, v, .) up to a constant.
    parts = [torch.nn.functional.pad((line[:, :2] + w * line[:, 2:]) * (2 / size), (0, 1))]
    if layout.cube is not None:
        in_cube = rays[count:]
        parts.append(layout.cube.normalised(origins[in_cube] + directions[in_cube] / inverse_t[count:, None]))
    moved = torch.cat(parts)
    return ndc + (moved - moved.detach())
