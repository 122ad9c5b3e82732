"""Procedural scenes: exact geometry, honest tracks, and data sets that Nerfstudio and the data manager read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_made import median_reprojection_error
from PIL import Image

from mmpi_priors.sfm import find_sfm_model
from mmpi_scene import SCENES, Cameras, Scene, make_scene, render, write_dataset
from mmpi_scene.primitives import BOX, SPHERE, Kit, look
from mmpi_scene.scene import Light
from mmpi_scene.surroundings import meadow, open_sky

SMALL = {"count": 6, "width": 64, "height": 32}
EAST = np.zeros(1)


def hand_made(kit: Kit, **changes) -> Scene:
    """A camera at (0, 0, 1.5) that looks along +x, and the solids of a kit."""
    poses = look(np.array([[0.0, 0.0, 1.5]]), EAST, EAST)
    parts = {"ground": meadow, "sky": open_sky, "light": Light((-0.5, -0.3, 0.8))}
    scene = Scene("hand-made", 0, kit.done(), cameras=Cameras(poses, 40.0, 64, 48, 2), **parts)
    return replace(scene, **changes)


def wall() -> Scene:
    kit = Kit(0, 0)
    kit.box((5.5, 0.0, 1.5), (1.0, 3.0, 2.0), "bricks", (0.8, 0.4, 0.3), (0.7, 0.3, 0.2), (0.9, 0.9, 0.9))
    return hand_made(kit)


def directions_to(*targets, origin=(0.0, 0.0, 1.5)):
    d = np.array(targets) - origin
    return np.broadcast_to(np.array(origin), d.shape), d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def street():
    return make_scene("street", count=8, width=96, height=48, length=12.0)


@pytest.fixture(scope="module")
def dataset(street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("street") / "out"
    write_dataset(street, folder, points=300)
    return folder


# Geometry


def test_distance_to_a_wall_the_ground_and_the_sky_is_exact():
    origins, directions = directions_to((5.0, 0.4, 1.9), (3.0, 1.0, 0.0), (5.0, 1.6, 1.6), (5.0, 0.0, 9.0))
    distance, row = wall().hit(origins, directions)
    assert np.allclose(distance[:2], [np.linalg.norm([5, 0.4, 0.4]), np.linalg.norm([3, 1, 1.5])], rtol=1e-14)
    assert row.tolist() == [0, -1, -1, -1] and np.isinf(distance[2:]).all()


def test_distance_to_turned_boxes_spheres_and_cylinders_is_exact():
    kit = Kit(0, 0)
    kit.box((6.0, 0.0, 1.5), (2.0, 2.0, 1.0), "plaster", (0.5,) * 3, yaw=np.pi / 4)
    kit.sphere((0.0, 7.0, 1.5), 2.0, "plaster", (0.5,) * 3)
    kit.cylinder((-4.0, 0.0, 0.0), 0.5, 3.0, "plaster", (0.5,) * 3)
    scene = hand_made(kit)
    origins, directions = directions_to((1.0, 0, 1.5), (0, 1.0, 1.5), (-1.0, 0, 1.5))
    assert np.allclose(scene.hit(origins, directions)[0], [6 - np.sqrt(2), 5.0, 3.5], rtol=1e-14)
    above, down = directions_to((-4.2, 0.1, 0.0), origin=(-4.2, 0.1, 10.0))
    assert np.allclose(scene.hit(above, down)[0], 7.0, rtol=1e-14)


@pytest.mark.parametrize("name", SCENES)
def test_depth_of_one_camera_is_seen_by_the_others(name):
    """Points at one image's depth lie at the same place in another image, or behind something nearer."""
    scene = make_scene(name, count=6, width=48, height=32, **({"length": 8.0} if SCENES[name].length else {}))
    cameras = scene.cameras
    pixels = np.stack(np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5), -1).reshape(-1, 2)
    shared = 0
    for i in range(1, 6):
        origins, directions = cameras.rays(0, pixels)
        t = scene.trace(origins, directions)[0]
        points = (origins + t[:, None] * directions)[t < 100]
        at, depth = cameras.project(i, points)
        inside = (depth > 0) & ((at > 0) & (at < [48, 32])).all(-1)
        away = np.linalg.norm(points[inside] - cameras.camera_to_worlds[i, :, 3], axis=-1)
        seen = scene.trace(*cameras.rays(i, at[inside]))[0]
        assert (seen <= away * (1 + 1e-9) + 1e-9).all()
        shared += (np.abs(seen - away) < 1e-6 * away).sum()
    assert shared > 50


def test_a_point_to_the_right_is_seen_on_the_right_and_one_above_above():
    cameras = wall().cameras
    at, depth = cameras.project(0, np.array([[5.0, -1.0, 1.5], [5.0, 0.0, 2.5], [-5.0, 0.0, 1.5]]))
    assert at[0, 0] > 32 and np.isclose(at[0, 1], 24) and at[1, 1] < 24 and np.allclose(depth, [5, 5, -5])
    directions = cameras.rays(0, at[:2])[1]
    assert np.allclose(np.cross(directions, np.array([[5.0, -1, 0], [5, 0, 1]])), 0, atol=1e-12)
    for name in SCENES:
        rotation = make_scene(name, **SMALL).cameras.camera_to_worlds[:, :, :3]
        assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
        assert np.allclose(np.linalg.det(rotation), 1) and (rotation[:, 2, 1] > 0.5).all()


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


# Images


def test_equal_seeds_give_equal_bytes_and_others_do_not(tmp_path):
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        write_dataset(make_scene("room", seed=seed, count=3, width=32, height=24), tmp_path / folder, points=60)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert sum(p.parts[0] != "colmap" for p in files) == 3 + 3 + 2 and len(files) >= 3 + 3 + 2 + 3
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    assert all(
        (tmp_path / "a" / f).read_bytes() != (tmp_path / "c" / f).read_bytes() for f in files if f.suffix == ".png"
    )


# Points and tracks


def test_what_stands_in_front_hides_a_point():
    """The camera on the left sees a point of the far wall that a post hides from the one in the middle."""
    kit = Kit(0, 0)
    grey = ((0.5,) * 3,)
    kit.box((10.0, 0, 2.0), (1.0, 12.0, 4.0), "plaster", *grey)
    places = np.array([[0.0, y, 1.5] for y in (-2.0, -1.0, 0.0, 1.0, 2.0)])
    poses = look(places, np.zeros(5), np.zeros(5))
    open_view = hand_made(kit, cameras=Cameras(poses, 40.0, 64, 48, 2))
    kit.box((5.0, 0, 1.5), (0.2, 0.3, 3.0), "plaster", *grey)
    hidden = replace(open_view, primitives=kit.done())
    from mmpi_scene.sfm_like import visible

    point = np.array([[9.5, 0.0, 1.5], [9.5, 3.0, 1.5]])
    assert [visible(open_view, i, point)[0].tolist() for i in range(5)] == [[True, True]] * 5
    assert [visible(hidden, i, point)[0][0] for i in range(5)] == [True, True, False, True, True]


# Data sets


def test_nerfstudio_and_the_data_manager_read_what_was_written(dataset, street):
    from nerfstudio.data.datasets.base_dataset import InputDataset
    from training_runs import datamanager

    from mmpi_priors.observe import read_observations

    manager = datamanager(dataset)
    outputs = manager.train_dataparser_outputs
    sfm = find_sfm_model(dataset / "colmap" / "sparse" / "0")
    assert sfm is not None and len(sfm.points) > 250
    observations = read_observations(outputs, outputs.cameras, sfm)
    assert len(observations.seen_by) > 800
    assert median_reprojection_error(observations) * 96 < 0.6
    kept = np.flatnonzero(~street.cameras.is_test)
    transform = outputs.dataparser_transform.double().numpy()
    centers = street.cameras.camera_to_worlds[kept, :, 3] @ transform[:, :3].T + transform[:, 3]
    assert np.allclose(observations.centers, centers * outputs.dataparser_scale, atol=1e-5)
    image = InputDataset(outputs)[1]["image"].numpy()
    assert np.abs(image - render(street, kept[1])[0]).max() < 0.5 / 255 + 1e-5


def test_depth_files_hold_millimetres_along_the_optical_axis(dataset, street):
    meta = json.loads((dataset / "transforms.json").read_text())
    stored = np.asarray(Image.open(dataset / meta["frames"][4]["depth_file_path"])).astype(float) / 1000
    distance = render(street, 4)[1]
    x, y = (np.stack(np.meshgrid(np.arange(96) + 0.5, np.arange(48) + 0.5)) - np.array([48, 24])[:, None, None]) / (
        street.cameras.focal
    )
    depth = distance / np.sqrt(1 + x**2 + y**2)
    near = depth < 65
    assert np.abs(stored[near] - depth[near]).max() < 0.00051 and (stored[depth > 66] == 0).all() and near.mean() > 0.5


def test_colmap_model_has_the_cameras_and_the_errors_it_states(dataset, street):
    import pycolmap

    model = pycolmap.Reconstruction(str(dataset / "colmap" / "sparse" / "0"))
    assert len(model.images) == 8 and len(model.points3D) == 300
    for image in model.images.values():
        i = int(Path(image.name).stem[-5:]) - 1
        assert np.allclose(image.projection_center(), street.cameras.camera_to_worlds[i, :, 3], atol=1e-9)
        for point in image.points2D[:20]:
            p = model.points3D[point.point3D_id]
            assert np.linalg.norm(street.cameras.project(i, p.xyz[None])[0][0] - point.xy) < 2.5
            assert np.linalg.norm(image.project_point(p.xyz) - point.xy) < 2.5
    assert 0.1 < np.mean([p.error for p in model.points3D.values()]) < 0.5


def test_impossible_scenes_are_refused_with_the_remedy():
    for bad, words in (
        ({"name": "moon"}, "choose one of"), ({"name": "room", "length": 5.0}, "leave it out"),
        ({"name": "street", "count": 0}, "count"), ({"name": "street", "length": -1.0}, "length"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            make_scene(**bad)


def test_a_folder_in_use_is_left_as_it_is(tmp_path, monkeypatch, capsys):
    from mmpi_scene import __main__ as script

    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    for extra in ([], ["--overwrite"]):
        monkeypatch.setattr("sys.argv", ["mmpi-scene", "room", str(folder), *extra])
        with pytest.raises(SystemExit) as stop:
            script.entrypoint()
        message = capsys.readouterr().err.strip()
        assert (
            stop.value.code == 1
            and message.startswith("mmpi-scene: ")
            and str(folder) in message
            and "\n" not in message
        )
        assert [p.name for p in folder.iterdir()] == ["notes.txt"]
