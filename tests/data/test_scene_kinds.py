"""Scenes of every kind that nerfstudio reads: lenses, sizes, masks, transparency, COLMAP's and Blender's layout."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNetDataParserConfig
from PIL import Image
from tiny_scene import (
    FOCAL,
    HEIGHT,
    TEST,
    TRAIN,
    WIDTH,
    color_of,
    edit,
    equidistant,
    name_of,
    pixel_rays,
    pose_of,
    undistort,
    write_scene,
)
from training_runs import datamanager, in_capture_frame, ready, trainer_config

STEPS = 80


def repaint(data, i, rays, width=WIDTH, height=HEIGHT, alpha=None):
    """Writes image i as a camera with these rays [H W, 3] sees it."""
    pose = pose_of(i)
    directions = rays @ pose[:3, :3].T
    image = color_of(np.broadcast_to(pose[:3, 3], directions.shape), directions).reshape(height, width, 3)
    image = (image * 255).round().astype(np.uint8)
    if alpha is not None:
        image = np.concatenate([image, alpha], -1)
    Image.fromarray(image).save(data / "images" / name_of(i))


LENS = {"k1": -0.12, "k2": 0.03, "p1": 0.01, "p2": -0.008}


def through_lens(points):
    x, y = undistort(points[:, 0], -points[:, 1], LENS.values())
    return np.stack([x, -y, -np.ones_like(x)], -1)


def plain(data):
    return NerfstudioDataParserConfig()


def lens(data):
    for i in range(8):
        repaint(data, i, pixel_rays(undistort=through_lens))
    edit(data, lambda meta: meta.update(LENS))
    return NerfstudioDataParserConfig()


def fisheye(data):
    for i in range(8):
        repaint(data, i, pixel_rays(undistort=equidistant))
    edit(data, lambda meta: meta.update(camera_model="OPENCV_FISHEYE"))
    return NerfstudioDataParserConfig()


def several_sizes(data):
    """Every other image has twice the pixels."""

    def change(meta):
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            for i, frame in enumerate(meta["frames"]):
                frame[key] = meta[key] * (1 + i % 2)
            del meta[key]

    edit(data, change)
    for i in range(1, 8, 2):
        repaint(data, i, pixel_rays(2 * WIDTH, 2 * HEIGHT, 2 * FOCAL), 2 * WIDTH, 2 * HEIGHT)
    return NerfstudioDataParserConfig()


def masks(data):
    shutil.rmtree(data)
    write_scene(data, masks=True)
    return NerfstudioDataParserConfig()


def colmap(data):
    """images and sparse/0, as COLMAP leaves them."""
    (data / "transforms.json").unlink()
    shutil.move(data / "colmap/sparse", data / "sparse")
    return ColmapDataParserConfig(colmap_path="sparse/0", eval_interval=4)


def blender(data, alpha_color="white"):
    """transforms_train.json and so on, with transparent backgrounds."""
    (data / "transforms.json").unlink()
    shutil.rmtree(data / "colmap")
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    alpha[: HEIGHT // 4] = 0
    for i in range(8):
        repaint(data, i, pixel_rays(), alpha=alpha)
    for split, images in (("train", TRAIN), ("val", TEST), ("test", TEST)):
        frames = [{"file_path": f"./images/{name_of(i)[:-4]}", "transform_matrix": pose_of(i).tolist()} for i in images]
        meta = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "frames": frames}
        (data / f"transforms_{split}.json").write_text(json.dumps(meta))
    return BlenderDataParserConfig(alpha_color=alpha_color)


def scannet(data):
    """ScanNet's folders, with depths along the optical axis in millimetres."""
    pytest.importorskip("open3d", reason="nerfstudio's ScanNet parser needs it", exc_type=ImportError)
    for name in ("color", "depth", "pose", "intrinsic"):
        (data / name).mkdir()
    camera = [[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(data / "intrinsic/intrinsic_color.txt", camera)
    for i in range(8):
        np.savetxt(data / f"pose/{i}.txt", pose_of(i) @ np.diag([1, -1, -1, 1]))
        Image.open(data / "images" / name_of(i)).save(data / f"color/{i}.png")
        Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(data / f"depth/{i}.png")
    return ScanNetDataParserConfig(train_split_fraction=0.75)


def transparent(data):
    return blender(data, alpha_color=None)


SCENES = (plain, lens, fisheye, several_sizes, masks, colmap, blender, scannet, transparent)


@pytest.fixture(scope="module", params=SCENES, ids=lambda f: f.__name__)
def capture(request, tmp_path_factory):
    """Kind, folder and data parser of a scene."""
    data = write_scene(tmp_path_factory.mktemp("capture") / "data")
    return request.param, data, request.param(data)


def test_every_pixel_drawn_has_the_colour_that_its_ray_meets(capture):
    kind, data, parser = capture
    manager = datamanager(data, dataparser=parser, triangulate=False)
    rays, batch = manager.next_train(0)
    origins, directions = (x[:64].double().numpy() for x in (rays.origins, rays.directions))
    wanted = color_of(*in_capture_frame(manager, origins, directions))
    actual = batch["image"].numpy()
    seen = batch["indices"][:, 1].numpy() >= HEIGHT // 4
    if kind is blender:
        wanted[~seen] = 1  # white behind
    if kind is transparent:
        assert np.array_equal(actual[:, 3] > 0, seen)
    error = np.abs(actual[:, :3] - wanted).max(-1)
    # A pixel on the wall's very edge may fall on the other side of it.
    assert np.sort(error)[-3] < 0.02 and seen.any()
    if kind in (blender, scannet, transparent):
        assert not manager.observations.seen_at.size
    else:
        assert len(rays) == 64 + 16 and len(manager.observations.seen_at) > 60


def test_every_kind_of_scene_is_trained_and_evaluated(capture, tmp_path):
    _, data, parser = capture
    config = trainer_config(data, None, tmp_path, STEPS, training="joint", growth_shares=())
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.pipeline.datamanager.priors.triangulate = False
    trainer = ready(config)
    trainer.train()
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    image = trainer.pipeline.datamanager.eval_dataset[0]["image"][..., :3]
    assert metrics["psnr"] > -10 * np.log10(float(image.var(dim=(0, 1)).mean())) + 2
    assert metrics["dropped_mass"] < 0.2
