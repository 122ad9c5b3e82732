"""Parts of the procedural scenes against slow geometry of their own: hits, tracks, and what the files hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from procedural import keypoint_errors

from mmpi_scene import Scene, make_scene, sfm_points, write_dataset
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


def test_tracks_are_near_enough_and_have_the_colours_that_cameras_see(street):
    scene = replace(street, track_range=14.0)
    found = sfm_points(scene, 300, noise_pixels=0.0, outliers=0.0)
    eyes = scene.cameras.camera_to_worlds[found.camera, :, 3]
    rays = found.true_points[found.point] - eyes
    away = np.linalg.norm(rays, axis=-1, keepdims=True)
    assert len(found.points) > 200 and 12 < away.max() < 14
    first = np.searchsorted(found.point, np.arange(len(found.points)))
    seen = scene.trace(eyes[first], (rays / away)[first], 1 / scene.cameras.focal)[1]
    # Textures are finer or coarser by distance, so single points differ.
    assert np.median(np.abs(found.colors / 255 - seen).max(-1)) < 0.03
    warmth = [c[:, 0] - c[:, 2] for c in (found.colors / 255, seen)]
    assert np.corrcoef(*warmth)[0, 1] > 0.9


def test_files_hold_the_points_their_colours_and_tracks(street, tmp_path):
    found = write_dataset(street, tmp_path / "out", points=120, images=False)
    head, _, body = (tmp_path / "out/sparse_pc.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    assert names == ["x", "y", "z", "red", "green", "blue"]
    table = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    order = np.lexsort(table["xyz"].T), np.lexsort(found.points.astype(np.float32).T)
    assert np.allclose(table["xyz"][order[0]], found.points[order[1]], rtol=1e-6)
    assert np.array_equal(table["rgb"][order[0]], found.colors[order[1]])
    model = pycolmap.Reconstruction(str(tmp_path / "out/colmap/sparse/0"))
    for p in range(120):
        point = model.points3D[p + 1]
        assert np.allclose(point.xyz, found.points[p]) and (point.color == found.colors[p]).all()
        own = found.point == p
        track = [(e.image_id - 1, *model.images[e.image_id].points2D[e.point2D_idx].xy) for e in point.track.elements]
        assert np.allclose(track, np.column_stack([found.camera[own], found.pixel[own]]), atol=1e-4)
        assert point.error == pytest.approx(keypoint_errors(street, found)[own].mean(), abs=1e-4)
