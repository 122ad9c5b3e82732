"""Parts of the procedural scenes against slow geometry of their own: hits, tracks, and what the files hold."""

from __future__ import annotations

import numpy as np
import pytest

from mmpi_scene import Scene, make_scene
from mmpi_scene.primitives import BOX, SPHERE


@pytest.fixture(scope="module")
def street() -> Scene:
    return make_scene("street", count=8, width=96, height=48, length=12.0)


def slow_entries(solids, i, origins, directions):
    """Distances [R] at which rays enter solid i: slabs and quadratic equations in the solid's own axes."""
    c, s = np.cos(solids.yaw[i]), np.sin(solids.yaw[i])
    axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # rows are the solid's axes
    o, d = (origins - solids.center[i]) @ axes.T, directions @ axes.T
    half = solids.half[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = np.sort(np.stack([(-half - o) / d, (half - o) / d]), axis=0)
        if solids.kind[i] == BOX:
            enter, leave = slabs[0].max(-1), slabs[1].min(-1)
        else:
            flat = slice(0, 3) if solids.kind[i] == SPHERE else slice(0, 2)
            a, b = (d[:, flat] ** 2).sum(-1), (o[:, flat] * d[:, flat]).sum(-1)
            root = np.sqrt(b * b - a * ((o[:, flat] ** 2).sum(-1) - half[0] ** 2))  # nan where it misses
            enter, leave = (-b - root) / a, (-b + root) / a
            if solids.kind[i] != SPHERE:
                enter, leave = np.maximum(enter, slabs[0, :, 2]), np.minimum(leave, slabs[1, :, 2])
        return np.where((enter <= leave) & (enter > 1e-6), enter, np.inf)


@pytest.mark.parametrize("name", ["street", "object", "room"])
def test_first_hits_are_those_of_a_slow_search_through_every_solid(name):
    scene = make_scene(name, count=8, width=96, height=48)
    solids, random = scene.primitives, np.random.default_rng(1)
    eyes = scene.cameras.camera_to_worlds[:, :, 3]
    origins = random.uniform(eyes.min(0) - 1, eyes.max(0) + 1, (600, 3))
    aims = solids.center[random.integers(len(solids), size=600)] + random.normal(size=(600, 3)) * 0.7
    directions = (aims - origins) / np.linalg.norm(aims - origins, axis=-1, keepdims=True)
    every = np.stack([slow_entries(solids, i, origins, directions) for i in range(len(solids))])
    every[every >= scene.reach] = np.inf
    wanted = every.min(0)
    distance, row = scene.tracer(origins, directions)
    assert np.isfinite(wanted).sum() > 300
    assert np.array_equal(np.isfinite(distance), np.isfinite(wanted))
    hit = np.isfinite(wanted)
    assert np.allclose(distance[hit], wanted[hit], rtol=1e-9)
    assert np.allclose(every[row[hit], np.flatnonzero(hit)], wanted[hit], rtol=1e-9) and (row[~hit] == -1).all()
