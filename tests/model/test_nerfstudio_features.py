"""What nerfstudio offers, used once as a user would, on the tiny scene (test_commands.py has the rest)."""

from __future__ import annotations

import gzip
import http.client
import io
import shutil
import sys
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from nerfstudio.scripts.render import DatasetRender, SpiralRender
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from tiny_scene import FOCAL, HEIGHT, TEST, WALL, WIDTH, on_wall, pixel_rays, pose_of, write_scene
from training_runs import in_capture_frame, ready, trainer_config, write_plan

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


def test_raw_depth_of_ns_render_is_in_the_units_of_the_capture(run, tmp_path):
    DatasetRender(run.base_dir / "config.yml", output_path=tmp_path, rendered_output_names=["raw-depth"]).main()
    files = sorted((tmp_path / "test" / "raw-depth").glob("*.npy.gz"))
    assert len(files) == len(TEST)
    for file, i in zip(files, TEST, strict=True):
        assert relative_error(np.load(gzip.open(file))[..., 0], i) < 0.15


def test_ns_render_takes_the_copies_of_a_downscale_factor(run, tmp_path):
    """Its option is a number with a decimal point: 2 on the command line becomes 2.0."""
    data = run.config.pipeline.datamanager.data
    (data / "images_2").mkdir()
    for file in (data / "images").iterdir():
        Image.open(file).reduce(2).save(data / "images_2" / file.name)
    config, names = run.base_dir / "config.yml", ["rgb", "gt-rgb"]
    DatasetRender(config, output_path=tmp_path, downscale_factor=2.0, rendered_output_names=names).main()
    pictures = [Image.open(file) for file in tmp_path.rglob("*.jpg")]
    assert [picture.size for picture in pictures] == [(WIDTH // 2, HEIGHT // 2)] * 2 * len(TEST)


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
    actual = [np.asarray(Image.open(f), float) / 255 for f in sorted((tmp_path / "out").glob("*.png"))]
    assert len(actual) == 4 and all(f.shape == (HEIGHT, WIDTH, 3) for f in actual)
    assert all(f.std() > 0.05 for f in actual) and np.abs(actual[0] - actual[1]).max() > 0.02


def test_points_for_export_lie_on_the_wall(run, monkeypatch, capsys):
    """Everything about ``ns-export pointcloud`` but open3d, which only holds the points and smoothes them."""
    from nerfstudio.exporter.exporter_utils import generate_point_cloud

    open3d = SimpleNamespace(
        geometry=SimpleNamespace(PointCloud=type("Cloud", (), {})), utility=SimpleNamespace(Vector3dVector=np.asarray)
    )
    monkeypatch.setitem(sys.modules, "open3d", open3d)
    _, pipeline, _, _ = eval_setup(run.base_dir / "config.yml")
    pipeline.datamanager.train_pixel_sampler.num_rays_per_batch = 1000
    cloud = generate_point_cloud(pipeline, 3000, remove_outliers=False)
    points, _ = in_capture_frame(pipeline.datamanager, cloud.points, np.zeros_like(cloud.points))
    near = points[:, 2] > 2 * WALL  # the others are the background
    share, error = near.mean(), np.median(np.abs(points[near, 2] - WALL))
    # 3,000 draws of 4,608 pixels are 2,205 different ones; one batch over and over would be less than 1,000.
    assert len(np.unique(points, axis=0)) > 2000 and share > 0.3 and error < 0.5
    assert cloud.colors.shape == points.shape and cloud.colors.std() > 0.05
    with pytest.raises(SystemExit):
        generate_point_cloud(pipeline, 3000, normal_output_name="normals")
    assert "Could not find normals in the model outputs" in " ".join(capsys.readouterr().out.split())


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
                actual = msgspec.msgpack.decode(self.socket.recv(timeout=timeout))
                self.received = [actual] if isinstance(actual, dict) else list(actual)
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
        """The last picture [H, W, 3] of those that come, coarse ones first, until none comes for three seconds."""
        actual, timeout = None, 20
        while True:
            try:
                actual = self.wait_for(lambda m: m["type"] == "BackgroundImageMessage", timeout)
                timeout = 3  # on a busy machine the fine one takes more than a second
            except TimeoutError:
                return np.asarray(Image.open(io.BytesIO(actual["rgb_bytes"])).convert("RGB"), float) / 255


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
    assert alone.shape == first.shape and np.abs(alone - first).mean() > 0.003


def test_each_of_two_windows_has_its_own_view_and_way_back(viewer):
    trainer, port = viewer
    pose = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[2].double().numpy()
    one, other = Browser(port), Browser(port)
    for window in (one, other):
        window.look(pose)
        assert window.settled().std() > 0.05
    one.look(pose @ np.diag([-1.0, 1.0, -1.0, 1.0]))  # to where nothing was captured
    shown = one.wait_for(lambda m: m.get("updates") == {"visible": True})
    assert one.settled().std() < 0.05
    with pytest.raises(TimeoutError):
        other.wait_for(lambda m: m["type"] == "BackgroundImageMessage" or m.get("id") == shown["id"], timeout=2)


def test_tensorboard_has_the_losses_and_the_sample_counts(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run.base_dir))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {"Train Loss", "Train Loss Dict/rgb_loss", "Train Metrics Dict/kept_samples"} <= tags
    losses = [e.value for e in events.Scalars("Train Loss Dict/rgb_loss")]
    assert np.mean(losses[-3:]) < 0.5 * losses[0]
