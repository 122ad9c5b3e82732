"""The oracle on rays worked out by hand, and the pure modules together against the oracle."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import make_mpi, random_mpi, rays, samples_to_ndc, unit

from mmpi_ns.blending import blend_shares, blended_optical_depth
from mmpi_ns.ops.composite import composite_weights, median_inverse_distance, render_colors
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.scene.geometry import Frames, inverse_distance, plane_hits, sample_disparity
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, head_grids


def test_oracle_crosses_planes_where_geometry_says():
    mpi = make_mpi(near=1.0, planes=3, extent=(-1.2, 1.2, -1.0, 1.0))  # depths 1, 2, infinity
    found = oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8])
    assert [c.live for c in found] == [False, True, True]
    assert [c.u for c in found] == pytest.approx([1.5, 1.125, 0.75])
    assert [c.inverse_t for c in found] == pytest.approx([1 / 2.5, 1 / 3.75, 0])
    assert [c.live for c in oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], far=4.0)] == [False, True, False]
    assert [c.live for c in oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], near=3.8)] == [False, False, True]


def test_oracle_renders_two_planes_by_hand():
    near, far = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    both = np.ones(2, bool)
    samples = [
        [oracle.RaySample(0, 0, 0.5, math.log(2), near, np.array([0.0, 0.0]), both)],
        [oracle.RaySample(1, 0, 1.0, math.log(4), far, np.array([0.0, math.log(3)]), both)],
    ]
    ray = oracle.render_ray(samples)
    # The second head is nearer: alpha' = 3/4 * 3/4; then alpha' = 1/2 * 1/2.
    assert ray.weights.tolist() == pytest.approx([9 / 16, 7 / 16 / 4])
    assert ray.color.tolist() == pytest.approx([7 / 64, 9 / 16, 0])
    assert ray.transmittance == pytest.approx(21 / 64) and ray.median_inverse_distance == 1.0
    assert oracle.render_ray(samples, False).transmittance == pytest.approx(1 / 8)


def make_scene(num_mpis, seed):
    """A plan and random tables: optical depth, colour [3] and reliability of every texel."""
    rng = np.random.default_rng(seed)
    plan = ScenePlan(tuple(random_mpi(rng, f"mpi{k}", planes=12) for k in range(num_mpis)), None, 0.05, 1.0)
    rows = len(head_grids(plan)[0].places) * BRICK
    depth = torch.tensor(10 ** rng.uniform(-3, 1, size=(rows, 1)))
    return plan, depth, torch.tensor(rng.random((rows, 3))), torch.tensor(rng.normal(size=(rows, 1)) * 3)


def render_by_oracle(scene, origin, direction):
    plan, *tables = scene
    blocks = [
        [t[g.rows].view(g.depth, g.height, g.width, -1).numpy() for g in head_grids(plan)] for t in tables
    ]  # fmt: skip
    samples = [
        oracle.sample_mpi(
            head, plan.mpis, origin, direction, plan.ray_near, math.inf,
            lambda k, plane, u, v: oracle.bilinear(blocks[0][k][plane], u, v)[0],
            lambda k, plane, u, v: oracle.bilinear(blocks[1][k][plane], u, v),
            lambda k, ndc: oracle.trilinear(blocks[2][k], ndc)[0],
        )
        for head in range(len(plan.mpis))
    ]  # fmt: skip
    return oracle.render_ray(samples)


def render_by_modules(scene, origin, direction, dtype):
    """One ray through geometry, texels, interpolate and compositing, as the sampler and the field do for batches."""
    plan, *tables = scene
    depths, colors, votes = (t.to(dtype) for t in tables)
    frames, grids = Frames.pack(plan.mpis, dtype=dtype), head_grids(plan)
    o, d, nears, fars = rays(origin, direction, near=plan.ray_near, dtype=dtype)
    hits = plane_hits(o, d, nears, fars, frames)
    parts = []
    for k, grid in enumerate(grids):
        m = hits.m_first[0, k] - torch.arange(int(hits.count[0, k]))
        w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
        inverse_t = inverse_distance(w, hits.local_origins[0, k, 2], hits.local_directions[0, k, 2])
        ndc, cover = samples_to_ndc(o.expand(len(m), 3), d.expand(len(m), 3), inverse_t, frames)
        cover[:, k] = True
        lookup = grid.bilinear(plan.mpis[k].planes - 1 - m, ndc[:, k, :2])
        reliability = [interpolate(votes, *g.trilinear(ndc[:, j]))[:, 0] for j, g in enumerate(grids)]
        log_p, log_q = blend_shares(torch.stack(reliability, -1), cover, torch.full_like(m, k))
        tau = blended_optical_depth(interpolate(depths, *lookup)[:, 0], log_p, log_q)
        parts.append((inverse_t, tau, interpolate(colors, *lookup)))
    inverse_t, tau, color = (torch.cat(p)[None] for p in zip(*parts, strict=True))
    order = torch.sort(inverse_t, descending=True, stable=True).indices[0]
    inverse_t, tau, color = inverse_t[:, order], tau[:, order], color[:, order]
    valid = torch.ones_like(tau, dtype=torch.bool)
    composite = composite_weights.reference(tau, valid, torch.zeros_like(tau), tau.new_zeros(1, 1))
    rendered = render_colors(composite, color)
    return composite, rendered, median_inverse_distance(composite.weights, inverse_t, valid) if tau.numel() else None


@pytest.mark.parametrize("num_mpis", [1, 4, 12])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-5), (torch.float64, 1e-10)])
def test_modules_together_render_rays_as_the_oracle_does(num_mpis, dtype, error):
    scene = make_scene(num_mpis, seed=num_mpis)
    rng, met = np.random.default_rng(99), 0
    for _ in range(8):
        target, _ = oracle.ndc_to_world(scene[0].mpis[0], rng.uniform(-1.2, 0.8, size=3))
        origin = rng.normal(size=3)
        direction = unit(target - origin)
        wanted = render_by_oracle(scene, origin, direction)
        composite, color, median = render_by_modules(scene, origin, direction, dtype)
        met += len(wanted.samples) > 0
        assert composite.weights.shape[1] == len(wanted.samples)
        assert np.abs(color[0].double().numpy() - wanted.color).max() < error
        assert abs(composite.transmittance.item() - wanted.transmittance) < error
        if wanted.samples:
            assert np.abs(composite.weights[0].double().numpy() - wanted.weights).max() < error
            assert median.item() == pytest.approx(wanted.median_inverse_distance, rel=1e-5)
    assert met >= 5
