"""The captured path in nerfstudio's viewer."""

import base64
import io
import re
import signal
import time
from contextlib import contextmanager

import numpy as np
import pytest
from browser import CHROMIUM, browser
from forked import start, start_train, train
from numpy.testing import assert_allclose
from PIL import Image
from tiny_scene import HEIGHT, TRAIN, WIDTH, color_of, pixel_rays, pose_of, write_scene
from training_runs import write_plan

from mmpi_ns.viewer import CapturedPath, fitting_fov


def street(count=13):
    """Cameras a unit apart that look along -x, up is z; the first is rolled by ten degrees."""
    poses = np.zeros((count, 3, 4))
    poses[:, 1, 0] = poses[:, 2, 1] = poses[:, 0, 2] = 1  # right y, up z, backwards x
    poses[:, 0, 3] = -np.arange(count)
    roll = np.radians(10)
    poses[0, :, :2] = poses[0, :, :2] @ [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    return poses


def test_the_path_passes_through_every_camera_and_opens_in_its_first_third():
    path = CapturedPath(street(13))
    assert path.start == 2
    assert path.nearest(np.array([-6.6, 3.0, 0.0])) == 7
    assert_allclose(path.at(4.25).position, [-4.25, 0, 0], atol=1e-12)
    for i in range(13):
        assert_allclose(path.at(i).position, [-i, 0, 0], atol=1e-12)
        assert_allclose(path.at(i).direction, [-1, 0, 0], atol=1e-12)


def test_a_path_of_one_camera_is_that_camera():
    path = CapturedPath(street(1))
    assert path.start == 0
    assert_allclose(path.at(0).position, 0, atol=1e-12)


def test_one_rolled_camera_leaves_the_horizon_level():
    assert np.degrees(np.arccos(CapturedPath(street()).at(0).up[2])) < 1


def test_cameras_that_look_straight_down_have_their_own_up():
    poses = street(3)
    poses[:, :, :3] = np.eye(3)
    poses[0, :, :2] *= -1  # heads the other way
    path = CapturedPath(poses)
    assert_allclose([path.at(0).up, path.at(1).up], [[0, -1, 0], [0, 1, 0]], atol=1e-12)


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 4.0])
def test_a_window_lies_inside_the_image(aspect):
    half_height = np.tan(fitting_fov(1.0, 0.5, aspect) / 2)
    assert half_height <= 0.5 + 1e-12 and half_height * aspect <= 1 + 1e-12
    assert half_height == pytest.approx(0.5) or half_height * aspect == pytest.approx(1.0)


in_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the page with (apt-get install chromium)")
PANEL, BAR = 320, 51.19
"""Pixels beside and above the picture."""
WINDOW = (512 + PANEL, 435)
"""The picture has the images' aspect."""


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """A run that is sharp after some seconds."""
    data = write_scene(tmp_path_factory.mktemp("tiny") / "data")
    plan = write_plan(data, data.parent / "plan.json")
    return {
        "data": data,
        "pipeline.model.plan_file": plan, "pipeline.model.schedule.training": "joint",
        "pipeline.datamanager.train_num_rays_per_batch": 256, "viewer.websocket_host": "127.0.0.1",
    }  # fmt: skip


@contextmanager
def page(command, profile):
    """A window of the viewer of a command, which ends with it."""
    try:
        command.wait_for("http://127.0.0.1:", timeout=100)
        with browser(profile, size=WINDOW) as tab:
            tab.send("Page.navigate", url=re.search(r"http://127\.0\.0\.1:\d+", command.text())[0])
            yield tab
    finally:
        command.send(signal.SIGKILL)
        command.process.join(30)


def picture(tab):
    """What the window shows of the scene, at the size of the images."""
    shot = Image.open(io.BytesIO(base64.b64decode(tab.send("Page.captureScreenshot")["data"]))).convert("RGB")
    return np.asarray(shot.resize((WIDTH, HEIGHT), Image.Resampling.BOX, (0, BAR, WINDOW[0] - PANEL, WINDOW[1]))) / 255


def psnr_of(tab, truth):
    return -10 * np.log10(np.square(picture(tab) - truth).mean())


def until_it_resembles(tab, truth):
    """Waits for a picture of more than 20 dB."""
    end = time.monotonic() + 100
    while psnr_of(tab, truth) <= 20 and time.monotonic() < end:
        time.sleep(0.5)
    assert psnr_of(tab, truth) > 20, tab.messages


def turned(angle):
    """True image [H, W, 3] from where the window opens, after a turn to the left, rad."""
    pose, (c, s) = pose_of(TRAIN[1]), (np.cos(angle), np.sin(angle))
    directions = pixel_rays() @ (np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ pose[:3, :3]).T
    return color_of(np.broadcast_to(pose[:3, 3], directions.shape), directions).reshape(HEIGHT, WIDTH, 3)


def drag(tab, pixels):
    """Turns to the right and returns the true image from there; the picture's height is a whole turn."""
    tab.mouse("mousePressed", 150, 250, button="left", clickCount=1, buttons=1)
    for x in np.linspace(150, 150 + pixels, 9):
        tab.mouse("mouseMoved", x, 250, button="left", buttons=1)
    tab.mouse("mouseReleased", 150 + pixels, 250, button="left", clickCount=1)
    return turned(-2 * np.pi * pixels / (WINDOW[1] - BAR))


@in_browser
def test_ns_viewer_opens_at_a_training_image_and_follows_a_drag(options, tmp_path):
    trained = train(output=tmp_path, max_num_iterations=300, **options)
    assert trained.status == 0, trained.error[-3000:]
    config = next(tmp_path.glob("**/config.yml"))
    command = start("ns-viewer", "--load-config", config, "--viewer.websocket-host", "127.0.0.1")
    with page(command, tmp_path / "profile") as tab:
        until_it_resembles(tab, turned(0))
        until_it_resembles(tab, drag(tab, 12))


@in_browser
def test_ns_train_shows_where_one_looks_while_it_trains(options, tmp_path):
    command = start_train(output=tmp_path / "run", vis="viewer", max_num_iterations=100_000, **options)
    with page(command, tmp_path / "profile") as tab:
        tab.until("document.body?.innerText.includes('Step: ')", wait=100)
        time.sleep(5)  # until the camera stands where it opens
        truth, end = drag(tab, 12), time.monotonic() + 300
        while psnr_of(tab, truth) <= 20 and time.monotonic() < end:  # nerfstudio renders most for one who moves
            drag(tab, -12)
            drag(tab, 12)
            time.sleep(10)
        assert psnr_of(tab, truth) > 20 and command.process.is_alive()
