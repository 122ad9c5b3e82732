"""Which images the mappers place, what they fall back on, and on which points their models rest."""

from __future__ import annotations

import copy
from dataclasses import replace

import corridor
import numpy as np
import pycolmap
import pytest

from mmpi_ns.utils.errors import InputError
from mmpi_prepare import adjustment, mapping
from mmpi_prepare.adjustment import camera_poses, with_all_points
from mmpi_prepare.mapping import Task, map_and_judge
from mmpi_prepare.pipeline import WORK, prepare
from mmpi_prepare.settings import Settings

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
    return corridor.error_of(*camera_poses(model), COUNT)


def test_a_candidate_whose_lens_ends_within_its_images_is_judged(task):
    model, summary = mapping.reconstruct(task, task.database)
    sound = mapping.witness_of("incremental", summary, model, task.database, task.offered)
    for camera in model.cameras.values():
        size = (camera.width, camera.height)
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [0.4 * max(size), size[0] / 2, size[1] / 2, -0.6]
        assert np.isnan(camera.cam_from_img(np.array([[1.0, 1.0]]))).all()
    broken = mapping.witness_of("incremental", summary, model, task.database, task.offered)
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
    _, summary, verdict = map_and_judge(task)
    assert summary.startswith("incremental") and verdict.grade in ("right", "doubtful")
    assert "cannot be judged (SVD did not converge)" in " ".join(capsys.readouterr().out.split())


def test_a_long_sequence_is_confirmed_by_a_part_of_it(task, monkeypatch):
    monkeypatch.setattr(mapping, "PLACED", COUNT // 2)
    model, summary, verdict = map_and_judge(task)
    assert verdict.grade == "right" and model.num_reg_images() == COUNT
    assert f"{COUNT // 2} of {COUNT // 2} images" in summary and "global-all" not in summary
    assert error_of(model) < 0.01


def test_all_images_are_placed_at_once_where_the_incremental_mapper_fails(task, monkeypatch):
    def fail(*args):
        raise InputError("no pair can start")

    monkeypatch.setattr(mapping, "PLACED", COUNT // 2)
    monkeypatch.setattr(mapping, "reconstruct", fail)
    model, summary, _ = map_and_judge(task)
    assert model.num_reg_images() == COUNT and summary.startswith("global-all")
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
    model, summary, _ = map_and_judge(task)
    assert summary.startswith("incremental") and "global" not in summary
    assert starts == [task.database] and error_of(model) < 0.01


def test_a_placed_model_is_given_the_points_of_all_matches_and_adjusted(task):
    exact = pycolmap.Reconstruction(task.database.parents[1] / "model/model")
    before = exact.num_points3D()
    moved = copy.deepcopy(exact)
    for number in list(moved.points3D)[::2]:
        moved.delete_point3D(number)
    for camera in moved.cameras.values():
        camera.params = camera.params * [1.02, 1, 1, 1]
    actual = with_all_points(moved, task.database, task.images, True, 1, rounds=2)
    assert actual.num_points3D() > 0.9 * before and actual.num_reg_images() == COUNT
    (camera,), (given,) = actual.cameras.values(), exact.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(given.mean_focal_length(), rel=0.01)
    assert max(p.error for p in actual.points3D.values()) <= adjustment.LARGEST_ERROR
    assert error_of(actual) < 0.01


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
