"""Which images the mappers place, what they fall back on, and on which points their models rest."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import corridor
import numpy as np
import pycolmap
import pytest
from PIL import Image

from mmpi_ns.utils.errors import InputError
from mmpi_prepare import adjustment, features, mapping
from mmpi_prepare.adjustment import camera_poses, similarity_between, with_all_points, with_fewer_points
from mmpi_prepare.images import Photo
from mmpi_prepare.mapping import Task, map_and_judge
from mmpi_prepare.pipeline import WORK, prepare
from mmpi_prepare.settings import Settings
from mmpi_priors.sfm import count_features

COUNT = 12


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """The work folder of a finished run on frames of a corridor."""
    folder = tmp_path_factory.mktemp("matched")
    corridor.write_images(folder / "frames", COUNT)
    prepare(Settings(folder / "frames", folder / "scene", threads=1, keep_work=True))
    return folder / "scene" / WORK


@pytest.fixture
def task(matched, tmp_path):
    names = sorted(p.name for p in (matched / "input/images").iterdir())
    free = True, False, False
    return Task(matched / "matches/database.db", matched / "input/images", tmp_path, names, *free, 1, True, True)


def error_of(model):
    """Largest distance of the centres from the true ones, as a share of the track."""
    names, poses = camera_poses(model)
    given = corridor.poses(COUNT)[[int(Path(n).stem[-3:]) - 1 for n in names]]
    moved = similarity_between(poses, given)
    off = [np.linalg.norm(moved * p - q) for p, q in zip(poses[:, :3, 3], given[:, :3, 3], strict=True)]
    return max(off) / np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=-1).sum()


@pytest.mark.parametrize(("count", "step"), [(64, 1), (199, 1), (200, 2), (300, 3), (1000, 10)])
def test_of_a_long_sequence_a_hundred_images_are_placed_first(task, count, step):
    names = [f"{i:04d}.jpg" for i in range(count)]
    assert replace(task, offered=names).placed == names[::step]
    assert replace(task, offered=names, is_ordered=False).placed == names


def test_a_candidate_whose_lens_ends_within_its_images_is_judged(task):
    model, says = mapping.reconstruct(task, task.database)
    sound = mapping.witness_of("incremental", says, model, task.database, task.offered)
    for camera in model.cameras.values():
        size = (camera.width, camera.height)
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [0.4 * max(size), size[0] / 2, size[1] / 2, -0.6]
        assert np.isnan(camera.cam_from_img(np.array([[1.0, 1.0]]))).all()
    broken = mapping.witness_of("incremental", says, model, task.database, task.offered)
    assert np.array_equal(broken.pairs.matches, sound.pairs.matches)
    assert broken.pairs.fitting.sum() < 0.5 * sound.pairs.fitting.sum()
    assert not np.isinf(broken.scales).any() and not broken.only_turns


def test_a_candidate_that_cannot_be_judged_is_left_out_with_its_reason(task, monkeypatch, capsys):
    def witness_of(name, *rest):
        if name == "global":
            raise np.linalg.LinAlgError("SVD did not converge")
        return judged(name, *rest)

    judged = mapping.witness_of
    monkeypatch.setattr(mapping, "witness_of", witness_of)
    _, says, verdict = map_and_judge(task)
    assert says.startswith("incremental") and verdict.grade in ("right", "doubtful")
    assert "cannot be judged (SVD did not converge)" in " ".join(capsys.readouterr().out.split())


def test_a_long_sequence_is_confirmed_by_a_part_of_it(task, monkeypatch):
    monkeypatch.setattr(mapping, "PLACED", COUNT // 2)
    model, says, verdict = map_and_judge(task)
    assert verdict.grade == "right" and model.num_reg_images() == COUNT
    assert f"{COUNT // 2} of {COUNT // 2} images" in says and "global-all" not in says
    assert error_of(model) < 0.01


def test_all_images_are_placed_at_once_where_the_incremental_mapper_fails(task, monkeypatch):
    def fail(*args):
        raise InputError("no pair can start")

    monkeypatch.setattr(mapping, "PLACED", COUNT // 2)
    monkeypatch.setattr(mapping, "reconstruct", fail)
    model, says, _ = map_and_judge(task)
    assert model.num_reg_images() == COUNT and says.startswith("global-all")
    assert error_of(model) < 0.01
    monkeypatch.setattr(mapping, "map_globally", lambda *args: None)
    (task.work / "none").mkdir()
    with pytest.raises(InputError, match="no pair can start"):
        map_and_judge(replace(task, work=task.work / "none"))


def test_a_global_model_without_points_neither_counts_nor_gives_its_focal_length(task, monkeypatch):
    place, build, starts = mapping.map_globally, mapping.reconstruct, []

    def without_points(*args):
        model = place(*args)
        for number in list(model.points3D):
            model.delete_point3D(number)
        return model

    def watch(task, start, attempts):
        starts.append(start)
        return build(task, start, attempts)

    monkeypatch.setattr(mapping, "map_globally", without_points)
    monkeypatch.setattr(mapping, "reconstruct", watch)
    model, says, _ = map_and_judge(task)
    assert says.startswith("incremental") and "global" not in says
    assert starts == [task.database] and error_of(model) < 0.01


def test_a_placed_model_is_given_the_points_of_all_matches_and_adjusted(task):
    exact = pycolmap.Reconstruction(task.database.parents[1] / "model/model")
    before = exact.num_points3D()
    moved = copy.deepcopy(exact)
    for number in list(moved.points3D)[::2]:
        moved.delete_point3D(number)
    for camera in moved.cameras.values():
        camera.params = camera.params * [1.02, 1, 1, 1]
    found = with_all_points(moved, task.database, task.images, True, 1, rounds=2)
    assert found.num_points3D() > 0.9 * before and found.num_reg_images() == COUNT
    (camera,), (given,) = found.cameras.values(), exact.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(given.mean_focal_length(), rel=0.01)
    assert max(p.error for p in found.points3D.values()) <= adjustment.LARGEST_ERROR
    assert error_of(found) < 0.01


def test_fewer_points_are_those_that_most_images_see_and_every_image_keeps_enough(task, monkeypatch):
    monkeypatch.setattr(adjustment, "ENOUGH_POINTS", 40)
    model = pycolmap.Reconstruction(task.database.parents[1] / "model/model")
    before = model.num_points3D()
    light = with_fewer_points(model)
    assert model.num_points3D() == before > 2 * light.num_points3D()
    for number, image in light.images.items():
        assert image.num_points3D >= min(40, model.images[number].num_points3D)
    lengths = {i: p.track.length() for i, p in model.points3D.items()}
    for number in set(model.points3D) - set(light.points3D):  # each image that sees it has enough as long ones
        for seen in model.points3D[number].track.elements:
            kept = [p.point3D_id for p in light.images[seen.image_id].points2D if p.has_point3D()]
            assert sum(lengths[i] >= lengths[number] for i in kept) >= 40


@pytest.mark.parametrize("is_poor", [True, False])
def test_weak_features_count_where_images_have_few(tmp_path, monkeypatch, is_poor):
    """Large images of noise have enough; ones of faint blobs do not."""
    random, size = np.random.default_rng(0), (480, 640)
    (tmp_path / "images").mkdir()
    for i in range(3):
        coarse = random.normal(128, 4 if is_poor else 60, (24, 32) if is_poor else (160, 213))
        image = Image.fromarray(coarse.clip(0, 255).astype(np.uint8)).resize(size[::-1], Image.Resampling.BICUBIC)
        image.convert("RGB").save(tmp_path / f"images/{i}.png")
    asked: list[tuple[int, float]] = []
    real = pycolmap.extract_features

    def watch(*args, image_names, extraction_options, **rest):
        assert extraction_options.max_image_size == features.LARGEST_SIDE
        asked.append((len(image_names), extraction_options.sift.peak_threshold))
        return real(*args, image_names=image_names, extraction_options=extraction_options, **rest)

    monkeypatch.setattr(pycolmap, "extract_features", watch)
    photos = [Photo(f"{i}.png", 640, 480) for i in range(3)]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[600, 320, 240, 0], camera_id=1)
    features.extract(tmp_path / "images", photos, ([1] * 3, [camera]), None, 8192, 1, tmp_path)
    usual = pycolmap.FeatureExtractionOptions().sift.peak_threshold
    assert asked[-1] == (3, pytest.approx(features.FAINT if is_poor else usual))
    assert min(count_features(tmp_path / "database.db")) > 50 and not (tmp_path / "sample.db").exists()


def test_the_adjusted_model_is_kept_and_judged_unless_its_evidence_is_worse(task, monkeypatch):
    made: list[pycolmap.Reconstruction] = []

    def watch(*args):
        made.append(adjustment.polish(*args))
        return made[-1]

    monkeypatch.setattr(mapping, "polish", watch)
    assert map_and_judge(task)[0] is made[-1]

    def spoil(model, *rest):
        spoilt = watch(model, *rest)
        for number in list(spoilt.points3D):
            spoilt.delete_point3D(number)
        return spoilt

    monkeypatch.setattr(mapping, "polish", spoil)
    model, _, verdict = map_and_judge(task)
    assert model is not made[-1] and verdict.grade == "right"
