"""Initial camera of nerfstudio's viewer, and controls along the captured path.

nerfstudio's viewer opens beside a scene, looking at it. MPIs represent a scene from within, near the captured path. The
element uses two hooks of the viewer: ``install`` creates controls, ``_setup`` receives the viewer.
"""

from __future__ import annotations

import time
from threading import Thread
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from torch import Tensor, tensor
from viser import CameraHandle, ClientHandle, ViserServer

from mmpi_ns.training.frames import FrameThread
from mmpi_ns.utils.files import natural_key

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.viewer.viewer import Viewer

START = 1 / 6
"""Place on the path where a window opens: the middle of its first third."""
LITTLE = 1 / 3
"""Opaque share of an image below which a button back to the path appears."""
CAMERAS_PER_SECOND = 4.0
"""Maximum speed of Play, which moves by the distance of the first content in a second."""
AHEAD = 0.01
"""Distance to the point that a drag rotates about, in distances of the first content: the camera stays in place."""
NEAREST = 0.02
"""Scene units; the viewer comes no nearer than half of it to that point."""
PACE = 2.0
"""Distances of the first content that the wheel walks while the page would divide the distance ahead by e."""
FRAMES_PER_SECOND = 10.0
"""Poses a second that Play sends."""


class View(NamedTuple):
    """Position, viewing direction and up of a window. World axes; scene units, unit directions."""

    position: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]


class CapturedPath:
    """Smooth poses through the training cameras, in the order of their images."""

    def __init__(self, camera_to_worlds: Float[np.ndarray, "num_cameras 3 4"]) -> None:
        poses = np.asarray(camera_to_worlds, np.float64)
        self.positions, self.directions, self.ups = poses[:, :, 3], -poses[:, :, 2], poses[:, :, 1]

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def start(self) -> int:
        """Camera where a window opens."""
        return int(START * (len(self) - 1) + 0.5)  # as the exported page

    def at(self, place: float) -> View:
        """The view at a place in [0, num_cameras - 1]: at whole numbers that of a camera (Catmull-Rom between them)."""
        i = min(int(place), max(len(self) - 2, 0))
        t, around = place - i, np.clip(np.arange(i - 1, i + 3), 0, len(self) - 1)
        weights = 0.5 * np.array(
            [-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, -(t**2) + t**3]
        )
        direction = weights @ self.directions[around]
        direction /= np.linalg.norm(direction)
        own, up = self.ups[round(place)], self.ups.mean(0)  # a level horizon, also where one camera was tilted
        if up @ own < 0.7 * np.linalg.norm(up) or np.linalg.norm(up) < 1e-3:  # cameras that look straight down
            up = own
        return View(weights @ self.positions[around], direction, up / np.linalg.norm(up))

    def nearest(self, position: Float[np.ndarray, "3"]) -> int:
        """The camera nearest to a place."""
        return int(np.linalg.norm(self.positions - position, axis=-1).argmin())


def fitting_fov(half_width: float, half_height: float, aspect: float) -> float:
    """Vertical field of view, radians, of the largest window of an aspect inside an image.

    ``half_width``, ``half_height``: tangents of half the image's angles.
    """
    return 2 * float(np.arctan(min(half_height, half_width / aspect)))


class PathControls(ViewerElement[float], ViewerControl):
    """Initial camera of every window, and the controls slider, Play and Nearest camera."""

    def __init__(self) -> None:
        super().__init__("Captured path", cb_hook=lambda _: None)
        self._path: CapturedPath | None = None
        self._walker: ClientHandle | None = None

    def install(self, viser_server: ViserServer) -> None:
        """Creates the controls; the viewer calls it inside the model's folder."""
        gui = viser_server.gui
        self.gui_handle = self._slider = gui.add_slider("Captured path", 0.0, 1.0, 0.001, START)
        self._play = gui.add_checkbox("Play", False)
        nearest = gui.add_button("Nearest camera")
        self._slider.on_update(self._walk)
        self._play.on_update(self._start_playing)
        nearest.on_click(self._go_to_nearest)

    def _setup(self, viewer: Viewer) -> None:
        """Receives the viewer, once all controls exist."""
        super()._setup(viewer)
        dataset: Any = viewer.pipeline.datamanager.train_dataset
        names = [str(name) for name in dataset.image_filenames]  # nerfstudio has 10 before 9
        cameras: Cameras = dataset.cameras[tensor(sorted(range(len(names)), key=lambda i: natural_key(names[i])))]
        path = CapturedPath(cameras.camera_to_worlds.cpu().numpy())
        i = path.start
        self._half_width = float(cameras.cx[i] / cameras.fx[i])
        self._half_height = float(cameras.cy[i] / cameras.fy[i])
        self._near: float = viewer.pipeline.model.progress.windows.plans[0].content_near  # type: ignore[union-attr]
        self._ahead = max(AHEAD * self._near, NEAREST)
        # Whoever stands where a camera stood has its frustum, with a small copy of its image, before the eye.
        frusta = viewer.viser_server.scene.add_frame("/cameras", show_axes=False, visible=False)
        viewer.toggle_cameravis_button()
        viewer.show_images.on_click(lambda _: setattr(frusta, "visible", True))
        self._path, self._slider.value = path, i / max(len(path) - 1, 1)
        viewer.viser_server.on_client_connect(self._open)

    def _open(self, client: ClientHandle) -> None:
        assert self._path is not None
        viewer, aspect, walked = self.viewer, 0.0, 0.0
        model: Any = viewer.get_model()
        # Above the tabs, where nothing is scrolled away.
        line = client.gui.add_markdown("Little was captured from here:", order=-2, visible=False)
        back = client.gui.add_button("Back to the path", order=-1, visible=False)
        back.on_click(self._go_to_nearest)

        def offer(outputs: dict[str, Tensor]) -> None:
            is_whole = model.show.value == "all" and not viewer.control_panel.crop_viewport
            little = is_whole and float((outputs["accumulation"] > 0.5).float().mean()) < LITTLE
            line.visible = back.visible = little

        def follow(camera: CameraHandle) -> None:
            nonlocal aspect, walked
            if 0 < camera.aspect != aspect:  # a page tells its size only when it is laid out
                aspect = camera.aspect
                camera.fov = fitting_fov(self._half_width, self._half_height, aspect)
            ahead = (camera.look_at - camera.position) / VISER_NERFSTUDIO_SCALE_RATIO
            nearer = float(np.log(self._ahead / np.linalg.norm(ahead)))  # by the wheel
            # Messages sent before a window was moved do not move it again.
            if 0.01 < abs(nearer) < 0.7 and time.monotonic() - walked > 0.1:
                walked, direction = time.monotonic(), ahead / np.linalg.norm(ahead)
                position = camera.position / VISER_NERFSTUDIO_SCALE_RATIO + PACE * self._near * nearer * direction
                self._show(camera, View(position, direction, camera.up_direction))

        threads, number = viewer.render_statemachines, client.client_id
        threads[number].running, threads[number].interrupt_render_flag = False, True  # it renders nothing any more
        threads[number] = FrameThread(viewer, client, getattr(viewer.trainer, "turns", None), offer)
        threads[number].start()
        follow(client.camera)
        client.camera.on_update(follow)
        self._show(client.camera, self._path.at(self._path.start))

    def _show(self, camera: CameraHandle, view: View) -> None:
        with camera.client.atomic():
            camera.up_direction = view.up
            camera.position = view.position * VISER_NERFSTUDIO_SCALE_RATIO
            camera.look_at = (view.position + self._ahead * view.direction) * VISER_NERFSTUDIO_SCALE_RATIO

    def _walk(self, event: Any) -> None:
        client = event.client or self._walker
        if self._path is not None and client is not None:
            self._show(client.camera, self._path.at(self._slider.value * (len(self._path) - 1)))

    def _go_to_nearest(self, event: Any) -> None:
        if self._path is not None and event.client is not None:
            i = self._path.nearest(event.client.camera.position / VISER_NERFSTUDIO_SCALE_RATIO)
            self._show(event.client.camera, self._path.at(i))
            self._slider.value = i / max(len(self._path) - 1, 1)  # Play goes on from there

    def _start_playing(self, event: Any) -> None:
        if self._play.value and event.client is not None:
            self._walker = event.client
            Thread(target=self._keep_playing, args=[event.client], daemon=True).start()

    def _keep_playing(self, client: ClientHandle) -> None:
        """Moves along the path until Play is off, the window is closed, or the path ends."""
        assert self._path is not None
        length = float(np.linalg.norm(np.diff(self._path.positions, axis=0), axis=-1).sum())
        pace = min(self._near / max(length, 1e-6), CAMERAS_PER_SECOND / max(len(self._path) - 1, 1))
        if self._slider.value >= 1:
            self._slider.value = 0.0
        while self._play.value and client.client_id in self.viser_server.get_clients() and self._slider.value < 1:
            self._slider.value = min(self._slider.value + pace / FRAMES_PER_SECOND, 1.0)
            time.sleep(1 / FRAMES_PER_SECOND)
        self._walker = None
        self._play.value = False
