"""Densities and colours at positions, as nerfstudio's other parts ask a field for them (field/mmpi_field.py)."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import IDENTITY, make_mpi, random_mpi
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import CubePlan, ScenePlan

CUBE = CubePlan((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0), (4, 4, 4))


def field_of(*mpis, cube=None, **settings):
    return MMPIField(ScenePlan(mpis, cube, 0.05, 1.0), feature_channels=5, hidden_width=6, **settings).eval()


def filled(field, seed=0):
    """Raw densities around zero, so that no plane is empty; every texel counts as trained."""
    g = torch.Generator().manual_seed(seed)
    for table in (field.density, field.features, field.reliability):
        table.data = torch.randn(table.shape, generator=g)
    field.touched.fill_(1)
    return field


@torch.no_grad()
def test_the_integral_of_density_through_an_mpi_is_the_optical_depth_of_its_planes():
    mpi = make_mpi()
    field = filled(field_of(mpi))
    disparities = np.linspace(1 / mpi.near, 1 / mpi.far, mpi.planes)
    planes = torch.arange(mpi.planes)
    texels = field.grids[0].bilinear(planes, torch.zeros(mpi.planes, 2))
    center = (mpi.extent[0] + mpi.extent[1]) / 2, (mpi.extent[2] + mpi.extent[3]) / 2
    raw = (field.density.data[texels[0], 0] * texels[1]).sum(-1)
    tau = field.layout.optical_depth(0, raw, planes).double().numpy()
    last = mpi.planes - 2  # the last plane may be at infinity
    fine = np.linspace(disparities[0], disparities[last], 40 * last + 1)
    z = torch.from_numpy(1 / fine).float()
    axes, origin = torch.tensor(mpi.axes), torch.tensor(mpi.origin)
    points = origin + z[:, None] * (center[0] * axes[0] + center[1] * axes[1] + axes[2])
    density = field.density_fn(points)[:, 0].double().numpy()
    inside = slice(1, -1)
    integral = torch.trapezoid(*(torch.from_numpy(x[inside]) for x in (density / fine**2, -fine))).item()
    assert math.isclose(integral, tau[: last + 1].sum() - (tau[0] + tau[last]) / 2, rel_tol=2 * 2 / (40 * last) + 1e-3)


@torch.no_grad()
def test_a_voxel_of_the_cube_has_its_optical_depth_over_the_step():
    field = filled(field_of(make_mpi(), cube=CUBE))
    field.density.data.fill_(0.5)
    tau = field.layout.optical_depth(1, torch.tensor([0.5]), torch.tensor([0]))
    behind = torch.tensor([[0.1, 0.2, -3.0]])
    assert torch.allclose(field.density_fn(behind), tau[None] / field.layout.cube.step)
    assert field.density_fn(torch.tensor([[0.0, 0.0, -7.0]])).item() == 0


@torch.no_grad()
def test_heads_add_up_by_their_shares():
    twins = make_mpi("a", (0.0, 0.0, 0.0), IDENTITY), make_mpi("b", (0.0, 0.0, 0.0), IDENTITY)
    point = torch.tensor([[0.1, 0.05, 3.0]])
    alone = [filled(field_of(twins[0])) for _ in range(2)]
    both, plain = (filled(field_of(*twins, learns_reliability=learns)) for learns in (True, False))
    for k, value in enumerate((0.3, -0.4)):
        alone[k].density.data.fill_(value)
        for field in (both, plain):
            field.density.data[field.grids[k].rows] = value
    both.reliability.data[both.grids[0].rows], both.reliability.data[both.grids[1].rows] = 1.0, 0.0
    first, second = (field.density_fn(point) for field in alone)
    share = 1 / (1 + math.exp(-1.0))
    assert torch.allclose(plain.density_fn(point), first + second)
    assert torch.allclose(both.density_fn(point), share * first + (1 - share) * second)
    both.touched[both.grids[0].rows] = 0
    assert torch.allclose(both.density_fn(point), second), "a head that was not trained there does not vote"


def exact(field, point, learns_reliability):
    """Density and mean texel at a point in float64, by the oracle's lookups: one head, one plane after the other."""
    plan, size = field.plan, len(field.plan.mpis)
    heads, taus, values, reliability, covers = range(plan.num_heads), [], [], [], []
    for k in heads:
        grid = field.grids[k]
        block = (grid.depth, grid.height, grid.width, -1)
        raw, features, votes, touched = (
            table.detach()[grid.rows].double().numpy().reshape(block)
            for table in (field.density, field.features, field.reliability, field.touched)
        )
        if k < size:
            mpi, place = plan.mpis[k], oracle.place_in(plan.mpis[k], point, np.zeros(3), 1.0)
            ndc = np.full(3, 2.0) if place is None else place[0]
            at = (ndc[2] + 1) / 2 * (mpi.planes - 1)
            near = int(np.clip(np.floor(at), 0, mpi.planes - 2))
            planes = (
                np.log1p(np.exp(oracle.lookup(raw[p], ndc[:2])[0] + float(field.layout.biases[k][p])))
                for p in (near, near + 1)
            )
            tau_near, tau_far = (256.0 / mpi.planes * x for x in planes)
            depth = oracle.in_frame(mpi, point, point)[0][2]
            step = depth**2 * (1 / mpi.near - 1 / mpi.far) / (mpi.planes - 1)
            density = (tau_near + (at - near) * (tau_far - tau_near)) / step
        else:
            cube = plan.cube
            ndc = 2 * (point - np.array(cube.lower)) / np.subtract(cube.upper, cube.lower) - 1
            side = min(np.subtract(cube.upper, cube.lower) / (np.array(cube.shape[::-1]) - 1))
            density = np.log1p(np.exp(oracle.lookup(raw, ndc)[0] + field.layout.cube_bias)) / side
        nearest = [int(np.clip(round((ndc[i] + 1) / 2 * (block[2 - i] - 1)), 0, block[2 - i] - 1)) for i in (2, 1, 0)]
        inside = bool(np.abs(ndc).max() <= 1)
        taus.append(density)
        values.append(oracle.lookup(features, np.clip(ndc, -1, 1)))
        reliability.append(oracle.lookup(votes, np.clip(ndc, -1, 1))[0])
        covers.append(inside and (not learns_reliability or bool(touched[tuple(nearest)][0])))
    shares = [
        0.0 if not covers[k] else math.exp(oracle.log_shares(reliability, covers, k)[0]) if learns_reliability else 1.0
        for k in heads
    ]
    densities = np.array(shares) * taus
    return densities.sum(), densities @ np.stack(values) / max(densities.sum(), 1e-300)


@torch.no_grad()
@pytest.mark.parametrize("learns_reliability", [True, False])
def test_density_and_texels_at_points_are_those_of_float64(learns_reliability):
    rng = np.random.default_rng(3)
    mpis = [random_mpi(rng, str(k), planes=6, deep=deep) for k, deep in enumerate((math.inf, 4.0, math.inf))]
    settings = {"learns_reliability": learns_reliability, "shading": "sample"}
    field = filled(field_of(*mpis, cube=CUBE, **settings), seed=7)
    field.touched.copy_(torch.from_numpy(rng.random(len(field.touched)) < 0.7))
    points = rng.uniform(-6, 6, (200, 3))
    places = torch.from_numpy(points).float()
    zero = torch.zeros(200, 1)
    density, embedding = field.get_density(RaySamples(frustums=Frustums(places, places, zero, zero, zero)))
    wanted = [exact(field, places[i].double().numpy(), learns_reliability) for i in range(len(points))]
    covered = np.array([d for d, _ in wanted])
    assert (covered > 0).sum() > 80 and (covered == 0).sum() > 5
    np.testing.assert_allclose(density[:, 0].numpy(), covered, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(embedding.numpy(), np.stack([v for _, v in wanted]), rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("shading", ["ray", "sample"])
def test_a_field_answers_nerfstudios_forward(shading):
    field = filled(field_of(make_mpi(), cube=CUBE, shading=shading))
    where = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(1))
    zero = torch.zeros(2, 7, 1)
    samples = RaySamples(frustums=Frustums(where, torch.nn.functional.normalize(where, dim=-1), zero, zero, zero))
    outputs = field(samples)
    density, rgb = outputs[FieldHeadNames.DENSITY], outputs[FieldHeadNames.RGB]
    assert density.shape == (2, 7, 1) and rgb.shape == (2, 7, 3) and (density >= 0).all() and density.max() > 0
    assert ((rgb >= 0) & (rgb <= 1)).all()
    density.sum().backward()
    assert field.density.grad.abs().sum() > 0
