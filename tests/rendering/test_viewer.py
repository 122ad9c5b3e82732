"""The captured path in nerfstudio's viewer."""

import base64
import io
import re
import signal
import time
from contextlib import contextmanager
from itertools import cycle
from threading import Thread
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from browser import CHROMIUM, TabError, browser
from forked import start, start_train, train
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from numpy.testing import assert_allclose
from PIL import Image
from tiny_scene import HEIGHT, TRAIN, WIDTH, color_of, pixel_rays, pose_of, write_scene
from training_runs import write_plan

from mmpi_ns.training import frames
from mmpi_ns.training.frames import PATIENCE, SHARE, FrameThread, FrameTurns
from mmpi_ns.viewer import CapturedPath, PathControls, fitting_fov


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


def test_the_path_goes_by_the_numbers_in_the_names_of_images():
    order, viewer, controls = [0, 9, 10, 1, 2, 3, 4, 5, 6, 7, 8], MagicMock(), PathControls()  # nerfstudio's
    dataset = viewer.pipeline.datamanager.train_dataset
    dataset.image_filenames = [f"{i + 1}.jpg" for i in order]
    dataset.cameras = Cameras(torch.tensor(street(11), dtype=torch.float32)[order], 100.0, 100.0, 50.0, 40.0, 100, 80)
    viewer.pipeline.model.progress.windows.plans[0].content_near = 1.0
    controls._slider = SimpleNamespace(value=0.0)
    controls._setup(viewer)
    assert_allclose(controls._path.positions[:, 0], -np.arange(11))


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


STEP = 0.1
"""Seconds of a training step by the clock of the tests below, which is not that of the machine."""


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(frames, "time", SimpleNamespace(monotonic=lambda: now.seconds))
    return now


@pytest.fixture
def window(clock, monkeypatch):
    """A window of a training, whose frames take ``window.takes`` seconds."""

    def render(self, _):
        clock.seconds += self.takes
        self.rendered += 1

    monkeypatch.setattr(RenderStateMachine, "_render_img", render)
    viewer = SimpleNamespace(
        update_step=lambda _: None, update_camera_poses=lambda: None, get_camera_state=lambda _: None
    )
    thread = FrameThread(viewer, None, FrameTurns(lambda: True), lambda _: None)
    thread.rendered, viewer.render_statemachines = 0, {0: thread}
    thread.turns.after_step(viewer, 0)
    return thread


def step(clock, window, wants):
    """A training step, after which the window wants a frame; whether it was rendered."""
    clock.seconds += STEP
    before = window.rendered
    while wants and window.idle.is_set():
        time.sleep(0.001)
    window.turns.after_step(window.viewer, 1)
    return window.rendered > before


@pytest.mark.parametrize("takes", [0.025, 0.15])
def test_frames_of_one_who_moves_take_their_share_of_a_training(clock, window, takes):
    window.state, window.takes, began = "low_move", takes, clock.seconds
    Thread(target=lambda: [window._render_img(None) for _ in range(10_000)], daemon=True).start()
    while clock.seconds < began + 60:
        step(clock, window, wants=True)
    assert 0.8 * SHARE < window.rendered * takes / (clock.seconds - began) < 0.08
    window.takes = 10.0  # once, as when something was compiled
    while not step(clock, window, wants=True):
        pass
    began, window.takes = clock.seconds, takes
    while not step(clock, window, wants=True):
        pass
    assert clock.seconds - began <= PATIENCE["coarse"] + STEP + takes + 1e-9


def test_one_who_stops_sees_a_sharp_frame_soon_and_later_ones_in_their_share(clock, window):
    window.state, window.takes, steps = "high", 0.7, 0
    for soon in (0, PATIENCE["sharp"]):  # again after the share is used up
        asks, began = Thread(target=window._render_img, args=[None], daemon=True), clock.seconds
        asks.start()
        while not step(clock, window, wants=True):
            pass
        asks.join()
        assert clock.seconds - began <= soon + STEP + window.takes + 1e-9
    while window.next_action is None:  # nobody has moved since
        steps += not step(clock, window, wants=False)
    assert window.next_action.action == "step" and steps * STEP >= 0.9 * window.takes / SHARE


def test_a_pose_that_waits_for_its_turn_gives_way_to_a_newer_one(window):
    window.state, window.next_action, window.interrupt_render_flag = "high", RenderAction("move", None), True
    with pytest.raises(IOChangeException):
        window._render_img(None)
    assert window.idle.is_set() and not window.interrupt_render_flag and not window.rendered


def test_frames_do_not_wait_for_a_paused_training(window):
    window.takes, window.turns = 0.7, FrameTurns(lambda: False)
    window.turns.after_step(window.viewer, 1)
    window._render_img(None)
    assert window.rendered


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


def until_it_resembles(tab, truth, wait=100):
    """Waits for a picture of more than 20 dB; while a new page replaces the old one, there is none."""
    end, psnr, refusal = time.monotonic() + wait, 0.0, None
    while psnr <= 20 and time.monotonic() < end:
        time.sleep(0.5)
        try:
            psnr = -10 * np.log10(np.square(picture(tab) - truth).mean())
        except TabError as error:
            refusal = error
    assert psnr > 20, (psnr, refusal, tab.messages)


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
def test_ns_viewer_opens_at_a_training_image_and_knows_the_way_back(options, tmp_path):
    trained = train(output=tmp_path, max_num_iterations=300, **options)
    assert trained.status == 0, trained.error[-3000:]
    config = next(tmp_path.glob("**/config.yml"))
    command = start("ns-viewer", "--load-config", config, "--viewer.websocket-host", "127.0.0.1")
    with page(command, tmp_path / "profile") as tab:
        until_it_resembles(tab, turned(0))
        until_it_resembles(tab, drag(tab, 12))
        drag(tab, 180)
        back = "[...document.querySelectorAll('button')].find(b => b.innerText == 'Back to the path')"
        tab.until(f"{back}?.checkVisibility() && {back}.click() === undefined", wait=100)
        until_it_resembles(tab, turned(0))
        tab.until(f"!{back}?.checkVisibility()", wait=100)


@in_browser
def test_ns_train_shows_a_training_image_and_goes_on_while_one_moves(options, tmp_path):
    command = start_train(output=tmp_path / "run", vis="viewer", max_num_iterations=100_000, **options)
    with page(command, tmp_path / "profile") as tab:
        until_it_resembles(tab, turned(0))
        until_it_resembles(tab, drag(tab, 12))
        before, end, places = step_of(tab), time.monotonic() + 100, cycle([150, 151])
        tab.mouse("mousePressed", 150, 250, button="left", clickCount=1, buttons=1)
        while step_of(tab) < before + 20 and time.monotonic() < end:
            tab.mouse("mouseMoved", next(places), 250, button="left", buttons=1)
            time.sleep(0.02)
        assert step_of(tab) >= before + 20
        assert command.process.is_alive()


def step_of(tab):
    return int(re.search(r"Step: (\d+)", tab.evaluate("document.body.innerText"))[1])
