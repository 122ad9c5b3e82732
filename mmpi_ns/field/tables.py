"""The field's tables: one pooled Parameter per kind, in bricks; their allocation, growth, release and restoration.

Parameters stay the same objects whatever their size, so that K, growth and storage never change the parameter list,
which nerfstudio fixes before K is known. Row arithmetic is in ``texels.py``, work on whole tables in ``bricks.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.fields.base_field import Field
from torch import Tensor, nn

from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.interpolate import Table, weigh_rows
from mmpi_ns.ops.march import MergedSamples
from mmpi_ns.scene.bricks import grown_tiles, move_bricks, new_table, resample, tiles_with_copies
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, TexelGrid, head_grids, make_grids, number_tiles
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles
from mmpi_ns.scene.windows import to_bytes, to_text

RELEASED_DENSITY = -20.0
"""Raw density of texels that no ray trained: their alpha is below 1e-7."""
EMPTY = {"density": RELEASED_DENSITY, "features": 0.0, "reliability": 0.0}
"""Content of the empty brick in each table."""
TABLES = tuple(EMPTY)
"""Names of the parameters with a row for every texel."""
HALF_LARGEST = 65504.0
"""Largest number of half precision."""
MIDDLE = 0.5
"""Minimum weight of stored texels in an interpolated one beside empty texels."""
ENOUGH_CROSSINGS = 32
"""Average number of training samples for each brick before any brick may be released."""


@dataclass(frozen=True)
class Lookup:
    """Lookups of the samples of a batch in the tables.

    Every row that the batch reads is taken from its table once: ``density`` and ``features`` are what the samples read,
    and their gradients are those of the tables (``ops.interpolate.Table``).
    """

    ndc: Float[Tensor, "N 3"]
    """Positions of the samples, with gradients to rays that have them."""
    taps: Taps
    """Of the samples; positions are among ``rows``."""
    rows: Int[Tensor, "U"]
    """Distinct rows of the tables, ascending."""
    density: Float[Tensor, "U 1"]
    features: Float[Tensor, "U C"]
    distinct: Int[Tensor, ""] | None = None
    """Number of distinct rows, where the samples have a capacity."""

    def read(self, values: Float[Tensor, "U C"]) -> Float[Tensor, "N C"]:
        """Interpolated values of the samples, from those of the rows."""
        return weigh_rows(values, self.taps.positions, self.taps.weights)


class TexelTables(Field):
    """Density, features and reliability of all stored texels.

    Args:
        plan: frames and resolutions.
        feature_channels: channels of the colour features.
        factor: texels in use, as a share of the plan's.
        views: training images; texels that none of them can reach are not stored. None stores all.
    """

    def __init__(
        self, plan: ScenePlan, feature_channels: int, factor: float = 1.0, views: TrainingViews | None = None
    ) -> None:
        super().__init__()
        self.feature_channels = feature_channels
        self.full_plan = self.plan = plan
        self.factor: float
        """Fraction of the plan's texels in use: ``texel_factor`` on the host, readable without synchronising."""
        self.views = views
        self._packed: dict[Any, Any] = {}
        self.density = Table(torch.empty(0, 1))
        self.features = Table(torch.empty(0, feature_channels))
        self.reliability = Table(torch.empty(0, 1))
        for name in ("tiles", "touched", "peak", "gain", "plan_bytes", "crossings", "texel_factor", "copied"):
            self.register_buffer(name, None)
        self.tiles: Tensor
        """Brick of every tile of all heads (``texels.py``)."""
        self.touched: Tensor
        """For every row: 1 if a training ray read it."""
        self.peak: Tensor
        """For every brick: the largest weight of a training sample in it since the last release."""
        self.gain: Tensor
        """For every brick: squared errors of training rays, times the weights of their samples in it, since the last
        release; until there are copies."""
        self.crossings: Tensor
        """Training samples since the last release."""
        self.copied: Tensor
        """Whether MPIs have finer copies."""
        self.plan_bytes: Tensor
        self.texel_factor: Tensor
        self.build(plan, factor)

    @property
    def grids(self) -> list[TexelGrid]:
        """The texels of every head, MPIs first, the cube last."""
        return self.cached("grids", lambda: head_grids(self.plan, self.tiles))

    @property
    def num_bricks(self) -> int:
        """Number of stored bricks, without the empty one."""
        return len(self.density) // BRICK - 1

    def cached(self, name: str, make: Callable[[], Any] | None = None) -> Any:
        """A constant of the plan on the device of the parameters, cached; None without ``make``, if it is not
        cached."""
        key = (name, self.density.device)
        constant = self._packed.get(key)
        # If several threads make it at once, the first result is used: kernels store addresses, not references.
        return self._packed.setdefault(key, make()) if constant is None and make is not None else constant

    def build(
        self, plan: ScenePlan, factor: float, tiles: Int[Tensor, "T"] | None = None, copied: bool = False
    ) -> None:
        """Allocates new tables for ``plan`` at ``factor`` times its texels. Parameters stay the same objects.

        Args:
            plan: frames and resolutions.
            factor: texels in use, as a share of the plan's.
            tiles: tiles to store; None for those that training rays can reach.
            copied: MPIs have finer copies, before them.
        """
        self.full_plan, self.plan, self.factor = plan, plan.scaled(factor), factor
        if copied:
            self.plan = self.plan.with_copies()
        device = self.density.device
        self.copied = torch.tensor(copied, device=device)
        if tiles is None:
            every = head_grids(self.plan)[0].tiles
            tiles = every if self.views is None else number_tiles(reachable_tiles(self.views, self.plan, device))
        self.tiles = tiles.to(device, copy=True)
        self._change_tables(lambda table, empty: new_table(self.tiles, table.shape[1], empty))
        self.touched = torch.zeros(len(self.density), dtype=torch.uint8, device=device)
        self.plan_bytes = to_bytes(plan.to_json()).to(device)
        self.texel_factor = torch.tensor(factor, dtype=torch.float64, device=device)
        self.look_afresh()

    @torch.no_grad()
    def tiles_at(self, factor: float) -> Int[Tensor, "T"]:
        """``tiles`` with ``factor`` times the plan's texels, if the tables grew to that now.

        Surfaces have formed when texels become finer than planned: then, texels beyond the middle between a stored and
        an empty one stay empty. Otherwise a rim of tiles would be stored again each time.
        """
        plan, least, device = self.full_plan.scaled(factor), MIDDLE if factor > 1 else 0.0, self.density.device
        reached = None if self.views is None else reachable_tiles(self.views, plan, device)
        return grown_tiles(self.grids, head_grids(plan), reached, least).to(device)

    @torch.no_grad()
    def grow(self, factor: float, tiles: Int[Tensor, "T"] | None = None) -> None:
        """Resamples every table to ``factor`` times the plan's texels (paper sec. IV; bilinear on each plane).

        Args:
            factor: texels, as a share of the plan's.
            tiles: to store, of ``tiles_at(factor)``; None: those.
        """
        tiles = self.tiles_at(factor) if tiles is None else tiles
        old, self.plan, self.factor = self.grids, self.full_plan.scaled(factor), factor
        new = head_grids(self.plan, tiles)
        touched = resample(self.touched[:, None].float(), old, new)
        self.tiles, self.touched = tiles, (touched[:, 0] > 0).to(torch.uint8)
        self._change_tables(lambda table, empty: resample(table, old, new, empty))
        self.texel_factor.fill_(factor)
        self.look_afresh()

    @torch.no_grad()
    def copy_finely(self, chosen: Bool[Tensor, "T"]) -> None:
        """Inserts finer copies of the MPIs, with the chosen tiles, before all heads (``tiles_with_copies``)."""
        grids, copies = self.grids, self.copy_grids()
        fine, kept = tiles_with_copies(grids, copies, chosen)
        mpis, copies = grids[: len(copies)], self.copy_grids(number_tiles(fine))
        remaining = self.tiles[kept].to(torch.int64)
        touched = resample(self.touched[:, None].float(), mpis, copies)
        self.touched = torch.cat([(touched[:, 0] > 0).to(torch.uint8), move_bricks(self.touched, remaining)])
        self.tiles, self.plan = number_tiles(torch.cat([fine, kept])), self.plan.with_copies()
        self._change_tables(
            lambda table, empty: torch.cat([resample(table, mpis, copies, empty), move_bricks(table, remaining)])
        )
        self.copied = torch.ones_like(self.copied)
        self.look_afresh()

    def _change_tables(self, change: Callable[[Tensor, float], Tensor]) -> None:
        """Replaces the data of every table, given with the content of its empty brick. Constants are made anew."""
        for name in TABLES:
            table = getattr(self, name)
            replace_data(table, change(table.data, EMPTY[name]))
        self._packed = {}

    def copy_grids(self, tiles: Int[Tensor, "S"] | None = None) -> list[TexelGrid]:
        """Texels of finer copies of the MPIs, before there are any; ``tiles``: None stores all."""
        mpis = self.plan.with_copies().mpis[: len(self.plan.mpis)]
        return make_grids([(m.planes, m.height, m.width) for m in mpis], tiles)

    def planned_heads(self, heads: Tensor) -> Tensor:
        """Indices of heads in the plan; a finer copy has that of its MPI."""
        return torch.where(heads >= self.num_copies, heads - self.num_copies, heads)

    @property
    def num_copies(self) -> int:
        """Number of finer copies, which come before the MPIs."""
        return len(self.plan.mpis) - len(self.full_plan.mpis)

    @torch.no_grad()
    def note_use(
        self, lookup: Lookup, samples: MergedSamples, weights: Float[Tensor, "N"], errors: Float[Tensor, "R"]
    ) -> None:
        """Raises the peaks of bricks to the largest weight of a sample of a training batch that reads them, and adds
        weights times errors to the gains of the bricks of first texels, in the order of samples.

        Args:
            lookup: of the samples in the tables.
            samples: of the batch.
            weights: of the samples.
            errors: squared errors of the rays' colours, 0 where a ray has none.
        """
        bricks, positions = lookup.rows >> 6, lookup.taps.positions
        read = bricks.index_select(0, positions.reshape(-1))
        self.peak.scatter_reduce_(0, read, weights.repeat_interleave(positions.shape[1]), "amax")
        if self.num_copies == 0:
            shares = weights * errors.index_select(0, samples.rays)
            self.gain.index_add_(0, bricks.index_select(0, positions[:, 0]), shares)
        self.crossings += samples.num_intersected.sum()

    @torch.no_grad()
    def release_unused(self, least: float) -> Int[Tensor, "K"] | None:
        """Releases the bricks in which no training sample had the weight ``least``, and resets the records of use.

        Returns:
            Previous numbers of the remaining bricks (for ``TouchedAdam.keep_bricks``); None if nothing changed, for
            example after too few rays.
        """
        enough = float(self.crossings) >= ENOUGH_CROSSINGS * self.num_bricks
        kept = self._keep(self.peak >= least) if enough else None
        self.look_afresh()
        return kept

    def look_afresh(self) -> None:
        """Resets the records on the use of bricks."""
        self.peak = torch.zeros(self.num_bricks + 1, device=self.density.device)
        self.gain = torch.zeros_like(self.peak)
        self.crossings = torch.zeros((), dtype=torch.float64, device=self.density.device)

    @torch.no_grad()
    def release_untouched(self) -> Int[Tensor, "K"] | None:
        """Empties the texels that no ray trained: alpha 0, no share in the blending. Returns as ``release_unused``."""
        self.density.data[self.touched == 0] = RELEASED_DENSITY
        return self._keep(self.touched.view(-1, BRICK).any(-1))

    def _keep(self, keep: Bool[Tensor, "B"]) -> Int[Tensor, "K"] | None:
        """Releases the other bricks. Returns as ``release_unused``."""
        keep = keep.clone()
        keep[0] = True  # the empty brick
        numbers, kept = (keep.cumsum(0) - 1) * keep, keep.nonzero()[:, 0]
        if len(kept) == len(keep):
            return None
        self.tiles = numbers[self.tiles.to(torch.int64)].to(torch.int32)
        self._change_tables(lambda table, _: move_bricks(table, kept))
        self.touched, self.peak, self.gain = move_bricks(self.touched, kept), self.peak[kept], self.gain[kept]
        return kept

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes plan, resolution and tiles from the checkpoint first, so that all shapes fit."""
        plan_bytes = state_dict.get(prefix + "plan_bytes")
        if plan_bytes is None:
            if not any(key.startswith(prefix) for key in state_dict):
                return  # nerfstudio loads the pipeline's own, empty state in a second pass
            raise ValueError("The checkpoint holds no scene plan: it was not written by this method.")
        plan = ScenePlan.from_json(to_text(plan_bytes))
        copied = bool(state_dict[prefix + "copied"])
        self.build(plan, float(state_dict[prefix + "texel_factor"]), state_dict[prefix + "tiles"], copied)
        self.plan_bytes = plan_bytes.clone().to(self.density.device)  # as written, even if plans have other fields now
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def replace_data(parameter: nn.Parameter, data: Tensor) -> None:
    """Gives a parameter data of another shape.

    A graph of an earlier step that is still referenced keeps the parameter's gradient accumulator, and with it the old
    shape, alive. Torch renews the accumulator when the dtype changes, so the data goes through another dtype.
    """
    parameter.grad = None
    parameter.data = torch.empty(0, dtype=torch.float64, device=data.device)
    parameter.data = data


def in_half_precision(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a field that is trained, for its file: tables take half of the bytes, under whatever prefix.

    Images change by a fraction of a grey level.
    """
    tables = {name: x for name, x in state.items() if name.rpartition(".")[2] in TABLES}
    return dict(state) | {name: x.clamp(-HALF_LARGEST, HALF_LARGEST).half() for name, x in tables.items()}
