"""The captured path in nerfstudio's viewer: where a window opens, and how one walks along the path.

nerfstudio's viewer opens beside a scene and looks at it. MPIs show a scene from within, near the captured path. The
element uses the viewer's two hooks: ``install``, where controls are made, and ``_setup``, where the viewer is given.
The training cameras are hidden at first: from where one of them stands, its own picture covers the view.
"""

from __future__ import annotations

import time
from threading import Thread
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from viser import CameraHandle, ClientHandle, ViserServer

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.viewer.viewer import Viewer

START = 1 / 6
"""Place on the path where a window opens: the middle of its first third."""
LITTLE = 1 / 3
"""Share of an image that is opaque, below which the way back to the path is offered."""
CAMERAS_PER_SECOND = 4.0
"""Pace of Play."""
FRAMES_PER_SECOND = 10.0
"""Poses that Play sends."""
NEAREST_TARGET = 0.11 / VISER_NERFSTUDIO_SCALE_RATIO
"""From the eye to the nearest point that a drag may turn about, scene units: viser keeps 0.1 of its own."""


class View(NamedTuple):
    """Where a window stands and looks. World axes, scene units."""

    position: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]


class CapturedPath:
    """Smooth poses through the training cameras, in the order of their images."""

    def __init__(self, camera_to_worlds: Float[np.ndarray, "num_cameras 3 4"]) -> None:
        poses = np.asarray(camera_to_worlds, np.float64)
        self.positions, self.directions = poses[:, :, 3], -poses[:, :, 2]
        up = poses[:, :, 1].mean(0)
        self.up = up / np.linalg.norm(up)
        """The cameras' mean up: a horizon that is level, also where a single camera was tilted."""

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def start(self) -> int:
        """Camera where a window opens."""
        return round(START * (len(self) - 1))

    def at(self, place: float) -> View:
        """The view at a place in [0, num_cameras - 1]: at whole numbers that of a camera (Catmull-Rom between them)."""
        i = min(int(place), max(len(self) - 2, 0))
        t, around = place - i, np.clip(np.arange(i - 1, i + 3), 0, len(self) - 1)
        weights = 0.5 * np.array(
            [-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, -(t**2) + t**3]
        )
        direction = weights @ self.directions[around]
        return View(weights @ self.positions[around], direction / np.linalg.norm(direction))

    def nearest(self, position: Float[np.ndarray, "3"]) -> int:
        """The camera nearest to a place."""
        return int(np.linalg.norm(self.positions - position, axis=-1).argmin())


def fitting_fov(half_width: float, half_height: float, aspect: float) -> float:
    """Vertical field of view, radians, of the largest window of an aspect inside an image.

    ``half_width``, ``half_height``: tangents of half the image's angles.
    """
    return 2 * float(np.arctan(min(half_height, half_width / aspect)))


class PathControls(ViewerElement[float], ViewerControl):
    """Opens windows on the captured path; slider, Play and Nearest camera beside the model's other controls."""

    def __init__(self) -> None:
        super().__init__("Captured path", cb_hook=lambda _: None)
        self._path: CapturedPath | None = None
        self._walker: ClientHandle | None = None
        self._aspects: dict[int, float] = {}
        """Width / height that each client's field of view fits."""

    def install(self, viser_server: ViserServer) -> None:
        """Makes the controls; the viewer calls it inside the model's folder."""
        gui = viser_server.gui
        self.gui_handle = self._slider = gui.add_slider("Captured path", 0.0, 1.0, 0.001, START)
        self._play = gui.add_checkbox("Play", False)
        self._nearest = gui.add_button("Nearest camera")
        self._line = gui.add_markdown("Little was captured from here: back to the path", visible=False)
        self._back = gui.add_button("Back to the path", visible=False)
        self._slider.on_update(self._walk)
        self._play.on_update(self._start_playing)
        for button in (self._nearest, self._back):
            button.on_click(self._go_to_nearest)

    def remove(self) -> None:
        """Takes the controls away."""
        for handle in (self._slider, self._play, self._nearest, self._line, self._back):
            handle.remove()

    def _setup(self, viewer: Viewer) -> None:
        """Is given the viewer, when all controls are made."""
        super()._setup(viewer)
        cameras: Cameras = viewer.pipeline.datamanager.train_dataset.cameras  # type: ignore[union-attr]
        self._path = CapturedPath(cameras.camera_to_worlds.cpu().numpy())
        self._slider.value = round(self._path.start / max(len(self._path) - 1, 1), 3)
        camera = cameras[self._path.start]
        self._half_width = float(min(camera.cx, camera.width - camera.cx) / camera.fx)
        self._half_height = float(min(camera.cy, camera.height - camera.cy) / camera.fy)
        content_near = viewer.pipeline.model.progress.windows.plans[0].content_near  # type: ignore[union-attr]
        self._ahead = max(0.01 * content_near, NEAREST_TARGET)
        """From the eye to the point that a drag turns about, scene units: small, so that one looks round in place."""
        viewer.viser_server.on_client_connect(self._open)
        Thread(target=self._hide_cameras, daemon=True).start()

    def _hide_cameras(self) -> None:
        """As "Hide Train Cams" does, when all are there: the viewer draws them after it has called its hooks."""
        while not hasattr(self.viewer, "train_state"):
            time.sleep(0.05)
        self.viewer.set_camera_visibility(False)
        self.viewer.toggle_cameravis_button()

    def note(self, opaque: float) -> None:
        """Is told the opaque share of an image that was shown."""
        if self._path is not None:
            for handle in (self._line, self._back):
                if handle.visible != (opaque < LITTLE):
                    handle.visible = opaque < LITTLE

    def _open(self, client: ClientHandle) -> None:
        assert self._path is not None
        client.camera.on_update(self._fit)
        self._fit(client.camera)
        self._show(client.camera, self._path.at(self._path.start))

    def _fit(self, camera: CameraHandle) -> None:
        """Fits the field of view to a window of a new shape; pages change their shape while they load."""
        if self._aspects.get(camera.client.client_id) != camera.aspect:
            self._aspects[camera.client.client_id] = camera.aspect
            camera.fov = fitting_fov(self._half_width, self._half_height, camera.aspect)

    def _show(self, camera: CameraHandle, view: View) -> None:
        assert self._path is not None
        with camera.client.atomic():
            camera.up_direction = self._path.up
            camera.position = view.position * VISER_NERFSTUDIO_SCALE_RATIO
            camera.look_at = (view.position + self._ahead * view.direction) * VISER_NERFSTUDIO_SCALE_RATIO

    def _walk(self, event: Any) -> None:
        client = event.client or self._walker
        if self._path is not None and client is not None:
            self._show(client.camera, self._path.at(self._slider.value * (len(self._path) - 1)))

    def _go_to_nearest(self, event: Any) -> None:
        if self._path is not None and event.client is not None:
            camera = event.client.camera
            self._show(camera, self._path.at(self._path.nearest(camera.position / VISER_NERFSTUDIO_SCALE_RATIO)))

    def _start_playing(self, event: Any) -> None:
        if self._play.value and event.client is not None:
            self._walker = event.client
            Thread(target=self._keep_playing, args=[event.client], daemon=True).start()

    def _keep_playing(self, client: ClientHandle) -> None:
        """Walks on until Play is off, the window is closed, or the path ends."""
        assert self._path is not None
        step = CAMERAS_PER_SECOND / FRAMES_PER_SECOND / max(len(self._path) - 1, 1)
        place = self._slider.value if self._slider.value < 1 else 0.0
        while self._play.value and client.client_id in self.viser_server.get_clients() and place < 1:
            place = min(place + step, 1.0)
            self._slider.value = place
            time.sleep(1 / FRAMES_PER_SECOND)
        self._walker = None
        self._play.value = False
