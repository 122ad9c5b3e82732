"""mmpi-prepare on a drive down a rendered corridor whose poses are known."""

from __future__ import annotations

import json
from dataclasses import replace

import corridor
import numpy as np
import pycolmap
import pytest
from hand_made import median_reprojection_error
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from mmpi_prepare import features, mapping, pipeline
from mmpi_prepare.adjustment import camera_poses
from mmpi_prepare.pipeline import prepare
from mmpi_prepare.settings import Settings
from mmpi_priors.observe import read_observations
from mmpi_priors.sfm import find_sfm_model

COUNT = 12


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A folder of frames, and masks that hide the lower left corner."""
    folder = tmp_path_factory.mktemp("capture")
    corridor.write_images(folder / "frames", COUNT)
    (folder / "masks").mkdir()
    mask = np.full((corridor.HEIGHT, corridor.WIDTH), 255, np.uint8)
    mask[100:, :60] = 0
    for file in (folder / "frames").iterdir():
        Image.fromarray(mask).save(folder / "masks" / file.name)
    return folder


@pytest.fixture(scope="module")
def scene(capture):
    """What mmpi-prepare makes of the bare frames."""
    settings = Settings(
        capture / "frames", capture / "scene", masks=capture / "masks", camera_height=corridor.EYE, threads=1
    )
    prepare(settings)
    return capture / "scene"


def read_json(scene):
    return json.loads((scene / "transforms.json").read_text())


def test_all_frames_are_registered_within_one_percent_of_the_true_track(scene):
    frames = read_json(scene)["frames"]
    poses = np.array([f["transform_matrix"] for f in frames]) @ np.diag([1.0, -1, -1, 1])
    assert len(frames) == COUNT and corridor.error_of([f["file_path"] for f in frames], poses, COUNT) < 0.01


def test_camera_height_gives_metres_and_gravity(scene):
    poses = np.array([f["transform_matrix"] for f in read_json(scene)["frames"]])
    track = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1).sum()
    truth = np.linalg.norm(np.diff(corridor.poses(COUNT)[:, :3, 3], axis=0), axis=-1).sum()
    assert track == pytest.approx(truth, rel=0.03)
    assert np.degrees(np.arccos(poses[:, 2, 1])).max() < 1.5  # up in the image is up in the scene


def test_nerfstudio_reads_the_scene_and_its_tracks_in_one_frame(scene):
    parser = NerfstudioDataParserConfig(data=scene, downscale_factor=2).setup()
    outputs = parser.get_dataparser_outputs("train")
    observations = read_observations(outputs, outputs.cameras, find_sfm_model(scene / "colmap/sparse/0"))
    assert len(observations.seen_at) > 100 * len(outputs.image_filenames)
    error = median_reprojection_error(observations) * corridor.WIDTH
    assert error < 0.3


def test_split_is_stated_and_covers_all_images(scene):
    content = read_json(scene)
    train, test = set(content["train_filenames"]), set(content["test_filenames"])
    assert not train & test and len(train | test) == COUNT
    assert content["applied_transform"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    assert "one image in 8 tests" in (scene / "report.md").read_text()


def test_masks_are_carried_along_and_keep_features_away(scene):
    frame = read_json(scene)["frames"][0]
    small = np.asarray(Image.open(scene / frame["mask_path"].replace("masks/", "masks_4/")))
    assert small[-1, 0] == 0 and small[0, 0] == 255
    for image in pycolmap.Reconstruction(scene / "colmap/sparse/0").images.values():
        points = np.array([p.xy for p in image.points2D])
        assert not ((points[:, 0] < 59) & (points[:, 1] > 101)).any()


def test_existing_scene_is_refused_and_left_alone(scene, capture):
    from mmpi_ns.utils.errors import InputError

    before = (scene / "transforms.json").read_bytes()
    with pytest.raises(InputError, match="already holds"):
        prepare(Settings(capture / "frames", scene, threads=1))
    assert (scene / "transforms.json").read_bytes() == before


def test_interrupted_run_goes_on_without_redoing_what_was_done(capture, tmp_path, monkeypatch):
    settings = Settings(capture / "frames", tmp_path / "scene", threads=1, keep_work=True)

    def interrupt(*args, **how):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(mapping, "reconstruct", interrupt)
        with pytest.raises(KeyboardInterrupt):
            prepare(settings)
    assert not (tmp_path / "scene/transforms.json").exists()
    with monkeypatch.context() as patched:
        patched.setattr(features, "extract", interrupt)
        patched.setattr(pipeline, "match_pairs", interrupt)
        prepare(settings)
        assert len(read_json(tmp_path / "scene")["frames"]) == COUNT
        with pytest.raises(KeyboardInterrupt):  # other features: what was kept does not fit
            prepare(replace(settings, max_features=500, overwrite=True))


def test_ordered_poses_come_back_in_the_order_of_the_images(scene):
    names, _ = camera_poses(pycolmap.Reconstruction(scene / "colmap/sparse/0"))
    assert names == [f"frame_{i + 1:03d}.png" for i in range(COUNT)]


def test_still_corridor_raises_no_warning_and_a_wrong_focal_length_does(tmp_path):
    corridor.write_images(tmp_path / "frames", 9, bend=0.05)  # straight ahead, any focal length would do
    for factor, summary in ((1.0, "None."), (1.6, "does not fit")):
        scene = tmp_path / f"{factor}"
        prepare(Settings(tmp_path / "frames", scene, focal=factor * corridor.FOCAL, allow_partial=True, threads=1))
        assert summary in (scene / "report.md").read_text()
