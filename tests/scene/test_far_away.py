"""Ten kilometres from the origin: a ray is moved into an MPI's frame by differences, so nothing is lost on the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_made import random_mpi, unit

from mmpi_ns.placement.rule import PlacementConfig
from mmpi_ns.placement.split import place_windows
from mmpi_ns.scene.geometry import Frames, plane_hits, sample_disparity

KILOMETRES = ((0.0, 0.0, 0.0), (6123.4, -77.7, 7901.3), (-9999.9, 12.3, 0.1))


def rounded(x) -> np.ndarray:
    """What float32 can hold: cameras and plans arrive so."""
    return np.asarray(x, dtype=np.float32).astype(np.float64)


def worst_error(place, dtype):
    """Largest error of (u, v), in tangents, of the live samples of rays that start within 20 m of an MPI's origin."""
    rng = np.random.default_rng(5)
    worst = 0.0
    for _ in range(20):
        mpi = replace(random_mpi(rng), near=3.0, far=float("inf"), planes=64, origin=tuple(rounded(place).tolist()))
        axes = np.asarray(mpi.axes)
        forward = unit(np.stack([*rng.uniform(-0.4, 0.4, (2, 200)), np.ones(200)], -1)) @ axes
        origins = rounded(np.asarray(place) + rng.uniform(-20, 20, (200, 3)))
        directions = rounded(forward)
        found = []
        for kind in (torch.float64, dtype):
            frames = Frames.pack([mpi], dtype=kind)
            o, d = (torch.from_numpy(x).to(kind) for x in (origins, directions))
            near, far = torch.full((200, 1), 0.5, dtype=kind), torch.full((200, 1), torch.inf, dtype=kind)
            hits = plane_hits(o, d, near, far, frames)
            found.append((hits, frames))
        (exact, frames), (hits, _) = found
        m = torch.arange(64)
        w = sample_disparity(m, frames.disparity_steps[0], frames.last_disparities[0])
        for name in ("u", "v"):
            a, b = (getattr(h, name)[:, 0].double() for h in (exact, hits))
            live = (m <= exact.m_first[:, :1]) & (m > exact.m_first[:, :1] - exact.count[:, :1])
            error = ((a[:, :1] + w * a[:, 1:]) - (b[:, :1] + w * b[:, 1:])).abs()
            worst = max(worst, float(error[live].max()) if live.any() else 0.0)
    return worst


@pytest.mark.parametrize("place", KILOMETRES[1:])
def test_float32_errs_no_more_ten_kilometres_away_than_at_the_origin(place):
    here, there = worst_error(KILOMETRES[0], torch.float32), worst_error(place, torch.float32)
    assert 0 < here < 1e-5
    assert there <= 1.5 * here


def test_the_comparison_would_see_an_error():
    assert worst_error(KILOMETRES[0], torch.bfloat16) > 1e-3


def test_mpis_a_ray_can_meet_do_not_grow_with_the_road():
    """All of a ray's MPIs are those of its windows; twice the road has twice the windows."""
    from long_road import road

    config = PlacementConfig(max_texels=2e6, max_planes=32)
    short, long = (place_windows(road(length, 4.0), config) for length in (220, 440))
    most, total = ([f(len(p.mpis) for p in plan.plans) for plan in (short, long)] for f in (max, sum))
    assert len(long) >= 1.6 * len(short) >= 4
    assert 1.6 * total[0] <= total[1] <= 2.5 * total[0]
    assert most[1] <= 1.25 * most[0] + 1
