"""Fields with random tables, a renderer made of the product's parts, and the same rays by the slow oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import oracle
import pytest
import torch
from hand_made import random_mpi, unit
from random_scenes import bundle_of as bundle
from random_scenes import of_rays

from mmpi_ns.blending import blended_optical_depth
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.composite import composite_weights, render_colors
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.sampler import march, rays_of
from mmpi_ns.scene.plan import CubePlan, ScenePlan


def random_plan(num_mpis, with_cube, seed, planes=12):
    rng = np.random.default_rng(seed)
    cube = CubePlan((-1.5, -1.2, -1.0), (1.4, 1.6, 2.0), (6, 5, 4)) if with_cube else None
    return ScenePlan(tuple(random_mpi(rng, f"mpi{k}", planes=planes) for k in range(num_mpis)), cube, 0.05, 1.0)


def fill(field, seed, log_depths=(-2.5, 0.5)):
    """Random tables in place: optical depths of 10^log_depths, features, votes, networks; all texels trained."""
    rng = np.random.default_rng(seed)
    for k, grid in enumerate(field.grids):
        scale, biases = _density_constants(field, k)
        wanted = 10 ** rng.uniform(*log_depths, size=(grid.depth, grid.height * grid.width)) / scale
        raw = np.log(np.expm1(wanted)) - biases[:, None]
        field.density.data[grid.rows, 0] = torch.tensor(raw.reshape(-1), dtype=torch.float32)
    field.features.data = torch.tensor(rng.normal(size=field.features.shape), dtype=torch.float32)
    field.reliability.data = torch.tensor(rng.normal(size=field.reliability.shape) * 3, dtype=torch.float32)
    field.networks.weights.data = torch.tensor(rng.normal(size=field.networks.weights.shape) * 0.3, dtype=torch.float32)
    field.touched.fill_(1)
    return field.eval()


def random_field(num_mpis, with_cube=False, seed=0, planes=12, **filled):
    plan = random_plan(num_mpis, with_cube, seed, planes)
    return fill(MMPIField(plan, feature_channels=5, hidden_width=6, samples_per_voxel=1.5), seed, **filled)


def random_rays(plan, count, seed):
    """Origins around one MPI's origin after the other, and unit directions into its frustum."""
    rng = np.random.default_rng(seed)
    origins = np.array([plan.mpis[i % len(plan.mpis)].origin for i in range(count)]) + rng.normal(size=(count, 3)) * 0.6
    targets = [
        oracle.ndc_to_world(plan.mpis[i % len(plan.mpis)], rng.uniform([-0.8, -0.8, -0.8], 0.6))[0]
        for i in range(count)
    ]
    return origins, np.stack([unit(t - o) for t, o in zip(targets, origins, strict=True)])


@dataclass(frozen=True)
class Rendered:
    samples: object
    composite: object
    rgb: torch.Tensor


def sampled(field, rays, threshold=0.0, blends=False, fair_share=math.inf, head_mask=None, choose=None):
    """The rays, and what the march keeps of them: arguments of the field."""
    options = MarchOptions(threshold, fair_share, blends)
    return rays, march(field.layout, field.tables, rays_of(rays, head_mask, choose), options)


@torch.no_grad()
def render(field, rays, threshold=0.0, blends=False, **chosen):
    """March, field and compositing, put together as the model does."""
    _, samples = sampled(field, rays, threshold, blends, **chosen)
    tau, lookup = field.optical_depths(rays, samples)
    if blends and tau.numel():
        tau = blended_optical_depth(tau, *field.sample_shares(rays, samples))
    composite = composite_weights(tau, samples.starts, samples.skipped_before, samples.skipped_total)
    colors = field.sample_colors(rays, samples, lookup)
    return Rendered(samples, composite, render_colors(composite, colors, samples.starts))


# The same by loops in float64 -----------------------------------------------------------------------------------------


def _density_constants(field, k):
    """(factor on softplus, bias of every plane) from the definition: equal weights, or the cube's initial alpha."""
    if k < len(field.plan.mpis):
        biases, interval = oracle.plane_bias(field.plan.mpis[k].planes)
        return interval * field.layout.depth_scale, biases
    interval = 1 / field.samples_per_voxel
    return interval, np.full(field.grids[k].depth, math.log((1 - field.cube_alpha) ** (-1 / interval) - 1))


def _table(field, table, k):
    grid = field.grids[k]
    return table.detach().double()[grid.rows].view(grid.depth, grid.height, grid.width, -1).numpy()


def _encode(x, frequencies):
    waves = np.concatenate([x * math.pi * 2**i for i in range(frequencies)])
    return np.concatenate([x, np.sin(waves), np.cos(waves)])


def _color(networks, k, features, ndc, direction):
    flat = networks.weights.detach().double().numpy()[k if len(networks.weights) > 1 else 0]
    layers, start = [], 0
    for shape in networks.shapes:
        layers.append(flat[start : start + math.prod(shape)].reshape(shape))
        start += math.prod(shape)
    x = [features, *(_encode(v, n) for v, n in zip((ndc, direction), networks.frequencies, strict=True))]
    hidden = np.maximum(layers[0] @ np.concatenate(x) + layers[1], 0)
    hidden = np.maximum(layers[2] @ hidden + layers[3], 0)
    return 1 / (1 + np.exp(-(features[:3] + layers[4] @ hidden + layers[5])))


def _places(plan, origin, direction, inverse_t):
    """NDC of a point in every head, None where it is behind an MPI or, in the cube, at infinity."""
    actual = [oracle.place_in(m, origin, direction, inverse_t) for m in plan.mpis]
    actual = [None if place is None else place[0] for place in actual]
    if plan.cube is not None:
        lower, upper = np.array(plan.cube.lower), np.array(plan.cube.upper)
        point = None if inverse_t == 0 else origin + direction / inverse_t
        actual.append(None if point is None else 2 * (point - lower) / (upper - lower) - 1)
    return actual


class OracleRay:
    """The samples of every head on one ray, and how close any decision was (``margin``)."""

    def __init__(self, field, origin, direction, near=0.05, far=math.inf):
        self.field, self.origin, self.direction = field, origin, direction
        self.margin, self.heads, plan = math.inf, [], field.plan
        for k, mpi in enumerate(plan.mpis):
            actual = oracle.crossings(mpi, origin, direction, near, far)
            self.margin = min(self.margin, float(actual.margin.min()))
            self.heads.append(
                [self._sample(k, p, actual.inverse_t[p]) for p in np.flatnonzero(actual.intersected).tolist()]
            )
        if plan.cube is not None:
            sides = [(b - a) / (n - 1) for a, b, n in zip(plan.cube.lower, plan.cube.upper, plan.cube.shape[::-1])]  # noqa: B905
            step = min(sides) / field.samples_per_voxel
            actual, margin = oracle.cube_samples(plan.cube, step, origin, direction, near, far)
            self.margin = min(self.margin, margin)
            self.heads.append([self._sample(len(plan.mpis), i, 1 / ((i + 0.5) * step)) for i in actual])
        met = sorted((s.inverse_t, s.head) for head in self.heads for s in head)
        for (a, i), (b, j) in pairwise(met):
            self.margin = min(self.margin, (b - a) / (1 + b) if i != j and a != b else math.inf)

    def _sample(self, k, plane, inverse_t):
        field = self.field
        places = _places(field.plan, self.origin, self.direction, inverse_t)
        ndc, (scale, biases) = places[k], _density_constants(field, k)
        if k < len(field.plan.mpis):
            tables = [oracle.lookup(_table(field, t, k)[plane], ndc[:2]) for t in (field.density, field.features)]
            axes, bias = np.array(field.plan.mpis[k].axes), biases[plane]
        else:
            tables = [oracle.lookup(_table(field, t, k), ndc) for t in (field.density, field.features)]
            axes, bias = np.eye(3), biases[0]
        votes = [self._vote(j, place, j == k, ndc) for j, place in enumerate(places)]
        copies = len(field.plan.mpis) - len(field.full_plan.mpis)
        network = k - copies if k >= copies else k  # a finer copy has that of its MPI
        return oracle.RaySample(
            k, plane, inverse_t,
            float(np.logaddexp(0, tables[0][0] + bias) * scale),
            _color(field.networks, network, tables[1], ndc, axes @ self.direction),
            np.array([v for v, _ in votes]),
            np.array([c for _, c in votes]),
        )  # fmt: skip

    def _vote(self, j, ndc, own, own_ndc):
        """(reliability, covers) of one head at a place."""
        if ndc is None:
            return 0.0, own
        inside = bool(np.all(np.abs(ndc) <= 1 + 1e-12))
        if not np.allclose(ndc, own_ndc, atol=1e-9):
            gaps = np.abs(np.abs(ndc) - 1)
            self.margin = min(self.margin, float(gaps[: 2 if ndc[2] == 1 else 3].min()))
        if not inside and not own:
            return 0.0, False
        touched, position = _table(self.field, self.field.touched, j)[..., 0], []
        for coordinate, size in zip(ndc[::-1], touched.shape, strict=True):
            at = min(max((coordinate + 1) / 2 * (size - 1), 0), size - 1)
            self.margin = min(self.margin, abs(at % 1 - 0.5) if not touched.all() else math.inf)
            position.append(round(at))
        value = oracle.lookup(_table(self.field, self.field.reliability, j), np.clip(ndc, -1, 1))[0]
        return value, own or bool(touched[tuple(position)])

    def render(self, blends=False, heads=None):
        chosen = self.heads if heads is None else [s if k in heads else [] for k, s in enumerate(self.heads)]
        return oracle.render_ray(chosen, blends)


ERROR = 3e-5
"""float32 against float64."""
CLEAR = 2e-5
"""Rays on which any decision is closer than this may differ in float32 and are left out."""


def compare(field, origins, directions, blends=False, heads_of=None, near=0.05, far=math.inf, error=ERROR, **chosen):
    """Renders all rays at once and each by the oracle; returns the number of clear rays that met something."""
    actual = render(field, bundle(origins, directions, near, far), blends=blends, **chosen)
    columns = (getattr(actual.samples, name) for name in ("heads", "planes", "inverse_t"))
    samples, met = [of_rays(actual, x) for x in (*columns, actual.composite.weights)], 0
    for i in range(len(origins)):
        ray = OracleRay(field, origins[i], directions[i], near, far)
        if ray.margin < CLEAR:
            continue
        wanted = ray.render(blends, heads_of(i, ray) if heads_of else None)
        count = len(wanted.samples)
        assert actual.samples.num_intersected[i] == count
        heads, planes, inverse_t, weights = (x[i] for x in samples)
        assert heads.tolist() == [s.head for s in wanted.samples]
        assert planes.tolist() == [s.plane for s in wanted.samples]
        assert inverse_t.tolist() == pytest.approx([s.inverse_t for s in wanted.samples], rel=1e-4, abs=1e-6)
        assert np.abs(weights.numpy() - wanted.weights).max(initial=0) < error
        assert np.abs(actual.rgb[i].numpy() - wanted.color).max() < error
        assert abs(actual.composite.transmittance[i].item() - wanted.transmittance) < error
        met += count > 0
    return met
