"""What the data manager draws and what it hands to the model, on the tiny scene."""

from __future__ import annotations

import copy
import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.model_components.ray_generators import RayGenerator
from PIL import Image
from tiny_scene import HEIGHT, TRAIN, WIDTH, color_of, edit, image_of, name_of, project, wall_points, write_scene
from training_runs import datamanager, in_capture_frame

from mmpi_ns.data import rays
from mmpi_ns.data.rays import CameraRays, image_rays
from mmpi_ns.utils.random_draws import generator
from mmpi_priors.sfm import MIN_TRACK

TRACKED = sum(project(i, wall_points())[1].astype(int) for i in range(8)) >= MIN_TRACK


@pytest.fixture(scope="module")
def manager(scene):
    return datamanager(scene)


def wall_in_scene_units(manager):
    """Points of the wall in the data parser's frame."""
    outputs = manager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double().numpy()
    return (wall_points() @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale


def same(a, b):
    return torch.equal(a[1]["indices"], b[1]["indices"]) and torch.equal(a[0].directions, b[0].directions)


def test_a_batch_depends_on_the_seed_and_the_step_and_on_nothing_else(scene, manager):
    first = manager.next_train(7)
    manager.next_train(8)
    torch.rand(3)
    assert same(first, manager.next_train(7))
    assert not same(first, manager.next_train(8))
    assert same(first, datamanager(scene).next_train(7))
    assert not same(first, datamanager(scene, seed=1).next_train(7))


def test_rays_drawn_together_are_those_of_each_step_whatever_comes_between(scene, manager):
    steps = [manager.next_train(step) for step in range(20)]
    assert not any(same(a, b) for a, b in pairwise(steps))
    other = datamanager(scene)
    for step in (13, 3, 4, 19):
        assert same(steps[step], other.next_train(step))
        alone, batch = other.sources.draw(64, generator(other.config.seed, step, "pixels"))  # as on a GPU
        assert same(steps[step], (alone[0], {"indices": batch["indices"][0]}))
    other.use_cameras(np.array([2]))
    assert set(other.next_train(18)[1]["indices"][:, 0].tolist()) == {2}


def test_a_batch_holds_the_colours_of_the_pixels_that_its_rays_pass(manager):
    rays, batch = manager.next_train(0)
    assert len(rays) == 64 + 16 and batch["image"].shape == (64, 3)
    for color, (camera, row, column) in zip(batch["image"], batch["indices"].tolist(), strict=True):
        assert np.abs(color.numpy() - image_of(TRAIN[camera])[row, column]).max() < 0.5 / 255 + 1e-6
    wanted = manager.train_dataset.cameras.generate_rays(
        batch["indices"][:, :1], coords=batch["indices"][:, 1:].float() + 0.5
    )
    assert torch.allclose(rays.directions[:64], wanted.directions, atol=1e-6)
    assert torch.allclose(rays.origins[:64], wanted.origins)
    assert (rays.keypoint_disparities[:64] == 0).all() and (rays.keypoint_disparities[64:] > 0).all()


def test_rays_of_late_steps_leave_the_centres_of_their_pixels_alike_in_all_directions(scene):
    manager = datamanager(scene, pixel_jitter=0.4)
    cameras, jittered = manager.train_dataset.cameras, []
    manager.jitter_from = 24.0
    for step in range(20, 64):
        rays, batch = manager.next_train(step)
        centers = CameraRays.of(cameras, "cpu")(batch["indices"])
        moved = (rays.directions[:64] - centers.directions) / centers.pixel_area.sqrt()
        jittered.append((moved[:, :, None] * cameras[batch["indices"][:, 0]].camera_to_worlds[:, :, :3]).sum(1))
        assert (torch.linalg.vector_norm(rays.directions, dim=-1) - 1).abs().max() < 1e-6
    assert torch.cat(jittered[:4]).abs().max() < 1e-4
    shifts = torch.cat(jittered[4:])
    spread = shifts.T.cov()  # along the two directions that are not the ray's
    assert (shifts.mean(0).abs() < 0.03).all()
    assert abs(spread.trace() - 2 * 0.4**2) < 0.02 and abs(spread[0, 0] - spread[1, 1]) < 0.03
    assert (spread - spread.diag().diag()).abs().max() < 0.01


def test_masked_pixels_are_never_drawn(tmp_path):
    parser = NerfstudioDataParserConfig(mask_color=(0.0, 0.0, 0.0))
    manager = datamanager(write_scene(tmp_path / "masked", masks=True), dataparser=parser)
    assert len(manager.sources.pixels.colors) == len(TRAIN) * WIDTH * HEIGHT / 2
    columns = torch.cat([manager.next_train(step)[1]["indices"][:, 2] for step in range(20)])
    assert columns.max() == WIDTH / 2 - 1 and columns.min() == 0


def test_images_are_reduced_to_the_sizes_of_their_cameras(tmp_path):
    """0.35 * 360 is 126 in 32 bits, and less in 64."""
    data, (width, height) = write_scene(tmp_path / "reduced", sfm=False), (480, 360)
    for i in range(8):
        Image.fromarray(np.zeros((height, width, 3), np.uint8)).save(data / "images" / name_of(i))
    edit(data, lambda meta: meta.update(w=width, h=height, cx=240, cy=180, fl_x=400, fl_y=400))
    manager = datamanager(data, "test", camera_res_scale_factor=0.35)
    assert manager.train_dataset[0]["image"].shape == (126, 168, 3)


def test_a_capture_without_test_images_counts_none(tmp_path):
    data = write_scene(tmp_path / "all")
    edit(data, lambda meta: meta.update(val_filenames=[], test_filenames=[]))
    assert datamanager(data).describe().startswith(f"Capture: {len(TRAIN)} training and 0 test images")


def test_masks_that_leave_nothing_are_refused(tmp_path):
    data = write_scene(tmp_path / "black", masks=True)
    for i in range(8):
        Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(data / "masks" / name_of(i))
    with pytest.raises(ValueError, match="masks leave no training pixel"):
        datamanager(data)


def test_transparency_reaches_the_batch(tmp_path):
    manager = datamanager(write_scene(tmp_path / "alpha", alpha=True))
    batch = manager.next_train(0)[1]
    assert batch["image"].shape == (64, 4)
    assert torch.equal(batch["image"][:, 3] == 0, batch["indices"][:, 1] < HEIGHT // 4)


def test_moving_objects_that_are_not_searched_for_are_not_said_to_be_absent(scene, monkeypatch, capsys):
    monkeypatch.setattr("mmpi_priors.maker.posed_images", lambda *_: None)  # as of a camera of another kind
    manager = datamanager(scene)
    said = " ".join(capsys.readouterr().out.split())
    assert "Moving objects are not searched for" in said
    assert "No moving objects" not in said and not manager.priors.movers


def test_transparent_pixels_have_no_depth_whatever_their_colours(tmp_path, manager):
    """A cut-out whose colours are kept below: the wall is seen there, and is not to be there."""
    data, cut = write_scene(tmp_path / "cut"), slice(HEIGHT // 2, HEIGHT // 2 + 6)
    for i in range(8):
        path = data / "images" / name_of(i)
        image = np.dstack([np.array(Image.open(path)), np.full((HEIGHT, WIDTH), 255, np.uint8)])
        image[cut, :, 3] = 0
        Image.fromarray(image).save(path)
    priors = datamanager(data).priors
    for i in range(len(TRAIN)):
        assert (manager.priors.depths.image(i)[cut, :, 0] > 0).any()
        known = priors.depths.image(i)[..., 0] > 0
        assert not known[cut].any() and known.any()
    rows = priors.observations.seen_at[:, 1].astype(int)
    assert len(rows) and not ((rows >= cut.start) & (rows < cut.stop)).any()


def test_keypoints_are_those_of_training_images_and_lie_on_the_wall(manager):
    observations = manager.observations
    wall = wall_in_scene_units(manager)
    assert len(observations.points) == TRACKED.sum() > 20
    gaps = np.linalg.norm(observations.points[:, None] - wall[TRACKED][None], axis=-1)
    row = gaps.argmin(1)  # COLMAP's order is its own
    assert gaps.min(1).max() < 1e-4 and len(set(row)) == len(row)
    wanted = sum((project(i, wall_points())[1] & TRACKED).sum() for i in TRAIN)
    assert len(observations.seen_by) == wanted and set(observations.seen_by) == set(range(6))
    for camera, point, at in zip(observations.seen_by, observations.seen_point, observations.seen_at, strict=True):
        pixels, _ = project(TRAIN[camera], wall_points()[TRACKED])
        assert np.abs(pixels[row[point]] - at).max() < 1e-6


def test_a_keypoint_ray_ends_on_its_point_at_the_known_distance(manager):
    rays, _ = manager.next_train(3)
    ends = rays.origins[64:] + rays.directions[64:] / rays.keypoint_disparities[64:]
    gaps = np.linalg.norm(ends.numpy()[:, None] - wall_in_scene_units(manager)[None], axis=-1).min(1)
    assert gaps.max() < 2e-3


def test_without_a_colmap_model_or_on_request_there_are_no_keypoint_rays(scene, tmp_path):
    bare = datamanager(write_scene(tmp_path / "bare", sfm=False))
    rays, _ = bare.next_train(0)
    assert len(rays) == 64 and (rays.keypoint_disparities == 0).all()
    assert len(datamanager(scene, keypoint_rays=0).next_train(0)[0]) == 64


def with_cover(manager, cover):
    """The manager's sources as if this share of the pixels had points shared by two images."""
    new_views = dataclasses.replace(manager.sources.new_views, cover=cover)
    return dataclasses.replace(manager.sources, new_views=new_views)


def test_rays_of_new_views_come_after_the_pixels_and_leave_fewer_keypoint_rays(scene):
    manager = datamanager(scene, new_view_share=1.0)
    count = len(manager.sources.new_views.pixels)
    assert manager.sources.new_views.cover > 1 and len(manager.next_train(2)[0]) == 128, "no keypoint is missed"
    manager.sources = with_cover(manager, 0.25)
    rays, batch = manager.next_train(2)
    assert batch["image"].shape == (64 + 16, 3) and len(rays) == 64 + 16 + 12
    views = slice(64, 64 + 16)
    assert (rays.disparities[views] > 0).all() and (rays.keypoint_disparities[views] == 0).all()
    assert rays.through_pixel[:, 0].tolist() == [True] * 64 + [False] * (16 + 12)
    origins, directions = in_capture_frame(manager, rays.origins.double().numpy(), rays.directions.double().numpy())
    error = np.abs(batch["image"].numpy()[views] - color_of(origins[views], directions[views]))
    assert np.median(error) < 0.02, "their colours are those of the scene, seen from there"
    manager.use_cameras(np.array([0, 1, 2]))
    own = manager.sources.new_views
    assert set(own.pixels[:, 0].tolist()) | set(own.other.tolist()) <= {0, 1, 2}
    assert own.cover == pytest.approx(len(own.pixels) / (3 * WIDTH * HEIGHT))
    assert set(manager.sources.keypoints.camera_indices[:, 0].tolist()) == {0, 1, 2}
    manager.use_cameras(None)
    assert len(manager.sources.new_views.pixels) == count


def test_keypoints_on_masked_pixels_are_left_out(tmp_path, manager):
    masked = datamanager(write_scene(tmp_path, masks=True)).observations
    open_ = manager.observations
    assert (open_.seen_at[:, 0] >= WIDTH / 2).any()
    wanted = open_.seen_at[:, 0] < WIDTH / 2
    assert np.array_equal(masked.seen_at, open_.seen_at[wanted])
    assert np.array_equal(masked.seen_by, open_.seen_by[wanted])
    assert np.array_equal(masked.seen_point, open_.seen_point[wanted])


def test_rays_of_pinhole_cameras_are_nerfstudios(scene):
    manager = datamanager(scene)
    cameras = manager.train_dataset.cameras
    g = torch.Generator().manual_seed(1)
    sizes = torch.stack([cameras.height[:, 0], cameras.width[:, 0]], -1)
    camera = torch.randint(0, len(cameras), (50,), generator=g)
    indices = torch.cat([camera[:, None], (torch.rand(50, 2, generator=g) * sizes[camera]).long()], -1)
    made = CameraRays.of(cameras, "cpu")
    assert made is not None
    ours, theirs = made(indices), RayGenerator(cameras)(indices)
    for name in ("origins", "directions", "camera_indices"):
        assert torch.allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6), name
    assert ours.pixel_area.shape == theirs.pixel_area.shape
    timed = copy.deepcopy(cameras)
    timed.times = torch.zeros(len(cameras), 1)  # as the viewer's
    made = CameraRays.of(timed, "cpu")
    assert made is not None and torch.equal(made(indices).directions, ours.directions)
    image, whole = image_rays(cameras[0:1]), cameras[0:1].generate_rays(camera_indices=0, keep_shape=True)
    for name in ("origins", "directions", "camera_indices"):
        assert getattr(image, name).shape == getattr(whole, name).shape
        assert torch.equal(getattr(image_rays(cameras[0:1], 3), name), getattr(image, name)[1::3, 1::3]), name
        assert torch.allclose(getattr(image, name), getattr(whole, name), atol=1e-6), name


@pytest.mark.parametrize("kind", ["PERSPECTIVE", "FISHEYE", "both"])
def test_rays_through_a_lens_are_nerfstudios(scene, kind, monkeypatch):
    """Two lenses and two sizes; every pixel of an image, made in parts, and a batch."""
    monkeypatch.setattr(rays, "CHUNK", 5 * WIDTH + 3)
    cameras = copy.deepcopy(datamanager(scene).train_dataset.cameras)
    cameras.distortion_params = torch.tensor([0.05, -0.02, 0.0, 0.0, 0.003, -0.002]).repeat(len(cameras), 1)
    cameras.camera_type = cameras.camera_type.clone()
    if kind != "PERSPECTIVE":
        fisheye = slice(None) if kind == "FISHEYE" else slice(0, 3)
        cameras.camera_type[fisheye] = CameraType.FISHEYE.value
        cameras.distortion_params[fisheye] = torch.tensor([0.03, -0.01, 0.002, 0.001, 0.0, 0.0])
    cameras.distortion_params[1, 0] = 0.02
    cameras.width[4], cameras.cx[4] = WIDTH - 5, WIDTH / 2 - 3
    made = CameraRays.of(cameras, "cpu")
    assert made.lenses is not None
    distinct = 3 + (kind == "both")
    assert (distinct - 1) * WIDTH * HEIGHT < len(made.lenses[0]) < distinct * WIDTH * HEIGHT
    g = torch.Generator().manual_seed(1)
    camera = torch.randint(0, len(cameras), (200,), generator=g)
    sizes = torch.stack([cameras.height[:, 0], cameras.width[:, 0]], -1)[camera]
    indices = torch.cat([camera[:, None], (torch.rand(200, 2, generator=g) * sizes).long()], -1)
    ours, theirs = made(indices), RayGenerator(cameras)(indices)
    for name in ("origins", "directions", "camera_indices"):
        assert torch.allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6), name
    for i in (1, 4):
        alone = cameras[i : i + 1]
        assert CameraRays.of(alone, "cpu") is not None
        image, whole = image_rays(alone), alone.generate_rays(camera_indices=0, keep_shape=True)
        assert image.directions.shape == whole.directions.shape
        assert torch.allclose(image.directions, whole.directions, atol=1e-6)


def test_other_cameras_are_left_to_nerfstudio(scene, monkeypatch):
    cameras = datamanager(scene).train_dataset.cameras
    bent, round_ = copy.deepcopy(cameras), copy.deepcopy(cameras)
    bent.distortion_params = torch.zeros(len(cameras), 6)
    assert CameraRays.of(bent, "cpu").lenses is None, "a lens model without effect"
    bent.distortion_params[1, 0] = 0.1
    monkeypatch.setattr(rays, "MOST_DIRECTIONS", 2 * WIDTH * HEIGHT - 1)
    assert CameraRays.of(bent, "cpu") is None, "two lenses, of too many pixels"
    monkeypatch.setattr(rays, "MOST_DIRECTIONS", WIDTH * HEIGHT - 1)
    assert CameraRays.of(bent[1:2], "cpu").lenses is not None, "one lens, of any number of pixels"
    round_.camera_type = torch.full_like(round_.camera_type, CameraType.EQUIRECTANGULAR.value)
    assert CameraRays.of(round_, "cpu") is None
    whole = round_[:1].generate_rays(camera_indices=0, keep_shape=True)
    assert torch.equal(rays.image_rays(round_[:1]).directions, whole.directions)
