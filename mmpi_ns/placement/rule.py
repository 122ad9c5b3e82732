"""The placement rule: MPIs are added where they lower the expected pixel error most, as long as each lowers it enough.

Greedy facility location (Nemhauser et al. 1978) over ``candidates.py``: every observation is served by the chosen head
with the smallest expected error for it (``errors.py``), and the candidate that lowers the mean of log2(error) most for
its texels is added, until the next would add too little. Heads that have become superfluous are removed. Then each MPI
gets the planes that its observations need, and is widened until the borders of every image, and a margin around them,
lie in some MPI.

Two arrangements are fixed instead: four MPIs by hand along a drive, a baseline, and the paper's room.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.candidates import Candidate, facing_axes, find_candidates, vector
from mmpi_ns.placement.errors import WORST
from mmpi_ns.placement.observations import Array, Observations, VisiblePoints, find_visible_points, pixels_per_pixel
from mmpi_ns.scene.plan import MOST_DETAIL, CubePlan, MPIPlan, ScenePlan
from mmpi_ns.settings import PlacementConfig

MIN_PLANES = 16
FULL, FINER = 0.8, 1.03
"""Share of the texel budget that is enough, and factor of the texel size in the search."""
BUDGET_ROUNDS = 8
"""Maximum number of attempts to meet the texel budget, each with coarser texels."""
BEYOND = 0.05
"""Margin around an image that should have texels, as a fraction of its sides, for other views."""
WIDEST, FARTHEST = 3.0, 0.5
"""Limits on widened tangents, absolute and relative: a border far from all MPIs would be too expensive."""
ENOUGH = 0.85
"""Expected error, relative to a texel's pixels, below which no further MPI is needed."""
TEXELS_PER_RAY = 8.0
"""Maximum texels for each training ray, in total: more would overfit."""
DRIVE_PULL_BACK = 0.45
"""Distance of the front MPI of a drive behind the first camera, as a fraction of the travel."""
OVERLAPPING = 1.25
"""Half the extent of each MPI of a room, a tangent: above 1 neighbours overlap."""


def place(observations: Observations, config: PlacementConfig, training_rays: int | None = None) -> ScenePlan:
    """The scene plan for training cameras and their observations. Texels are no finer than ``training_rays``, the pixel
    rays of the whole training, can train. Raises ValueError if all observations are behind their cameras."""
    visible = find_visible_points(observations)
    if config.arrangement == "room":
        return _room(observations, visible.near, config)
    if config.arrangement == "drive":  # some of four MPIs along a straight drive, placed by hand in metres
        metre = visible.near / 5  # the rule was made where the nearest point lies 5 m away
        base = observations.mean_axes
        centers = observations.centers @ base.T
        start = np.array([centers[:, 0].mean(), centers[:, 1].mean(), centers[:, 2].min()])
        travel = float(np.ptp(centers[:, 2])) / metre
        back = DRIVE_PULL_BACK * travel
        # origin (right, down, forward) in metres from the first camera, near, tangents along the MPI's own x and y
        rule = {
            "front": ((0.0, 0.0, -back), back + 3, (-1.0, 1.0, -0.35, 0.35)),
            "left": ((8.0, 0.0, travel / 2), 10.0, (-2.5, 9.0, -0.7, 0.4)),
            "right": ((-8.0, 0.0, travel / 2), 10.0, (-9.0, 2.5, -0.7, 0.4)),
            "below": ((0.0, -4.0, travel / 2), 4.8, (-6.0, 6.0, -18.0, 6.0)),
        }
        mpis, size = [], (config.planes, config.height, config.width)
        for name in config.faces:
            origin, near, extent = rule[name]
            world = (start + np.array(origin) * metre) @ base
            mpis.append(MPIPlan(name, vector(world), facing_axes(base, name), near * metre, extent, *size))
        return ScenePlan(tuple(mpis), None, 1.0 * metre, 5.0 * metre, "hand-made drive")
    trainable, budget = texel_limits(observations, visible, config, training_rays)
    finest = max(config.texel_pixels, trainable)
    chosen, texel_pixels = _choose(observations, visible, replace(config, max_texels=budget), finest)
    detail = 1.0
    if texel_pixels > finest and budget != config.max_texels:
        remedy = "more steps"
    elif texel_pixels > finest:  # there are rays for finer texels, and released ones leave room
        detail = min((texel_pixels / finest) ** 2, MOST_DETAIL)
        remedy = f"a larger placement.max-texels, or down to {finest:.1f} in training in the room of released ones"
    else:
        remedy = "more steps" if trainable > config.texel_pixels else "a smaller placement.texel-pixels"
    origin = f"automatic placement, a texel spans {texel_pixels:.1f} pixels: finer with {remedy}"
    mpis = tuple(replace(m, name=f"{m.name} ({i})") for i, m in enumerate(chosen))  # two may be placed at one camera
    return ScenePlan(mpis, None, 0.2 * visible.near, visible.near, origin, detail)


def _room(observations: Observations, content_near: float, config: PlacementConfig) -> ScenePlan:
    """The paper's ScanNet arrangement: five MPIs around the cameras' centre and a cube (sec. IV)."""
    half_size = float(np.abs(observations.centers - observations.centers.mean(0)).max()) + content_near
    near, base = max(0.5 * content_near, 1e-6), observations.mean_axes
    center = (observations.centers.min(0) + observations.centers.max(0)) / 2
    extent = (-OVERLAPPING, OVERLAPPING, -OVERLAPPING, OVERLAPPING)
    names, size = ("front", "back", "left", "right", "below"), (config.planes, config.height, config.width)
    mpis = (MPIPlan(n, vector(center), facing_axes(base, n), near, extent, *size) for n in names)
    corners, voxels = (vector(center - half_size), vector(center + half_size)), config.cube_voxels
    cube = CubePlan(*corners, (voxels, voxels, voxels)) if voxels else None
    return ScenePlan(tuple(mpis), cube, 0.1 * near, near, "hand-made room")


def texel_limits(
    observations: Observations, visible: VisiblePoints, config: PlacementConfig, training_rays: int | None
) -> tuple[float, float]:
    """Pixels that a texel must span to meet ``rays_per_texel`` of the training's rays (0 if these are not known), and
    texels in all that the settings and these rays allow (0 for any number)."""
    limits = [config.max_texels, TEXELS_PER_RAY * (training_rays or 0)]
    budget = min((limit for limit in limits if limit > 0), default=0.0)
    if training_rays is None:
        return 0.0, budget
    rays_per_pixel = training_rays / float(observations.sizes.prod(-1).sum())
    return (config.rays_per_texel / (rays_per_pixel * pixels_per_pixel(observations, visible))) ** 0.5, budget


def _choose(
    observations: Observations, visible: VisiblePoints, config: PlacementConfig, finest: float
) -> tuple[list[MPIPlan], float]:
    """The MPIs for a scene, with texels no finer than the budget allows, and the pixels that a texel spans."""
    candidates = find_candidates(observations, visible)

    def heads_at(choice: _Choice, size: float) -> tuple[list[MPIPlan], float]:
        """Heads, and the share of the budget that they use."""
        heads = widened(choice.heads(size), observations, visible)
        return heads, sum(h.texels for h in heads) / config.max_texels if config.max_texels else 0.0

    tried: list[tuple[_Choice, float, list[MPIPlan], float]] = []
    too_fine, texel_pixels = None, finest
    for _ in range(BUDGET_ROUNDS):
        choice = _Choice(candidates, visible.weights, config, texel_pixels)
        heads, used = heads_at(choice, texel_pixels)
        tried.append((choice, texel_pixels, heads, used))
        if used > 1.0:
            too_fine = texel_pixels
            # Coarser texels mean fewer rows, columns and planes: nearly a third power.
            texel_pixels *= max(1.04, used ** (1 / 3)) if min(t[-1] for t in tried) > 1.0 else 1.1
        elif too_fine is None or used > FULL:
            break
        else:
            texel_pixels = (too_fine * texel_pixels) ** 0.5
    # The last that fits; if none does, the last.
    choice, texel_pixels, heads, used = ([t for t in tried if t[-1] <= 1.0] or tried)[-1]
    # Slightly finer texels may have required further heads, which do not fit: then there is room for those alone.
    while used < FULL and texel_pixels / FINER >= finest:
        finer, used = heads_at(choice, texel_pixels / FINER)
        if used > 1.0:
            break
        heads, texel_pixels = finer, texel_pixels / FINER
    return heads, texel_pixels


class _Choice:
    """Greedy choice among candidates, by the cost of every observation in each; ``chosen`` are their numbers."""

    def __init__(
        self, candidates: list[Candidate], weights: NDArray[np.float64], config: PlacementConfig, texel_pixels: float
    ) -> None:
        self.candidates, self.weights, self.config = candidates, weights, config
        # Cost of each observation in each candidate: log2 of the expected pixel error over ``ENOUGH``.
        enough, cost = ENOUGH * texel_pixels, []
        for c in candidates:
            error = np.hypot(c.plane / (config.max_planes - 1), 0.5 * texel_pixels * c.texel)
            cost.append(np.log2(np.clip(error, enough, max(WORST, 2 * enough)) / enough).astype(np.float32))
        self.cost: NDArray[np.float32] = np.stack(cost)
        self.nothing = np.full(self.cost.shape[1], self.cost.max(), np.float32)
        texels = [c.at(texel_pixels, config.max_planes).texels for c in candidates]
        self.texels = np.array(texels, dtype=np.float64)
        self.price = np.sqrt(self.texels)  # the gain of a candidate is divided by it
        self.chosen = self._choose()

    def heads(self, texel_pixels: float) -> list[MPIPlan]:
        """The chosen heads with texels of a size, each MPI with the planes it needs."""
        config, owner, heads = self.config, self.cost[self.chosen].argmin(0), []
        for n, candidate in enumerate(self.candidates[j] for j in self.chosen):
            # Planes at which the error of four fifths of the observations that it serves is small enough.
            error = candidate.plane[owner == n]
            error = error[np.isfinite(error)]
            steps = float(np.quantile(error, 0.8)) / (config.plane_pixels * texel_pixels) if len(error) else 0.0
            planes = int(np.clip(8 * round((1 + steps) / 8), MIN_PLANES, config.max_planes))
            heads.append(candidate.at(texel_pixels, planes))
        return heads

    def _choose(self) -> list[int]:
        """Adds, one by one, the candidate with the largest gain for its texels, until none gains enough."""
        # A scene needs an MPI, however little it gains.
        gain = np.maximum(self.nothing - self.cost, 0) @ self.weights
        chosen = [int((gain / self.price).argmax())]
        while len(chosen) < self.config.max_mpis:
            more = np.maximum(np.minimum(self.nothing, self.cost[chosen].min(0)) - self.cost, 0) @ self.weights
            allowed = more >= self.config.min_gain
            if not allowed.any():
                break
            best = int(np.where(allowed, more / self.price, -1.0).argmax())
            grown = [*chosen, best]
            while True:  # without the heads whose absence costs less than the minimum gain, one by one
                total = self._total(grown)
                losses = [self._total([c for c in grown if c != j]) - total for j in grown]
                least = int(np.argmin(losses))
                if len(grown) == 1 or losses[least] >= self.config.min_gain:
                    break
                del grown[least]
            if self._total(grown) >= self._total(chosen):  # it makes itself or a better one superfluous
                break
            chosen = grown
        # The first is chosen relative to its texels, and further ones may only compensate for it: another one may
        # suffice alone.
        affordable = self.texels <= self.texels[chosen].sum()
        alone = [int(np.where(affordable, gain, -1.0).argmax())]
        spared = self.config.min_gain * (len(chosen) - 1)
        return alone if self._total(alone) <= self._total(chosen) + spared else chosen

    def _total(self, chosen: list[int]) -> float:
        """Remaining expected error, in bits, summed over images."""
        served = np.minimum(self.nothing, self.cost[chosen].min(0)) if chosen else self.nothing
        return float(served @ self.weights)


def widened(mpis: list[MPIPlan], observations: Observations, visible: VisiblePoints) -> list[MPIPlan]:
    """The MPIs, widened if the borders of an image lie in none of them; texels keep their size.

    A border is tested at the depths between which the image's points lie. Each border point outside all MPIs is
    assigned to the MPI that must grow least for it.
    """
    points = border_points(observations, visible)
    origins = np.array([m.origin for m in mpis], dtype=np.float64)
    axes = np.array([m.axes for m in mpis], dtype=np.float64)
    local = np.einsum("kij,kpj->kpi", axes, points - origins[:, None])
    depths = local[..., 2]
    tangents = local[..., :2] / np.where(depths > 0, depths, np.nan)[..., None]
    extents = np.array([m.extent for m in mpis])
    ahead = (depths >= np.array([[m.near] for m in mpis])) & (depths <= np.array([[m.far] for m in mpis]))
    held = ahead & (_outside(tangents, extents).max(-1) <= 0)
    able = ahead & (np.abs(tangents).max(-1) <= WIDEST) & (_outside(tangents, extents).max(-1) <= FARTHEST)
    for p in np.nonzero(~held.any(0) & able.any(0))[0]:
        missing = np.maximum(_outside(tangents[:, p], extents), 0)
        k = int(np.where(able[:, p], missing.sum(-1), np.inf).argmin())
        u, v = tangents[k, p]
        u0, u1, v0, v1 = extents[k]
        extents[k] = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    result = []
    for mpi, (u0, u1, v0, v1) in zip(mpis, extents.tolist(), strict=True):
        across, down = (u1 - u0) / (mpi.extent[1] - mpi.extent[0]), (v1 - v0) / (mpi.extent[3] - mpi.extent[2])
        width, height = round((mpi.width - 1) * across) + 1, round((mpi.height - 1) * down) + 1
        result.append(replace(mpi, extent=(u0, u1, v0, v1), width=width, height=height))
    return result


def border_points(observations: Observations, visible: VisiblePoints) -> Array:
    """[M * 32, 3] points around every image's border, at the depths where a quarter and most of its points begin."""
    steps = (0.0, 0.25, 0.5, 0.75, 1.0)
    rim = np.array([(a, b) for a in steps for b in steps if a in (0.0, 1.0) or b in (0.0, 1.0)])
    shares = -BEYOND + (1 + 2 * BEYOND) * rim
    clouds = []
    for i, (pose, depths) in enumerate(zip(observations.camera_to_worlds, visible.typical, strict=True)):
        directions = observations.directions(i, shares) @ pose[:, :3].T
        clouds += [pose[:, 3] + depth * directions for depth in depths]
    return np.concatenate(clouds)


def _outside(tangents: Array, extents: Array) -> Array:
    """[K, ..., 2] how far tangents lie outside the extents [K, 4]; negative inside, not a number behind."""
    shape = (len(extents), *(1,) * (tangents.ndim - 2))
    u0, u1, v0, v1 = (extents[:, i].reshape(shape) for i in range(4))
    u, v = tangents[..., 0], tangents[..., 1]
    return np.stack([np.maximum(u0 - u, u - u1), np.maximum(v0 - v, v - v1)], -1)
