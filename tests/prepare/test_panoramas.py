"""mmpi-prepare on panoramas of a 360-degree camera: a few steps down a procedural street, from exact poses."""

from __future__ import annotations

import json
from dataclasses import replace

import corridor
import numpy as np
import pytest
from PIL import Image

from mmpi_ns.utils.errors import InputError
from mmpi_prepare.adjustment import degrees_between, similarity_between
from mmpi_prepare.images import gather
from mmpi_prepare.panoramas import FACES, cut, wraps
from mmpi_prepare.pipeline import prepare
from mmpi_prepare.settings import Settings
from mmpi_scene.cameras import Cameras, Panoramas
from mmpi_scene.catalogue import make_scene
from mmpi_scene.scene import render

COUNT, WIDTH, SIDE = 6, 640, 160
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def street():
    scene = make_scene("walk", count=COUNT, width=WIDTH, length=2.5)
    return replace(scene, cameras=Panoramas.of(scene.cameras))


@pytest.fixture(scope="module")
def frames(street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("panoramas") / "frames"
    folder.mkdir()
    for i in range(COUNT):
        image = Image.fromarray((255 * render(street, i, supersample=1)[0]).round().astype(np.uint8))
        image.save(folder / f"pano_{i}.png")
    return folder


@pytest.fixture(scope="module")
def scene(frames):
    folder = frames.parent / "scene"
    assert prepare(Settings(frames, folder, moving="keep", test_every=3, threads=1)).grade == "right"
    return folder


def read_poses(scene):
    """Camera to world with OpenCV axes, by face and panorama."""
    meta = json.loads((scene / "transforms.json").read_text())
    poses = {f["file_path"]: np.array(f["transform_matrix"]) @ FLIP for f in meta["frames"]}
    return meta, {face: np.array([poses[f"images/{face}-pano_{i}.png"] for i in range(COUNT)]) for face in FACES}


def test_panoramas_are_placed_where_they_were_taken(scene, street):
    given = np.tile(np.eye(4), (COUNT, 1, 1))
    given[:, :3] = street.cameras.camera_to_worlds
    given = given @ FLIP
    placed = read_poses(scene)[1]["front"]
    similarity = similarity_between(placed, given)
    moved = np.array([similarity * center for center in placed[:, :3, 3]])
    assert degrees_between(similarity.rotation.matrix() @ placed[:, :3, :3], given[:, :3, :3]).max() < 0.1
    steps, true_steps = np.diff(moved, axis=0), np.diff(given[:, :3, 3], axis=0)
    lengths, true_lengths = (np.linalg.norm(s, axis=-1) for s in (steps, true_steps))
    cosines = (steps * true_steps).sum(-1) / lengths / true_lengths
    assert np.degrees(np.arccos(cosines.min())) < 1.0
    assert np.abs(lengths / true_lengths - 1).max() < 0.02


def test_faces_of_a_panorama_are_one_rig(scene):
    meta, poses = read_poses(scene)
    assert (meta["w"], meta["h"], meta["fl_x"], meta["cx"]) == (SIDE, SIDE, SIDE / 2, SIDE / 2)
    for face, axes in FACES.items():
        assert np.abs(poses[face][:, :3, 3] - poses["front"][:, :3, 3]).max() < 1e-9
        assert np.abs(poses[face][:, :3, :3] - poses["front"][:, :3, :3] @ np.array(axes).T).max() < 1e-9


@pytest.mark.parametrize("face", ["left", "up"])
def test_a_face_is_what_a_perspective_camera_sees(face, scene, street):
    pose = street.cameras.camera_to_worlds[2]
    axes = np.diag([1, -1, -1]) @ np.array(FACES[face]).T @ np.diag([1, -1, -1])  # of OpenGL
    turned = np.concatenate([pose[:, :3] @ axes, pose[:, 3:]], -1)
    pinhole = Cameras(turned[None], SIDE / 2, SIDE, SIDE, test_every=2)
    expected = render(replace(street, cameras=pinhole), 0, supersample=1)[0]
    seen = np.asarray(Image.open(scene / "images" / f"{face}-pano_2.png")) / 255
    assert np.abs(seen - expected).mean() < 0.02
    assert np.abs(seen[:, ::-1] - expected).mean() > 0.03


def test_a_panorama_trains_or_tests_with_all_its_faces(scene):
    meta, _ = read_poses(scene)
    test = {f"images/{face}-pano_{i}.png" for face in FACES for i in (1, 4)}
    assert set(meta["test_filenames"]) == test
    assert not test & set(meta["train_filenames"])
    assert len(meta["train_filenames"]) == len(FACES) * (COUNT - 2)


def test_images_that_do_not_go_round_are_no_panoramas(frames, tmp_path):
    pixels = np.asarray(Image.open(frames / "pano_3.png"))
    assert wraps(pixels) and wraps(np.roll(pixels, 100, 1)) and wraps(pixels[..., 0])
    assert not any(wraps(pixels[:, a : a + WIDTH // 2]) for a in range(0, WIDTH // 2, 20))
    assert not wraps(np.full((80, 160, 3), 90, np.uint8))
    random = np.random.default_rng(0)
    assert not wraps(random.integers(0, 255, (80, 160, 3), np.uint8))
    (tmp_path / "photos").mkdir()
    for i, pose in enumerate(corridor.poses(3)):
        Image.fromarray(corridor.picture(pose)[20:140]).save(tmp_path / "photos" / f"{i}.png")
    photos = gather(tmp_path / "photos", sorted((tmp_path / "photos").iterdir()), tmp_path / "input")
    assert photos[0].width == 2 * photos[0].height
    assert cut(tmp_path / "input/images", photos, None, tmp_path / "faces") == []


def test_masks_are_cut_like_panoramas(frames, tmp_path):
    photos = gather(frames, sorted(frames.iterdir())[:2], tmp_path / "input")
    (tmp_path / "masks").mkdir()
    for photo in photos:
        mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
        mask[:, WIDTH * 5 // 8 : WIDTH * 7 // 8] = 0  # the right
        Image.fromarray(mask).save(tmp_path / "masks" / f"{photo.name}.png")
    faces = cut(tmp_path / "input/images", photos, tmp_path / "masks", tmp_path / "cut")
    assert [f.name for f in faces[:3]] == ["front-pano_0.png", "front-pano_1.png", "right-pano_0.png"]
    used = {f.name: np.asarray(Image.open(tmp_path / "cut/masks" / f"{f.name}.png")).mean() / 255 for f in faces}
    assert used["right-pano_1.png"] == 0 and used["left-pano_1.png"] == used["back-pano_0.png"] == 1
    assert used["up-pano_1.png"] == pytest.approx(0.75, abs=0.01)


def test_other_images_and_options_among_panoramas_are_refused(frames, tmp_path):
    with pytest.raises(InputError, match="take no --focal and no --refine-intrinsics: leave it out"):
        prepare(Settings(frames, tmp_path / "scene", focal=100.0, refine_intrinsics=True, threads=1))
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for file in sorted(frames.iterdir())[:3]:
        (mixed / file.name).symlink_to(file)
    corridor.write_images(mixed, 2)
    with pytest.raises(InputError, match="3 of 5 images are 360-degree panoramas of 640x320"):
        prepare(Settings(mixed, tmp_path / "scene", threads=1))
