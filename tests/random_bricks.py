"""Baked windows with random bricks, and rays that are hard to march through them."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from hand_made import random_mpi
from random_fields import random_rays

from mmpi_ns.scene.bricks import columns_from
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.windows import Window
from mmpi_show.files import BakedScene, Pose
from mmpi_show.reader import neighbours, take_borders
from mmpi_show.scene import BakedMpis, Codes, Shader, tiles_of
from mmpi_show.windows import BakedWindow


def random_window(num_mpis=2, seed=0, planes=40, channels=5, stored=0.5, density=(0, 255), shares=(0.6, 1.0)):
    """A window of 2 x 3 tiles a plane, the share ``stored`` of them occupied, with codes drawn from ``density``."""
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    mpis = tuple(replace(random_mpi(rng, f"mpi{k}", planes=planes), height=12, width=19) for k in range(num_mpis))
    columns, count = [], 0
    for mpi in mpis:
        _, down, across = tiles_of(mpi)
        actual, places = columns_from(torch.rand(mpi.planes, down, across, generator=g) < stored, count)
        columns.append(actual)
        count += len(places)
    codes = torch.randint(density[0], density[1] + 1, (count, 8, 8), generator=g, dtype=torch.uint8)
    texels = torch.randint(0, 256, (count, 8, 8, channels), generator=g, dtype=torch.uint8)
    beside = neighbours(torch.cat(columns).numpy(), list(map(vars, mpis)))
    for table in (codes, texels):
        take_borders(table.numpy(), beside)
    intervals = tuple(rng.uniform(*shares) for _ in mpis)
    ranges = (*[Codes.spanning(-4, 4)] * 3, *[Codes.spanning(-1.5, 1.1)] * (channels - 3))
    baked = BakedMpis(mpis, intervals, torch.cat(columns), codes, texels, Codes.spanning(-12, 4), ranges)
    sizes = (channels + 15, 6, 6, 3)
    layers = tuple((torch.randn(o, i, generator=g) / i**0.5, torch.randn(o, generator=g)) for i, o in pairwise(sizes))
    return BakedWindow(baked, Shader(layers, 2, 8.0), 0.05, 3e-3, 0.5, 100.0)


def rays_into(window, count=64, seed=1):
    """Rays from all round, among them rays along planes, on a plane and away from every MPI."""
    plan = ScenePlan(window.mpis.mpis, None, 0.05, 1.0)
    origins, directions = random_rays(plan, count, seed)
    for i, mpi in enumerate(plan.mpis):
        x, _, z = (np.array(row) for row in mpi.axes)
        directions[5 * i], directions[5 * i + 1] = x, -z
        origins[5 * i + 2], directions[5 * i + 2] = np.array(mpi.origin) + mpi.near * z, z  # begins on the near plane
        origins[5 * i + 3], directions[5 * i + 3] = mpi.origin, z  # sees every plane at the same place
    o, d = (torch.tensor(x, dtype=torch.float32) for x in (origins, directions))
    return o, d, torch.full((count, 1), window.ray_near), torch.full((count, 1), math.inf)


def scene_of(*windows, radius=1.0):
    """A scene of these windows, side by side, with two cameras in its path."""
    places = [
        Window(
            (4.0 * i, 0.0, 0.0), math.inf if len(windows) == 1 else radius, 1.0, ScenePlan(w.mpis.mpis, None, 0.05, 1.0)
        )
        for i, w in enumerate(windows)
    ]
    mpi = windows[0].mpis.mpis[0]
    right, down, facing = (np.array(row) for row in mpi.axes)
    path = []
    for i in range(2):
        eye = np.array(mpi.origin) + (0.1 + 0.2 * i) * facing
        to_world = np.stack([right, -down, -facing, eye], -1).tolist()
        path.append(Pose(to_world, (48, 32), (40.0, 40.0), (24.0, 16.0), test=i == 1))
    return BakedScene("random", (0.0, 0.0, 1.0), path, list(zip(places, windows, strict=True)))
