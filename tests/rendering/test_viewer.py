"""The captured path in nerfstudio's viewer, in a real browser: while a run trains and after it."""

import base64
import io
import json
import time
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest
from browser import CHROMIUM, browser
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.viewer.viewer import Viewer
from numpy.testing import assert_allclose
from PIL import Image
from tiny_scene import color_of, pixel_rays, write_scene
from training_runs import in_capture_frame, ready, trainer_config, write_plan
from viser.transforms import SO3

from mmpi_ns.viewer import CapturedPath, fitting_fov

START = 1  # of the six training images


def test_the_path_passes_through_every_camera_straight_and_level():
    poses = np.zeros((13, 3, 4))
    poses[:, 1, 0] = poses[:, 2, 1] = poses[:, 0, 2] = 1  # they look along -x, up is z
    poses[:, 0, 3] = -np.arange(13)
    poses[0, :, :2] = poses[0, :, :2] @ [[0.98, -0.17], [0.17, 0.98]]  # rolled by ten degrees
    path = CapturedPath(poses)
    for place in (0, 1, 4.25, 12):
        assert_allclose(path.at(place).position, [-place, 0, 0], atol=1e-12)
        assert_allclose(path.at(place).direction, [-1, 0, 0], atol=1e-12)
    assert path.start == 2 and path.nearest(np.array([-6.6, 3.0, 0.0])) == 7 and np.degrees(np.arccos(path.up[2])) < 1
    assert_allclose(CapturedPath(poses[:1]).at(0).position, 0, atol=1e-12)
    for aspect in (0.5, 2.0, 4.0):  # a window lies inside the image
        assert_allclose(np.tan(fitting_fov(1.0, 0.5, aspect) / 2), min(0.5, 1 / aspect))


class Window:
    """A browser's window on a viewer."""

    def __init__(self, tab, viewer):
        self.tab, self.data = tab, viewer.pipeline.datamanager
        tab.send("Page.navigate", url=f"http://127.0.0.1:{viewer.viser_server.get_port()}")
        wait_until(viewer.viser_server.get_clients)
        self.camera = max(viewer.viser_server.get_clients().items())[1].camera

    def click(self, kind, text):
        found = f"[...document.querySelectorAll('{kind}')].find(e => e.textContent == '{text}')"
        self.tab.until(f"({found}?.click(), !!{found})")  # the page hears of it after the server

    def training_image(self, i):
        """What the window's field of view holds of a training image."""
        camera, tangent = self.data.train_dataset.cameras[i], np.tan(self.camera.fov / 2)
        center = np.array([float(camera.cx), float(camera.cy)])
        half = tangent * np.array([self.camera.aspect * float(camera.fx), float(camera.fy)])
        half = np.minimum(half, center)  # rounding
        image = Image.fromarray((self.data.train_dataset[i]["image"].numpy() * 255).astype(np.uint8))
        return image.resize(np.rint(2 * half).astype(int), box=(*(center - half), *(center + half)))

    def truth(self):
        """What there is to see from where the window stands, at the training images' resolution."""
        width, height = self.training_image(START).size
        rotation = (SO3(self.camera.wxyz) @ SO3.from_x_radians(np.pi)).as_matrix()
        directions = pixel_rays(width, height, height / 2 / np.tan(self.camera.fov / 2)) @ rotation.T
        origins = np.broadcast_to(self.camera.position / 10, directions.shape)
        colors = color_of(*in_capture_frame(self.data, origins, directions))
        return Image.fromarray((colors.reshape(height, width, 3) * 255).astype(np.uint8))

    def shows(self, image):
        """Whether what is drawn resembles an image, at the image's size."""
        box = self.tab.until("JSON.stringify(document.querySelector('canvas[data-engine]')?.getBoundingClientRect())")
        clip = {name: json.loads(box)[name] for name in ("x", "y", "width", "height")} | {"scale": 1}
        data = self.tab.send("Page.captureScreenshot", format="png", clip=clip)["data"]
        found = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
        corner = (0, found.height - 80, 80, found.height)  # where viser draws its axes
        found.paste(image.resize(found.size).crop(corner), corner)
        difference = np.asarray(found.resize(image.size, Image.Resampling.BOX), float) - np.asarray(image, float)
        psnr = -10 * np.log10(((difference / 255) ** 2).mean())
        print(f"PSNR {psnr:.1f} dB")
        return psnr > 20


def wait_until(true):
    end = time.monotonic() + 180
    while not true():
        assert time.monotonic() < end
        time.sleep(0.2)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the viewer in (apt-get install chromium)")
def test_windows_open_at_a_training_image_look_round_in_place_and_find_back(tmp_path, monkeypatch):
    data = write_scene(tmp_path / "data")
    config = trainer_config(data, write_plan(data, tmp_path / "plan.json"), tmp_path / "out", 100_000, training="joint")
    config.steps_per_save, config.vis = 100_000, "viewer+tensorboard"  # training ends when its page was seen
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.pipeline.model.schedule.growth_shares = ()
    config.save_config()
    trainer, seen, viewers = ready(config), [], []

    def look_while_it_trains():
        try:
            window = Window(tab, trainer.viewer_state)
            wait_until(lambda: window.shows(window.training_image(START)))
            seen.append(trainer.step)
            tab.send("Page.navigate", url="about:blank")
        finally:
            trainer.stop_training = True

    def look(_):
        window, controls = Window(tab, viewers[0]), viewers[0].pipeline.model.path_controls
        wait_until(lambda: window.shows(window.training_image(START)))
        position, ahead = window.camera.position, window.camera.look_at - window.camera.position
        for kind, x in (("mousePressed", 150), ("mouseMoved", 158), ("mouseReleased", 158)):
            tab.mouse(kind, x, 250, button="left", buttons=1, clickCount=1)
        wait_until(lambda: not np.allclose(window.camera.position, position))
        wait_until(lambda: window.shows(window.truth()))
        assert np.linalg.norm(window.camera.position - position) < 0.1  # a thirtieth of the way between two cameras
        window.camera.look_at = position - ahead  # where nothing was captured
        wait_until(lambda: controls._line.visible)
        window.click("button", "Back to the path")
        wait_until(lambda: window.shows(window.training_image(START)) and not controls._line.visible)
        window.click("label", "Play")
        wait_until(lambda: controls._slider.value == 1 and not controls._play.value)
        wait_until(lambda: window.shows(window.training_image(5)))
        raise KeyboardInterrupt

    with browser(tmp_path / "profile", size=(640, 360)) as tab:
        Thread(target=look_while_it_trains).start()
        trainer.train()
        assert seen
        monkeypatch.setattr(run_viewer, "ViewerState", lambda *a, **k: viewers.append(Viewer(*a, **k)) or viewers[0])
        monkeypatch.setattr(run_viewer, "time", SimpleNamespace(sleep=look))  # in its endless loop
        with pytest.raises(KeyboardInterrupt):
            run_viewer.RunViewer(config.get_base_dir() / "config.yml").main()
        for viewer in (trainer.viewer_state, *viewers):
            for machine in [*viewer.render_statemachines.values()]:
                machine.running = False
                machine.join()  # a thread that renders when Python ends aborts it
            viewer.viser_server.stop()
