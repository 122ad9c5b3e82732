"""``load`` and ``render`` of runs and of baked scenes: the images of ns-eval and of bricks, batches, refusals."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from random_bricks import random_window, scene_of
from tiny_scene import write_scene
from training_runs import ready, trainer_config, write_plan, write_windows

import mmpi_ns
import mmpi_show
from mmpi_ns.utils.errors import InputError
from mmpi_show.files import HEADER, read_baked, write_baked
from mmpi_show.reader import camera_rays

ROOT = Path(__file__).parents[1]


def trained(folder, planner, **model):
    """config.yml of a run of a few steps whose colours are far from uniform."""
    data = write_scene(folder / "data")
    config = trainer_config(data, planner(data, folder / "plan.json"), folder / "outputs", steps=12, **model)
    config.save_config()
    ready(config).train()
    return config.get_base_dir() / "config.yml"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"), write_plan)


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """Of two windows."""
    return trained(tmp_path_factory.mktemp("long"), write_windows, training="joint")


def pinhole(camera):
    """Pose, intrinsics and size of one of nerfstudio's cameras."""
    lens = torch.eye(3)
    lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2] = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    return camera.camera_to_worlds[0], lens, int(camera.width), int(camera.height)


@pytest.mark.parametrize("which", ["run", "long_run"])
def test_images_of_a_run_are_those_of_ns_eval(which, request):
    """Bit for bit, of the test cameras, one by one."""
    config = request.getfixturevalue(which)
    scene = mmpi_ns.load(config, device="cpu")
    _, pipeline, _, _ = eval_setup(config)
    assert scene.mpis == pipeline.model.progress.windows.names
    cameras = pipeline.datamanager.eval_dataset.cameras
    for i in range(len(cameras)):
        images = mmpi_ns.render(scene, *pinhole(cameras[i : i + 1]))
        outputs = pipeline.model.get_outputs_for_camera(cameras[i : i + 1])
        assert images.rgb.shape == (24, 32, 3) and images.rgb.std() > 0.02
        assert (outputs["rgb"] - outputs["field_rgb"]).abs().max() > 0.01, "nothing is shown of the training images"
        for name in ("rgb", "depth", "accumulation", "winning_mpi"):
            assert torch.equal(getattr(images, name), outputs[name].to(getattr(images, name).dtype)), name
    assert not images.winning_mpi.is_floating_point()


def test_a_run_needs_no_images_and_may_be_moved(long_run, tmp_path):
    """The folder of a run holds all of it: its windows too. Its path is that of the training cameras."""
    before = mmpi_ns.load(long_run)
    moved, data = tmp_path / "moved", long_run.parents[4] / "data"
    long_run.parent.rename(moved)
    data.rename(tmp_path / "data")
    try:
        scene = mmpi_ns.load(moved, device="cpu")
        assert len(scene.path) == 6 and scene.path.sizes.tolist() == [[32, 24]] * 6
        view = scene.path.camera_to_worlds[0], scene.path.intrinsics[0], 32, 24
        images = mmpi_ns.render(scene, *view)
        assert images.rgb.std() > 0.02
    finally:
        moved.rename(long_run.parent)
        (tmp_path / "data").rename(data)
    assert torch.equal(mmpi_ns.render(before, *view).rgb, images.rgb)


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Folder of a baked scene of two windows."""
    folder = tmp_path_factory.mktemp("site")
    write_baked(scene_of(random_window(seed=1, num_mpis=3), random_window(seed=2), radius=1.9), folder)
    return folder


def test_images_of_a_baked_scene_are_those_of_its_bricks(baked):
    """Over the whole path, with all windows; rays are made apart, in float64."""
    scene, bricks = mmpi_show.load(baked, device="cpu"), read_baked(baked)
    assert len(scene.mpis) == 5 and len(scene.path) == len(bricks.path)
    for i, pose in enumerate(bricks.path):
        width, height = pose.size
        images = mmpi_ns.render(scene, scene.path.camera_to_worlds[i], scene.path.intrinsics[i], width, height)
        rays = [torch.tensor(np.array(x), dtype=torch.float32) for x in camera_rays(pose.__dict__)]
        expected = bricks.render(*rays)
        assert expected["rgb"].std() > 0.02
        close = (images.rgb.view(-1, 3) - expected["rgb"]).abs().amax(-1) < 1e-3
        assert close.float().mean() > 0.99  # a ray through the border of a brick may round to either side
        assert (images.depth.view(-1) / expected["depth"].view(-1)).log().abs().median() < 1e-4


def test_cameras_come_in_batches_of_any_shape(baked):
    """Poses [N, M, 3 or 4, 4] with intrinsics for each or for all; numbers may be plain lists."""
    scene = mmpi_show.load(baked, device="cpu")
    poses, lens = scene.path.camera_to_worlds[:2], scene.path.intrinsics[0]
    last = torch.tensor([0.0, 0, 0, 1]).expand(2, 1, 4)
    grid = torch.stack([torch.cat([poses, last], 1)] * 3)
    lenses = lens.repeat(3, 2, 1, 1)
    lenses[1, :, 0, 0] *= 1.5
    images = mmpi_ns.render(scene, grid, lenses, 20, 12)
    assert images.rgb.shape == (3, 2, 12, 20, 3) and images.winning_mpi.shape == (3, 2, 12, 20, 1)
    alone = [mmpi_ns.render(scene, pose.tolist(), lens.tolist(), 20, 12).rgb for pose in poses]
    assert alone[0].shape == (12, 20, 3) and not torch.equal(*alone)
    for i in (0, 2):
        assert all(torch.equal(images.rgb[i, j], alone[j]) for j in range(2))
    assert not torch.equal(images.rgb[1, 0], alone[0])
    assert torch.equal(mmpi_ns.render(scene, poses, lens, 20, 12).rgb, torch.stack(alone))


@pytest.mark.parametrize(("page", "number"), [("docs/export.md", 0), ("docs/export.md", 1)])
def test_examples_of_the_documentation_run(page, number, run, baked, tmp_path, monkeypatch):
    """As they stand there: only the folders are those of the reader."""
    code = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    code = code[number]
    assert len(code.splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    Path("site").symlink_to(baked)
    Path("outputs/scene/mmpi").mkdir(parents=True)
    Path("outputs/scene/mmpi/run").symlink_to(run.parent)
    exec(compile(code, page, "exec"), {})
    pictures = list(Path().glob("*.png"))
    assert pictures and all(np.asarray(Image.open(path)).std() > 3 for path in pictures)


def test_what_is_no_scene_is_one_sentence(tmp_path, run):
    for package, kind in ((mmpi_ns, "run"), (mmpi_show, "baked scene")):
        with pytest.raises(InputError, match=f"There is no {kind} at .*nothing"):
            package.load(tmp_path / "nothing")
    config = tmp_path / "config.yml"
    for text, words in (("a: [", "not a config.yml that ns-train wrote \\("), ("a: 1", "beside nerfstudio_models")):
        config.write_text(text)
        with pytest.raises(InputError, match=words):
            mmpi_ns.load(config)
    other = yaml.load(run.read_text(), Loader=yaml.Loader)
    config.write_text(yaml.dump(other))
    with pytest.raises(InputError, match="no checkpoint in"):
        mmpi_ns.load(tmp_path)
    config.write_text(yaml.dump(TrainerConfig()))
    with pytest.raises(InputError, match="another method"):
        mmpi_ns.load(tmp_path)
    (tmp_path / HEADER).write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        mmpi_show.load(tmp_path)


def test_cameras_that_cannot_be_rendered_are_one_sentence(baked):
    scene = mmpi_show.load(baked, device="cpu")
    pose, lens = scene.path.camera_to_worlds[0], scene.path.intrinsics[0]
    skewed = lens.clone()
    skewed[0, 1] = 0.1
    for changes, words in (
        ({"camera_to_worlds": pose[:, :3]}, r"camera_to_worlds must be \[\*N, 3, 4\]"),
        ({"camera_to_worlds": pose[None][:0]}, "camera_to_worlds must be"),
        ({"intrinsics": lens[None]}, "intrinsics must be"),
        ({"intrinsics": skewed}, "without skew"),
    ):
        camera = {"camera_to_worlds": pose, "intrinsics": lens, "width": 8, "height": 6} | changes
        with pytest.raises(InputError, match=words) as caught:
            mmpi_ns.render(scene, **camera)
        assert str(caught.value).endswith(".")
