"""State changes of a training run between two steps: window, resolution, pixels, and trainable parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from numpy.typing import NDArray
from torch.nn import Parameter

from mmpi_ns.capture.datamanager import MMPIDataManager
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.placement.split import cameras_in
from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.scene.windows import Window
from mmpi_ns.training.phases import TRAINS
from mmpi_ns.training.progress import Progress
from mmpi_ns.training.refined_poses import keep_frame
from mmpi_ns.training.storage import prepare_storage


def parameters_by_kind(field: MMPIField) -> dict[str, list[Parameter]]:
    """What has a learning rate of its own (``phases.ParameterKind``)."""
    return {
        "density": [field.density],
        "features": [field.features],
        "colour": [field.networks.weights],
        "reliability": [field.reliability],
    }


def cameras_of(window: Window, centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """Those of the cameras that ask a window; all where there is one window alone."""
    return cameras_in(centers, np.asarray(window.center), window.radius + window.margin)


def views_of(window: Window, views: TrainingViews | None) -> TrainingViews | None:
    """The training images that ask a window."""
    return None if views is None else views.some(cameras_of(window, views.origins.numpy()))


class TrainingRun:
    """What is trained, and its changes from one step to the next.

    Args:
        progress: windows, schedule and step.
        field: of the window that is trained, one after the other.
        store: where finished windows go.
        views: the training images; None: every texel is stored.
        release_weight: bricks in which no sample has this weight are released.
        poses: corrections of the cameras' poses, if they are refined.
        scale_is_free: no known depth fixes the scale of the capture.
    """

    def __init__(
        self,
        progress: Progress,
        field: MMPIField,
        store: WindowStore,
        views: TrainingViews | None,
        release_weight: float,
        poses: list[Parameter] | None = None,
        scale_is_free: bool = False,
    ) -> None:
        self.progress, self.field, self.store = progress, field, store
        self.views, self.release_weight = views, release_weight
        self._poses, self._scale_is_free = poses or [], scale_is_free
        self.shared = False
        """Whether other processes train some of the windows."""
        self._drawn_from: int | None = None

    def parameters(self) -> dict[str, list[Parameter]]:
        """What trains, by what has a learning rate of its own."""
        return parameters_by_kind(self.field) | ({"camera_opt": self._poses} if self._poses else {})

    def cameras_of(self, centers: NDArray[np.float64], window: int) -> NDArray[np.int64]:
        """Those of the cameras that ask a window."""
        return cameras_of(self.progress.windows.windows[window], centers)

    def views_of(self, window: int) -> TrainingViews | None:
        """The training images that ask a window."""
        return views_of(self.progress.windows.windows[window], self.views)

    def windows_there(self) -> list[int]:
        """Windows that can be rendered: trained in order, those after the present one are not there yet; where other
        processes train some, those that they have finished."""
        count, trained = len(self.progress.windows), self.progress.window
        if self.shared:
            return [w for w in range(count) if w == trained or self.store.path(w).is_file()]
        return [*range(trained + 1)]

    def prepare_step(self, attributes: TrainingCallbackAttributes | None, step: int) -> None:
        """Applies the schedule of a step: window, resolution, storage and frozen parameters.

        Args:
            attributes: the trainer's optimisers and data manager; None without a trainer.
            step: about to run.
        """
        progress, field = self.progress, self.field
        progress.step = step
        field.forget_baked()
        optimizers = attributes.optimizers.optimizers if attributes and attributes.optimizers else {}
        groups = self.parameters()
        if progress.schedule.window_at(step) != progress.window:
            self._begin_window(progress.schedule.window_at(step), progress.schedule.texel_factor(step))
            for kind, params in groups.items():
                if kind in optimizers:
                    optimizers[kind].reset_moments(params[0])
        prepare_storage(field, progress.schedule, step, self.release_weight, optimizers)
        if attributes is not None and attributes.pipeline is not None:
            self._prepare_draws(attributes.pipeline.datamanager)
        phase = progress.phase.name
        field.learns_cover = phase == "individual"
        for kind, params in groups.items():
            params[0].requires_grad_(kind in TRAINS[phase])
        if "camera_opt" in TRAINS[phase] and self._poses and self.views is not None:
            keep_frame(self._poses[0], self.views.origins, field.plan.content_near, self._scale_is_free)

    def _begin_window(self, window: int, factor: float) -> None:
        """Starts another window with new tables and networks; the trainer has saved the previous one."""
        field = self.field
        self.store.forget(window)
        field.views = self.views_of(window)
        field.build(self.progress.windows.plans[window], factor)
        field.renew_networks()
        self.progress.begin(window)

    def _prepare_draws(self, manager: Any) -> None:
        """Makes the data manager draw the rays of the current step, from the cameras of the current window."""
        assert isinstance(manager, MMPIDataManager), "training needs MMPIDataManager"
        progress = self.progress
        manager.rays_share = progress.schedule.rays_share(progress.step)
        if self._drawn_from != progress.window:
            several = len(progress.windows) > 1
            manager.use_cameras(self.cameras_of(manager.observations.centers, progress.window) if several else None)
            self._drawn_from = progress.window
