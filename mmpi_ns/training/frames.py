"""Frames of nerfstudio's viewer between the steps of a training, in a share of its time.

nerfstudio's training stands still for as long as someone moves. Its viewer counts the time that a frame waits for a
step as rendering, and makes images small.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf
from threading import Event
from typing import Any

from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from viser import ClientHandle

SHARE = 0.05
"""Of a training's time for coarse frames, which one sees while one moves; as much for sharp ones."""
PATIENCE = {"coarse": 3.0, "sharp": 1.0}
"""Seconds that a frame waits at most for its share."""
TARGET, TARGET_IN_TRAINING = 10, 50
"""Coarse frames that could be rendered in a second, which gives their size (nerfstudio's: 30)."""


class FrameTurns:
    """Decides after each training step whether frames are rendered before the next one."""

    def __init__(self, is_training: Callable[[], bool]) -> None:
        self._is_training, self._has_begun = is_training, False
        self._due = {"coarse": 0.0, "sharp": 0.0}

    def are_given(self) -> bool:
        """Whether frames wait for their turn: not before the first step, nor while training is paused."""
        return self._has_begun and self._is_training()

    def after_step(self, viewer: Viewer, step: int) -> None:
        """Returns when the frames that are due have been rendered."""
        self._has_begun, viewer.step = True, step
        threads = [t for t in list(viewer.render_statemachines.values()) if isinstance(t, FrameThread)]
        for thread in sorted(threads, key=lambda t: t.asked):
            began, kind = time.monotonic(), "sharp" if thread.state == "high" else "coarse"
            is_due = began >= self._due[kind]
            if not thread.idle.is_set():
                if is_due or began >= thread.asked + PATIENCE[kind]:
                    thread.turn.set()
                    thread.idle.wait()
                    thread.turn.clear()  # one that was given up took none
                    paid = began if kind == "coarse" else max(began, self._due[kind])  # that patience lent, too
                    self._due[kind] = paid + (time.monotonic() - began) / SHARE
                    viewer.update_step(step)
            elif is_due and kind == "sharp":  # one who stands still sees the training's progress
                viewer.update_camera_poses()
                thread.action(RenderAction("step", viewer.get_camera_state(thread.client)))


class FrameThread(RenderStateMachine):
    """Renders the frames of a window, each in its turn, and tells ``note`` what it rendered."""

    def __init__(
        self, viewer: Viewer, client: ClientHandle, turns: FrameTurns | None, note: Callable[[dict[str, Any]], None]
    ) -> None:
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        self.turns, self.note, self.turn, self.idle, self.asked = turns, note, Event(), Event(), inf
        self.idle.set()

    def _render_img(self, camera_state: CameraState) -> Any:
        self.asked = min(self.asked, time.monotonic())
        self.idle.clear()
        self.target_fps = TARGET
        try:
            while self.turns is not None and self.turns.are_given():
                self.target_fps = TARGET_IN_TRAINING
                if self.turn.wait(0.05):
                    self.turn.clear()
                    break
                if not self.running or (self.next_action is not None and self.next_action.action == "move"):
                    self.interrupt_render_flag = False
                    raise IOChangeException  # for the newer pose
            self.asked = inf
            outputs = super()._render_img(camera_state)
        finally:
            self.idle.set()
        self.note(outputs)
        return outputs
