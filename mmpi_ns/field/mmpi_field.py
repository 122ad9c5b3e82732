"""The field: K MPI heads and the cube, their densities, colours and reliabilities (paper sec. III-B to III-D).

Its tables are in ``mmpi_tables.py``.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor, nn

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.field.samples import Gathered, LocalRays, Lookup, Taps, by_head, head_spans, metadata_of
from mmpi_ns.field.shading import RayColors, RayShader, Shading
from mmpi_ns.field.tables import TexelTables, replace_data
from mmpi_ns.ops import hits, native
from mmpi_ns.ops.colors import colors
from mmpi_ns.ops.composite import render_colors
from mmpi_ns.ops.compositing import BlendForm, Composite, blend_shares, blended_optical_depth
from mmpi_ns.ops.gather import KnownTaps, gather_places, gather_taps
from mmpi_ns.ops.interpolate import bilinear_rows, gather_rows, index_rows, interpolate, interpolate_gathered
from mmpi_ns.ops.march import MarchScene, SceneTables
from mmpi_ns.ops.shade import shade
from mmpi_ns.ops.variation import total_variation
from mmpi_ns.scene import geometry
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scene.visible_tiles import TrainingViews

NEGLIGIBLE_DEPTH = 1e-4
"""Samples thinner than this are given an equal share instead of a reliability lookup when choosing survivors."""


def plane_biases(planes: int, missing: float = 0.0) -> tuple[Float[Tensor, "L"], float]:
    """Density biases b_l with which all planes start at equal rendering weight 1/L, and the interval 256/L.

    alpha_l = 1 / (L - l), the last one clamped; alpha = 1 - exp(-softplus(b) interval) solved for b.
    An MPI that ends begins as one to infinity from which the last ``missing`` planes were taken away, alpha_l =
    1 / (L + missing - l): their share of the weight is left to what lies behind.
    Source: DVGO v2's MPI; docs/how_it_works.md, "Density".
    """
    interval = 256.0 / planes
    alpha = (1.0 / (planes + missing - torch.arange(planes, dtype=torch.float64))).clamp(max=0.999)
    return torch.log(torch.expm1(-torch.log1p(-alpha) / interval)).float(), interval


class MMPIField(TexelTables):
    """Density, colour and reliability of all heads.

    Args:
        plan: frames and resolutions.
        shading: whether a network is asked once a ray or for every sample (``shading.py``).
        feature_channels: channels of the colour features; the first three are colour logits.
        hidden_width: width of the colour networks' hidden layers.
        position_frequencies: octaves of the positional encoding of NDC positions.
        direction_frequencies: octaves of the positional encoding of directions in the MPI's frame.
        shared_colour: one colour network for all heads (the paper's notation) instead of one each.
        shares_depth: K MPIs train jointly from the start, so each has 1/K of the optical depth.
        samples_per_voxel: samples along a ray per voxel side of the cube.
        cube_alpha: initial alpha of a cube sample.
        factor: texels in use, as a share of the plan's.
        views: training images; what none of them can reach is not stored. None stores everything.
    """

    def __init__(
        self,
        plan: ScenePlan,
        *,
        shading: Shading = "sample",
        feature_channels: int = 9,
        hidden_width: int = 64,
        position_frequencies: int = 2,
        direction_frequencies: int = 2,
        shared_colour: bool = False,
        shares_depth: bool = False,
        samples_per_voxel: float = 1.0,
        cube_alpha: float = 1e-3,
        factor: float = 1.0,
        views: TrainingViews | None = None,
    ) -> None:
        super().__init__(plan, feature_channels, factor, views)
        self.shares_depth = shares_depth
        self.samples_per_voxel = samples_per_voxel
        self.cube_alpha = cube_alpha
        self.learns_cover = True
        """Whether training rays mark the texels they train; off once blending has begun, so that P cannot jump."""
        self.shading = shading
        self.shared_colour = shared_colour
        if shading == "ray":
            self.networks = RayShader(feature_channels, hidden_width, direction_frequencies)
        else:
            sizes = (feature_channels, hidden_width, position_frequencies, direction_frequencies)
            self.networks = ColorNetworks(1 if shared_colour else plan.num_heads, *sizes)

    def renew_networks(self) -> None:
        """Fresh networks for the plan at hand in the same Parameter."""
        one = self.shading == "ray" or self.shared_colour
        weights = self.networks.weights
        replace_data(weights, self.networks.fresh(1 if one else self.full_plan.num_heads).to(weights.device))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of colour networks from the checkpoint first."""
        stored = state_dict.get(prefix + "networks.weights")
        if stored is not None and stored.shape[0] != self.networks.count:
            self.networks.resize(stored.shape[0])
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # Constants of the plan, on the parameters' device ---------------------------------------------------------

    @property
    def frames(self) -> geometry.Frames:
        return self.cached("frames", lambda: geometry.Frames.pack(self.plan.mpis, device=self.density.device))

    @property
    def cube(self) -> geometry.Cube | None:
        plan, device = self.plan.cube, self.density.device
        if plan is None:
            return None
        return self.cached("cube", lambda: geometry.Cube.pack(plan, self.samples_per_voxel, device=device))

    @property
    def depth_scale(self) -> float:
        """Factor on every optical depth of an MPI, by the plan at hand: a checkpoint's has a K of its own."""
        return 1.0 / len(self.full_plan.mpis) if self.shares_depth else 1.0

    def _biases(self, k: int) -> Tensor:
        mpi, device = self.plan.mpis[k], self.density.device
        missing = mpi.last_disparity / mpi.disparity_step
        return self.cached(f"bias{k}", lambda: plane_biases(mpi.planes, missing)[0].to(device))

    # Density ---------------------------------------------------------------------------------------------------

    def mpi_optical_depth(self, k: int, planes: Int[Tensor, "N"], ndc: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """tau of MPI k at NDC (u, v) on its planes."""
        rows, weights = self.grids[k].bilinear(planes, ndc)
        return self.mpi_tau(k, interpolate(self.density, rows, weights)[:, 0], planes)

    def cube_optical_depth(self, ndc: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """tau of the cube at normalised positions."""
        rows, weights = self.grids[-1].trilinear(ndc)
        return self._cube_tau(interpolate(self.density, rows, weights)[:, 0])

    def mpi_tau(self, k: int, raw: Float[Tensor, "N"], planes: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """tau from MPI k's raw densities: softplus(raw + b_l) times the interval, in float32 or wider."""
        interval = 256.0 / self.plan.mpis[k].planes
        raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        return nn.functional.softplus(raw + self._biases(k)[planes]) * (interval * self.depth_scale)

    def _cube_tau(self, raw: Tensor) -> Tensor:
        bias, interval = self._cube_density()
        return nn.functional.softplus(raw + bias) * interval

    def _cube_density(self) -> tuple[float, float]:
        """Bias and interval of the cube's samples."""
        interval = 1.0 / self.samples_per_voxel
        return math.log(math.expm1(-math.log1p(-self.cube_alpha) / interval)), interval

    def march_scene(self, shares: Tensor | None = None) -> SceneTables:
        """The field as the compiled march reads it, with shares in place of reliability where they are given."""

        def make() -> MarchScene:
            cube = None if self.cube is None else (self.cube, *self._cube_density())
            biases = [self._biases(k) for k in range(len(self.plan.mpis))]
            return MarchScene(self.plan.mpis, self.grids, self.frames.disparity_steps, biases, self.depth_scale, cube)

        votes = self.reliability.data if shares is None else shares
        return self.cached("march", make).with_tables(self.density.data, votes, self.touched)

    def plane_hits(self, origins: Tensor, directions: Tensor, nears: Tensor, fars: Tensor) -> geometry.PlaneHits:
        """``geometry.plane_hits`` in the field's MPIs, compiled where it can be; on a GPU in one launch."""
        lib, on_gpu = native.library(origins, self.density), native.takes_triton(origins, self.density)
        if lib is None and not on_gpu:
            return geometry.plane_hits(origins, directions, nears, fars, self.frames)
        frames = self.cached("hit frames", lambda: hits.pack_frames(self.frames))
        if lib is not None:
            return hits.plane_hits(lib, origins, directions, nears, fars, frames)
        from mmpi_ns.ops import triton_hits

        return triton_hits.plane_hits(origins, directions, nears, fars, frames)

    def triton_scene(self, shares: Tensor | None = None) -> tuple[Any, tuple[Tensor, Tensor, Tensor]]:
        """The field as the Triton kernels read it: a ``TritonScene``, and density, reliability (or shares, where they
        are given) and touched texels."""
        from mmpi_ns.ops.triton_scene import TritonScene

        def make() -> TritonScene:
            cube = None if self.cube is None else (self.cube, *self._cube_density())
            biases = [self._biases(k) for k in range(len(self.plan.mpis))]
            return TritonScene.pack(self.plan.mpis, self.grids, biases, self.depth_scale, cube, self.density.device)

        votes = self.reliability.data if shares is None else shares
        return self.cached("triton", make), (self.density.data, votes, self.touched)

    # Reliability -----------------------------------------------------------------------------------------------

    def shares(
        self, rays: Int[Tensor, "N"], local: LocalRays, inverse_t: Float[Tensor, "N"], heads: Int[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """log P and log(1 - P) of samples among the heads that cover them (paper sec. III-C).

        A head covers a point inside its frustum whose nearest texel was trained; a sample's own head always does.

        Args:
            rays: ray of each sample.
            local: the rays in every head's axes.
            inverse_t: inverse distance of each sample.
            heads: head that each sample was taken from.
        """
        columns, cover = [], []
        for j, grid in enumerate(self.grids):
            ndc, inside = self._ndc_in_head(j, rays, local, inverse_t)
            is_own = heads == j
            index = (inside | is_own).nonzero()[:, 0]
            position = ndc[index]
            value = interpolate(self.reliability, *grid.trilinear(position))[:, 0]
            columns.append(value.new_zeros(heads.shape[0]).index_put((index,), value))
            voting = torch.zeros_like(is_own)
            voting[index] = self.touched[grid.nearest(position)] > 0
            cover.append(voting | is_own)
        return blend_shares(torch.stack(columns, -1), torch.stack(cover, -1), heads)

    def _ndc_in_head(
        self, k: int, rays: Tensor, local: LocalRays, inverse_t: Tensor
    ) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """Where samples lie in one head, and whether inside it."""
        moved = local.table(k).index_select(0, rays)
        if k < len(self.plan.mpis):
            point = moved[:, :3] * inverse_t[:, None] + moved[:, 3:]
            ndc, inside = geometry.local_to_ndc(point[:, None], inverse_t[:, None], self._frame(k))
            return ndc[:, 0], inside[:, 0]
        assert self.cube is not None
        points = moved[:, :3] + moved[:, 3:] / inverse_t.clamp(min=1e-10)[:, None]
        ndc = self.cube.normalised(points)
        return ndc.clamp(-1, 1), (ndc.abs() <= 1).all(-1) & (inverse_t > 0)

    def _frame(self, k: int) -> geometry.Frames:
        return self.cached(f"frame{k}", lambda: geometry.Frames.pack([self.plan.mpis[k]], device=self.density.device))

    def blend(
        self,
        tau: Float[Tensor, "N"],
        rays: Int[Tensor, "N"],
        local: LocalRays,
        inverse_t: Float[Tensor, "N"],
        heads: Int[Tensor, "N"],
        form: BlendForm,
        baked: tuple[Tensor, Float[Tensor, "N 3"]] | None = None,
    ) -> Float[Tensor, "N"]:
        """Blended optical depth of many samples; those too thin to matter get an equal share without a lookup.

        With ``baked``, shares of all texels and the samples' places in their heads, no head is asked but their own.
        """
        index = (tau > NEGLIGIBLE_DEPTH).nonzero()[:, 0]
        if baked is not None:
            found = self.shares_at(baked[0], baked[1][index], heads[index])
            share = found.log(), torch.log1p(-found)
        else:
            share = self.shares(rays[index], local, inverse_t[index], heads[index])
        blended = tau / len(self.grids)
        return blended.index_copy(0, index, blended_optical_depth(tau[index], *share, form))

    def shares_at(
        self, shares: Float[Tensor, "N 1"], ndc: Float[Tensor, "S 3"], heads: Int[Tensor, "S"]
    ) -> Float[Tensor, "S"]:
        """Baked shares of samples, interpolated in the head that each was taken from."""
        found = ndc.new_zeros(len(heads))
        for k, grid in enumerate(self.grids):
            index = (heads == k).nonzero()[:, 0]
            found = found.index_copy(0, index, interpolate(shares, *grid.trilinear(ndc[index]))[:, 0])
        return found.clamp(0, 1)

    def forget_shares(self) -> None:
        """What was baked no longer holds: the field is about to be trained."""
        self._packed.pop(("shares", self.density.device), None)

    # nerfstudio's Field ------------------------------------------------------------------------------------------

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "R S 1"], Lookup]:  # type: ignore[override]
        """Optical depth of each valid sample (0 in empty slots), and where the lookups went.

        nerfstudio's "density" times interval: on a plane there is no interval, so the product itself is learned.
        """
        lookup = self._lookup(ray_samples)
        raw = []
        for taps in lookup.groups:
            if self.training and self.learns_cover:
                self.touched.index_fill_(0, lookup.gathered.rows if lookup.gathered else taps.rows.reshape(-1), 1)
                self.touched[:BRICK] = 0
            raw.append(_read(self.density, lookup.gathered and lookup.gathered.density, taps)[:, 0])
        out = lookup.ndc.new_zeros(lookup.shape.numel())
        if raw:
            flat = torch.cat(raw)
            each = flat.split([own.stop - own.start for _, own in lookup.spans])
            parts = zip(each, lookup.spans, strict=True)
            tau = torch.cat([self._head_tau(k, part, lookup.planes[own]) for part, (k, own) in parts])
            out = out.index_copy(0, lookup.index, tau)
        return out.view(*lookup.shape, 1), lookup

    def _head_tau(self, k: int, raw: Tensor, planes: Tensor) -> Tensor:
        return self.mpi_tau(k, raw, planes) if k < len(self.plan.mpis) else self._cube_tau(raw)

    def _lookup(self, ray_samples: RaySamples) -> Lookup:
        meta = metadata_of(ray_samples)
        index = meta["valid"].reshape(-1).nonzero()[:, 0]
        index = index[by_head(meta["heads"].reshape(-1)[index])]
        heads, planes = (meta[name].reshape(-1).index_select(0, index) for name in ("heads", "planes"))
        ndc = meta["ndc"].reshape(-1, 3).index_select(0, index)
        spans, num_mpis, groups = head_spans(heads, len(self.grids)), len(self.plan.mpis), []
        if in_mpis := [(k, own) for k, own in spans if k < num_mpis]:
            rows, weights = self._mpi_taps(in_mpis, heads, planes, ndc)
            groups.append(Taps(slice(0, len(rows)), rows, weights))
        if spans and spans[-1][0] == num_mpis:
            own = spans[-1][1]
            groups.append(Taps(own, *self.grids[-1].trilinear(ndc[own])))
        return Lookup(meta["valid"].shape[:2], index, heads, planes, ndc, spans, *self._gather(groups))

    def _mpi_taps(
        self, spans: list[tuple[int, slice]], heads: Tensor, planes: Tensor, ndc: Tensor
    ) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
        """Rows and weights of the samples in MPIs, which come first."""
        if native.takes_triton(ndc):
            from mmpi_ns.ops.triton_tables import taps

            end = spans[-1][1].stop
            return taps(self.triton_scene()[0], heads[:end], planes[:end], ndc[:end], in_cube=False)
        parts = [bilinear_rows(self.grids[k], planes[own], ndc[own]) for k, own in spans]
        rows, weights = (torch.cat(p) for p in zip(*parts, strict=True))
        return rows, weights

    def _gather(self, groups: list[Taps]) -> tuple[list[Taps], Gathered | None]:
        """The distinct rows of all groups, and the groups with their positions among them."""
        learns = torch.is_grad_enabled() and (self.density.requires_grad or self.features.requires_grad)
        if not learns or not groups:
            return groups, None
        index = index_rows(torch.cat([taps.rows.reshape(-1) for taps in groups]))
        positions = index.position.split([taps.rows.numel() for taps in groups])
        placed = [replace(t, position=p.view(t.rows.shape)) for t, p in zip(groups, positions, strict=True)]
        density, features = (gather_rows(table, index.unique) for table in (self.density, self.features))
        return placed, Gathered(index.unique, density, features)

    def get_outputs(  # type: ignore[override]
        self, ray_samples: RaySamples, density_embedding: Lookup | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Colours of the valid samples (diffuse ones where a ray is shaded once); empty slots are black."""
        sampled = self.shading == "sample"
        if sampled and not torch.is_grad_enabled() and density_embedding is None:
            lib = native.library(self.features, ray_samples.frustums.directions)
            if lib is not None or native.takes_triton(self.features, ray_samples.frustums.directions):
                return {FieldHeadNames.RGB: self._shade(lib, ray_samples)}
        lookup = density_embedding or self._lookup(ray_samples)
        features = self._features(lookup)
        found = self._sample_colors(features, lookup, ray_samples) if sampled else features[:, :3].sigmoid()
        out = lookup.ndc.new_zeros(lookup.shape.numel(), 3).index_copy(0, lookup.index, found)
        return {FieldHeadNames.RGB: out.view(*lookup.shape, 3)}

    def _features(self, lookup: Lookup) -> Float[Tensor, "N C"]:
        known = lookup.gathered and lookup.gathered.features
        parts = [_read(self.features, known, taps) for taps in lookup.groups]
        return torch.cat(parts) if parts else lookup.ndc.new_zeros(0, self.feature_channels)

    def _sample_colors(self, features: Tensor, lookup: Lookup, ray_samples: RaySamples) -> Float[Tensor, "N 3"]:
        """What the networks make of every sample."""
        assert isinstance(self.networks, ColorNetworks)
        directions, rays = ray_samples.frustums.directions[:, 0], lookup.rays
        # Split, not sliced: the gradient of a slice is as large as the whole.
        each = features.split([own.stop - own.start for _, own in lookup.spans])
        found = [
            colors(self.networks, k, part, lookup.ndc[own], geometry.rotate(self._axes(k), directions), rays[own])
            for part, (k, own) in zip(each, lookup.spans, strict=True)
        ]
        return torch.cat(found) if found else lookup.ndc.new_zeros(0, 3)

    def render_colors(
        self,
        ray_samples: RaySamples,
        lookup: Lookup | None,
        composite: Composite,
        wanted: Bool[Tensor, "R"] | None = None,
    ) -> RayColors:
        """What rays show.

        Args:
            ray_samples: merged samples.
            lookup: where they read the tables; None where no gradients are wanted.
            composite: weights of the samples.
            wanted: the rays that colours are wanted of, as far as leaving others out saves time; None for all.
        """
        if not isinstance(self.networks, RayShader):
            lookup = lookup if lookup is None or wanted is None else lookup.of_rays(wanted)
            found = self.get_outputs(ray_samples, lookup)[FieldHeadNames.RGB]
            return RayColors.of_samples(composite, render_colors(composite, found), found)
        if lookup is None:
            meta = metadata_of(ray_samples)
            heads, planes, valid = (meta[name][..., 0] for name in ("heads", "planes", "valid"))
            here = (self.grids, len(self.plan.mpis), lambda: self.triton_scene()[0], self.features.data)
            sums = gather_places(*here, heads, planes, meta["ndc"], valid, composite.weights)
        else:
            known = lookup.gathered and lookup.gathered.features
            groups = [KnownTaps(t.rows if t.position is None else t.position, t.weights) for t in lookup.groups]
            wanted = torch.ones(lookup.shape[0], dtype=torch.bool) if wanted is None else wanted
            values = self.features if known is None else known
            sums = gather_taps(values, groups, lookup.index, composite.weights, wanted.to(values.device))
        return self.networks(sums, composite, ray_samples.frustums.directions[:, 0])

    def _shade(self, lib: ctypes.CDLL | None, ray_samples: RaySamples) -> Float[Tensor, "R S 3"]:
        assert isinstance(self.networks, ColorNetworks)
        meta, rays = metadata_of(ray_samples), ray_samples.frustums.directions[:, 0]
        axes = torch.stack([self._axes(k) for k in range(len(self.grids))])
        heads, planes, valid = (meta[name][..., 0] for name in ("heads", "planes", "valid"))
        samples = (heads, planes, meta["ndc"], valid)
        if lib is not None:
            return shade(lib, self.march_scene(), self.features.data, self.networks, axes, rays, *samples)
        from mmpi_ns.ops import triton_shade

        directions = geometry.rotate(axes[:, None], rays)
        return triton_shade.shade(self.triton_scene()[0], self.features.data, self.networks, directions, *samples)

    def total_variation(self, lookup: Lookup, density_weight: float, feature_weight: float) -> Tensor:
        """Weighted total variation of the texels that the batch touched, in DVGO's normalisation (not yet per ray)."""
        total = self.density.new_zeros(())
        found = lookup.gathered
        if found is None:
            return total
        scales = []
        for k, grid in enumerate(self.grids):
            side = max(grid.width, grid.height)
            sides = (side, side, grid.depth) if k < len(self.plan.mpis) else (grid.width, grid.height, grid.depth)
            scales.append((sides[0] / 128, sides[1] / 128, sides[2] / 128))
        for table, values, weight in (
            (self.density, found.density, density_weight),
            (self.features, found.features, feature_weight),
        ):
            if weight > 0:
                total = total + weight * total_variation(values, table.data, found.rows, self.grids, scales)
        return total

    def _axes(self, k: int) -> Tensor:
        if k < len(self.plan.mpis):
            return self.frames.axes[k]
        return torch.eye(3, device=self.density.device)

    def sample_shares(self, ray_samples: RaySamples, lookup: Lookup) -> tuple[Tensor, Tensor]:
        """``shares`` of the valid samples of a merged batch, with gradients to the reliability."""
        frustums = ray_samples.frustums
        local = LocalRays.of(frustums.origins[:, 0], frustums.directions[:, 0], self.frames)
        inverse_t = metadata_of(ray_samples)["inverse_t"].reshape(-1)[lookup.index]
        return self.shares(lookup.index // lookup.shape[1], local, inverse_t, lookup.heads)


def _read(table: Tensor, gathered: Tensor | None, taps: Taps) -> Tensor:
    """Interpolated rows of a table, or of what was gathered from it."""
    if gathered is None or taps.position is None:
        return interpolate(table, taps.rows, taps.weights)
    return interpolate_gathered(gathered, taps.position, taps.weights)
