"""A capture in map coordinates, which float32 cannot hold, gives what the same capture gives without the offset."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from forked import run, train
from training_runs import datamanager

OFFSET = np.array([448262.25, 5411932.5, 100.125])


def move_poses(meta):
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += OFFSET
        frame["transform_matrix"] = pose.tolist()


def move(folder, sfm=True):
    """Adds the offset to all poses and to the COLMAP model, or to its applied_transform."""
    from mmpi_priors.sfm import load_pycolmap

    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    move_poses(meta)
    pycolmap = load_pycolmap()
    if sfm:
        model = pycolmap.Reconstruction(str(folder / "colmap/sparse/0"))
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), OFFSET))
        model.write_text(str(folder / "colmap/sparse/0"))
    else:
        meta["applied_transform"] = np.c_[np.eye(3), OFFSET].tolist()
    path.write_text(json.dumps(meta))
    return folder


@pytest.fixture
def far(data):
    return move(data)


def numbers(value):
    """All numbers of a JSON document, in order."""
    if isinstance(value, dict):
        return [x for key in sorted(value) for x in numbers(value[key])]
    if isinstance(value, list):
        return [x for part in value for x in numbers(part)]
    return [float(value)] if isinstance(value, (int, float)) else []


def close(a, b):
    return len(numbers(a)) == len(numbers(b)) > 20 and np.allclose(numbers(a), numbers(b), atol=1e-3)


def test_map_coordinates_give_the_plan_and_the_score_without_the_offset(whole_scene, far, tmp_path):
    plans, scores = [], []
    for name, data in (("near", whole_scene), ("far", far)):
        said = train(data, tmp_path / name, max_num_iterations=30, pipeline__datamanager__dense_depth=True).shown
        assert said.count("map coordinates") == (name == "far") and "does not fit" not in said, said
        run_folder = tmp_path / name / "tiny/mmpi-small/run"
        ended = run("ns-eval", "--load-config", run_folder / "config.yml", "--output-path", tmp_path / f"{name}.json")
        assert ended.status == 0, ended.error
        plans.append(json.loads((run_folder / "plan.json").read_text()))
        scores.append(json.loads((tmp_path / f"{name}.json").read_text())["results"]["psnr"])
        assert run("mmpi-plan", data, "--output", tmp_path / f"plan-{name}").status == 0
        plans.append(json.loads((tmp_path / f"plan-{name}/plan.json").read_text()))
    assert close(plans[0], plans[2]) and close(plans[1], plans[3])
    assert scores[0] == pytest.approx(scores[1], abs=0.05)


@pytest.mark.parametrize("sfm", [True, False])
@pytest.mark.parametrize("options", [{}, {"center_method": "none"}, {"orientation_method": "none"}], ids=str)
def test_cameras_and_points_are_where_they_are_without_the_offset(whole_scene, data, sfm, options):
    seen = []
    for folder in (whole_scene, move(data, sfm)):
        config = datamanager(folder, test_mode="inference").config
        for name, value in options.items():
            setattr(config.dataparser, name, value)
        manager = config.setup(device="cpu", test_mode="inference")
        seen.append((manager.observations, manager.train_dataparser_outputs))
    (near, _), (moved, outputs) = seen
    shift = moved.centers.mean(0) - near.centers.mean(0)  # the origin of center_method none is another
    assert np.allclose(shift, 0, atol=1e-5) or "center_method" in options
    assert np.allclose(near.centers + shift, moved.centers, atol=1e-5)
    assert np.allclose(near.points + shift, moved.points, atol=1e-5) and len(near.points) > 10
    assert np.array_equal(near.seen_by, moved.seen_by) and np.allclose(near.seen_at, moved.seen_at, atol=1e-5)
    # What is saved beside a run takes places of the map to places of the model.
    first = np.array(json.loads((data / "transforms.json").read_text())["frames"][0]["transform_matrix"])[:3, 3]
    first = first if sfm else first - OFFSET
    transform = outputs.dataparser_transform.numpy()
    assert np.allclose(
        (transform[:, :3] @ first + transform[:, 3]) * outputs.dataparser_scale, moved.centers[0], atol=1e-5
    )


def test_the_axes_that_nerfstudio_assumes_without_applied_transform_stay(data, edit):
    edit(lambda meta: meta.pop("applied_transform"))
    found, place = [], np.array([[0.3, 0.2, -4.0]])
    for shift in (np.zeros(3), OFFSET[[1, 0, 2]] * [1, 1, -1]):  # in the model's axes, as the parser takes them to be
        outputs = datamanager(data, test_mode="inference").train_dataparser_outputs
        transform = outputs.dataparser_transform.double().numpy()
        found.append((place + shift) @ transform[:, :3].T + transform[:, 3])
        if not shift.any():
            edit(move_poses)
    assert np.allclose(*found, atol=1e-5)


def test_poses_go_back_to_the_map(far):
    outputs = datamanager(far, test_mode="inference").train_dataparser_outputs
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, "opengl")
    frames = {
        f["file_path"]: f["transform_matrix"] for f in json.loads((far / "transforms.json").read_text())["frames"]
    }
    wanted = np.array([frames[f"images/{name.name}"] for name in outputs.image_filenames])
    assert np.allclose(back, wanted[:, :3], atol=1e-5)


@pytest.mark.parametrize("points", [True, False])
def test_the_colmap_parser_takes_a_local_origin(whole_scene, far, points):
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    seen = []
    for folder in (whole_scene, far):
        config = datamanager(folder, test_mode="inference").config
        config.dataparser = ColmapDataParserConfig(data=folder, downscale_factor=1, load_3D_points=points)
        seen.append(config.setup(device="cpu", test_mode="inference").observations)
    assert np.allclose(seen[0].centers, seen[1].centers, atol=1e-5)
    assert np.allclose(seen[0].points, seen[1].points, atol=1e-5) and len(seen[0].points) > 10


def test_a_point_cloud_beside_the_poses_is_moved_with_them(whole_scene, far, tmp_path):
    from plyfile import PlyData, PlyElement
    from tiny_scene import wall_points

    seen = []
    for folder, offset in ((shutil.copytree(whole_scene, tmp_path / "near"), 0), (far, OFFSET)):
        shutil.rmtree(folder / "colmap")
        points = wall_points() + offset
        rows = np.zeros(len(points), [(k, "f8") for k in "xyz"] + [(k, "u1") for k in ("red", "green", "blue")])
        for k, values in zip("xyz", points.T, strict=True):
            rows[k] = values
        PlyData([PlyElement.describe(rows, "vertex")]).write(folder / "points.ply")
        meta = json.loads((folder / "transforms.json").read_text()) | {"ply_file_path": "points.ply"}
        (folder / "transforms.json").write_text(json.dumps(meta))
        config = datamanager(folder, test_mode="inference").config
        seen.append(config.setup(device="cpu", test_mode="inference").observations.loose)
    assert np.allclose(*seen, atol=1e-5) and len(seen[0]) == len(wall_points())
