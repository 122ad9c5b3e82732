"""What nerfstudio offers, used once as a user would, on tiny scenes of every kind (test_commands.py has the rest)."""

from __future__ import annotations

import gzip
import http.client
import io
import json
import shutil

import msgspec
import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts.render import DatasetRender, SpiralRender
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from tiny_scene import FOCAL, HEIGHT, TEST, TRAIN, WALL, WIDTH, color_of, name_of, on_wall, pose_of, write_scene
from training_runs import datamanager, ready, trainer_config, write_plan

STEPS = 80


# Scenes of every kind ------------------------------------------------------------------------------------------------


def pixel_rays(width=WIDTH, height=HEIGHT, focal=FOCAL, undistort=lambda p: np.append(p, -np.ones((len(p), 1)), 1)):
    """Directions [H W, 3] of all pixels in camera axes; ``undistort`` takes ((x - cx) / f, -(y - cy) / f)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = undistort(np.stack([(x - width / 2) / focal, -(y - height / 2) / focal], -1).reshape(-1, 2))
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def repaint(data, i, rays, width=WIDTH, height=HEIGHT, alpha=None):
    """Writes image i as a camera with these rays [H W, 3] sees it."""
    pose = pose_of(i)
    directions = rays @ pose[:3, :3].T
    image = color_of(np.broadcast_to(pose[:3, 3], directions.shape), directions).reshape(height, width, 3)
    image = (image * 255).round().astype(np.uint8)
    if alpha is not None:
        image = np.concatenate([image, alpha], -1)
    Image.fromarray(image).save(data / "images" / name_of(i))


def edit(data, change):
    meta = json.loads((data / "transforms.json").read_text())
    change(meta)
    (data / "transforms.json").write_text(json.dumps(meta))


LENS = {"k1": -0.12, "k2": 0.03, "p1": 0.01, "p2": -0.008}


def opencv_undistort(points):
    """OpenCV's lens (y down), inverted by fixed-point iteration."""
    target, p = points * [1, -1], points * [1, -1]
    for _ in range(60):
        x, y = p.T
        r = x * x + y * y
        radial = (1 + LENS["k1"] * r + LENS["k2"] * r * r)[:, None]
        tangential = np.stack(
            [
                2 * LENS["p1"] * x * y + LENS["p2"] * (r + 2 * x * x),
                LENS["p1"] * (r + 2 * y * y) + 2 * LENS["p2"] * x * y,
            ],
            -1,
        )
        p = (target - tangential) / radial
    return np.append(p * [1, -1], -np.ones((len(p), 1)), 1)


def equidistant(points):
    """A fisheye: the angle from the axis grows with the distance from the centre."""
    angle = np.linalg.norm(points, axis=-1, keepdims=True)
    return np.append(points / angle * np.sin(angle), -np.cos(angle), 1)


def plain(data):
    return NerfstudioDataParserConfig()


def lens(data):
    for i in range(8):
        repaint(data, i, pixel_rays(undistort=opencv_undistort))
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


def transparent(data):
    return blender(data, alpha_color=None)


SCENES = (plain, lens, fisheye, several_sizes, masks, colmap, blender, transparent)


@pytest.fixture(scope="module", params=SCENES, ids=lambda f: f.__name__)
def capture(request, tmp_path_factory):
    """Kind, folder and data parser of a scene."""
    data = write_scene(tmp_path_factory.mktemp("capture") / "data")
    return request.param, data, request.param(data)


def in_capture_frame(manager, origins, directions):
    """Rays as they are in the capture's own axes and units."""
    outputs = manager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double().numpy()
    rotation = transform[:, :3]
    return (origins / outputs.dataparser_scale - transform[:, 3]) @ rotation, directions @ rotation


def test_every_pixel_drawn_has_the_colour_that_its_ray_meets(capture):
    kind, data, parser = capture
    manager = datamanager(data, dataparser=parser, triangulate=False)
    rays, batch = manager.next_train(0)
    origins, directions = (x[:64].double().numpy() for x in (rays.origins, rays.directions))
    wanted = color_of(*in_capture_frame(manager, origins, directions))
    found = batch["image"].numpy()
    seen = batch["indices"][:, 1].numpy() >= HEIGHT // 4
    if kind is blender:
        wanted[~seen] = 1  # white behind
    if kind is transparent:
        assert np.array_equal(found[:, 3] > 0, seen)
    error = np.abs(found[:, :3] - wanted).max(-1)
    # A pixel on the wall's very edge may fall on the other side of it.
    assert np.sort(error)[-3] < 0.02 and seen.any()
    if kind in (blender, transparent):
        assert not manager.observations.seen_at.size
    else:
        assert len(rays) == 64 + 16 and len(manager.observations.seen_at) > 60


def test_every_kind_of_scene_is_trained_and_evaluated(capture, tmp_path):
    kind, data, parser = capture
    if kind is transparent:
        pytest.skip("test_model.py trains transparent pixels")
    config = trainer_config(data, None, tmp_path, STEPS, training="joint", growth_shares=())
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.pipeline.datamanager.triangulate = False
    trainer = ready(config)
    trainer.train()
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    image = trainer.pipeline.datamanager.eval_dataset[0]["image"][..., :3]
    assert metrics["psnr"] > -10 * np.log10(float(image.var(dim=(0, 1)).mean())) + 2
    assert metrics["dropped_mass"] < 0.2


# Depth ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run on the plain scene, with its config.yml, as ns-train leaves it."""
    data = write_scene(tmp_path_factory.mktemp("plain") / "data")
    plan = write_plan(data, data.parent / "plan.json")
    config = trainer_config(data, plan, data.parent / "out", 300, training="joint", growth_shares=())
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.pipeline.datamanager.keypoint_rays = 64
    config.steps_per_save = 300
    config.save_config()
    trainer = ready(config)
    trainer.train()
    return trainer


def wall_distance(i):
    """Distance [H, W] along each pixel's ray of image i to the wall in the capture's units; 0 where it misses."""
    pose = pose_of(i)
    directions = pixel_rays() @ pose[:3, :3].T
    t = (WALL - pose[2, 3]) / directions[:, 2]
    x, y = (pose[:3, 3] + t[:, None] * directions)[:, :2].T
    return np.where(on_wall(x, y), t, 0).reshape(HEIGHT, WIDTH)


def relative_error(depth, i):
    truth = wall_distance(i)
    return np.median(np.abs(depth - truth)[truth > 0] / truth[truth > 0])


def test_depth_is_in_scene_units_and_the_scale_beside_the_config_makes_it_metres(run):
    datamanager = run.pipeline.datamanager
    depth = run.pipeline.model.eval().get_outputs_for_camera(datamanager.eval_dataset.cameras[:1])["depth"][..., 0]
    run.pipeline.model.train()
    scale = json.loads((run.base_dir / "dataparser_transforms.json").read_text())["scale"]
    assert abs(scale - 1) > 0.03 and relative_error(depth.numpy() / scale, TEST[0]) < 0.15


def test_raw_depth_of_ns_render_is_in_the_units_of_the_capture(run, tmp_path):
    DatasetRender(run.base_dir / "config.yml", output_path=tmp_path, rendered_output_names=["raw-depth"]).main()
    files = sorted((tmp_path / "test" / "raw-depth").glob("*.npy.gz"))
    assert len(files) == len(TEST)
    for file, i in zip(files, TEST, strict=True):
        assert relative_error(np.load(gzip.open(file))[..., 0], i) < 0.15


# Pictures, points and curves -----------------------------------------------------------------------------------------


@pytest.fixture
def ffmpeg(tmp_path, monkeypatch):
    """Something called ffmpeg: pictures need no encoder, but ns-render insists on one."""
    if shutil.which("ffmpeg") is None:
        (tmp_path / "ffmpeg").write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / "ffmpeg").chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")


def test_render_follows_a_spiral(run, ffmpeg, tmp_path):
    SpiralRender(
        run.base_dir / "config.yml",
        tmp_path / "out",
        image_format="png",
        output_format="images",
        seconds=1,
        frame_rate=4,
    ).main()
    found = [np.asarray(Image.open(f), float) / 255 for f in sorted((tmp_path / "out").glob("*.png"))]
    assert len(found) == 4 and all(f.shape == (HEIGHT, WIDTH, 3) for f in found)
    assert all(f.std() > 0.05 for f in found) and np.abs(found[0] - found[1]).max() > 0.02


def test_export_gets_other_pixels_with_each_call_and_no_keypoints(run):
    _, pipeline, _, _ = eval_setup(run.base_dir / "config.yml")
    pipeline.datamanager.train_pixel_sampler.num_rays_per_batch = 500
    a, b = (pipeline.datamanager.next_train(0)[0] for _ in range(2))
    assert len(a) == len(b) == 500 and not torch.equal(a.directions, b.directions)
    assert pipeline.model(a)["rgb"].shape == (500, 3)


def test_export_writes_a_point_cloud_in_the_frame_of_the_capture(run, tmp_path):
    o3d = pytest.importorskip("open3d", reason="open3d needs libusb, which this machine lacks", exc_type=ImportError)
    from nerfstudio.scripts.exporter import ExportPointCloud

    ExportPointCloud(
        run.base_dir / "config.yml", tmp_path, num_points=3000, normal_method="open3d", save_world_frame=True
    ).main()
    cloud = o3d.io.read_point_cloud(str(tmp_path / "point_cloud.ply"))
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    assert (
        len(points) > 2500 and len(np.unique(points, axis=0)) > 2500 and np.asarray(cloud.normals).shape == points.shape
    )
    near = points[:, 2] > 2 * WALL  # the others are the background
    assert near.mean() > 0.3 and np.median(np.abs(points[near, 2] - WALL)) < 0.5 and colors.std() > 0.05


def test_export_says_that_there_are_no_normals(run, tmp_path, capsys):
    pytest.importorskip("open3d", reason="open3d needs libusb, which this machine lacks", exc_type=ImportError)
    from nerfstudio.scripts.exporter import ExportMarchingCubesMesh, ExportPointCloud

    with pytest.raises(SystemExit) as ended:
        ExportPointCloud(run.base_dir / "config.yml", tmp_path).main()
    assert ended.value.code == 1 and "Or change --normal-method" in capsys.readouterr().out
    with pytest.raises(AssertionError, match="SDF field"):
        ExportMarchingCubesMesh(run.base_dir / "config.yml", tmp_path).main()


def test_tensorboard_has_the_losses_and_the_sample_counts(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run.base_dir))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {"Train Loss", "Train Loss Dict/rgb_loss", "Train Metrics Dict/kept_samples"} <= tags
    losses = [e.value for e in events.Scalars("Train Loss Dict/rgb_loss")]
    assert np.mean(losses[-3:]) < 0.5 * losses[0]


# Viewer --------------------------------------------------------------------------------------------------------------


class Browser:
    """Speaks to the viewer as its page does: over HTTP and one websocket."""

    def __init__(self, port):
        from websockets.sync.client import connect

        self.socket, self.received = connect(f"ws://127.0.0.1:{port}", max_size=None), []

    def send(self, kind, **fields):
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def wait_for(self, accept, timeout=20):
        """The next message that fits."""
        while True:
            if not self.received:
                found = msgspec.msgpack.decode(self.socket.recv(timeout=timeout))
                self.received = [found] if isinstance(found, dict) else list(found)
            while self.received:
                message = self.received.pop(0)
                if accept(message):
                    return message

    def look(self, camera_to_world, scale=10.0):
        """Moves the camera (10: nerfstudio shows its scenes ten times as large)."""
        from viser.transforms import SO3

        rotation = SO3.from_matrix(camera_to_world[:3, :3]) @ SO3.from_x_radians(np.pi)
        position = camera_to_world[:3, 3] * scale
        ahead = position - camera_to_world[:3, 2]
        self.send(
            "ViewerCameraMessage",
            wxyz=rotation.wxyz.tolist(),
            position=position.tolist(),
            fov=float(2 * np.arctan(HEIGHT / 2 / FOCAL)),
            aspect=WIDTH / HEIGHT,
            look_at=ahead.tolist(),
            up_direction=[0.0, 0.0, 1.0],
        )

    def settled(self):
        """The last picture [H, W, 3] of those that come, coarse ones first, until none comes for a second."""
        found, timeout = None, 20
        while True:
            try:
                found = self.wait_for(lambda m: m["type"] == "BackgroundImageMessage", timeout)
                timeout = 1
            except TimeoutError:
                return np.asarray(Image.open(io.BytesIO(found["rgb_bytes"])).convert("RGB"), float) / 255


@pytest.fixture
def viewer(run, tmp_path):
    """A trainer with the viewer on, which needs no display, and where it serves."""
    config = trainer_config(run.config.data, run.config.pipeline.model.plan_file, tmp_path, 300, training="joint")
    config.vis = "viewer+tensorboard"
    config.viewer.websocket_host = "127.0.0.1"
    config.save_config()
    trainer = ready(config, load_dir=run.checkpoint_dir)
    trainer._init_viewer_state()
    yield trainer, trainer.viewer_state.viser_server.get_port()
    for machine in trainer.viewer_state.render_statemachines.values():
        machine.running = False
    trainer.viewer_state.viser_server.stop()


def test_the_viewer_serves_its_page_renders_and_shows_one_mpi_alone(viewer):
    trainer, port = viewer
    page = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    page.request("GET", "/")
    assert page.getresponse().status == 200
    browser = Browser(port)
    control = browser.wait_for(lambda m: m.get("label") == "Show MPI")
    names = trainer.pipeline.model.field.plan.names
    assert tuple(control["options"]) == ("all", *names) and control["value"] == "all"
    pose = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[2].double().numpy()
    browser.look(pose)
    first = browser.settled()
    assert first.std() > 0.05
    browser.send("GuiUpdateMessage", id=control["id"], updates={"value": names[0]})
    alone = browser.settled()
    assert trainer.pipeline.model.show.value == names[0]
    assert alone.shape == first.shape and np.abs(alone - first).mean() > 0.01


def test_a_crop_without_size_in_the_viewer_shows_the_background_and_goes_on(run):
    """Somebody types a size, and a 0 comes first: an error would end the viewer's render thread."""
    from threading import Thread

    model, found = run.pipeline.model.eval(), []
    camera = run.pipeline.datamanager.eval_dataset.cameras[:1]
    box = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    thread = Thread(target=lambda: found.append(model.get_outputs_for_camera(camera, obb_box=box)))
    thread.start()
    thread.join()
    model.train()
    assert (found[0]["rgb"] == 0.5).all() and (found[0]["accumulation"] == 0).all()
