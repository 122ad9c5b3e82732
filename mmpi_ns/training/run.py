"""State of a training run, and its changes between two steps: window, resolution, bricks, pixels, what trains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from torch import Tensor, nn
from torch.nn import Parameter

from mmpi_ns.capture.datamanager import MMPIDataManager
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.placement.split import cameras_of
from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.training.batch_rays import keep_frame
from mmpi_ns.training.initial import start_from_depths
from mmpi_ns.training.phases import TRAINS, Phase, Schedule
from mmpi_ns.training.storage import prepare_storage
from mmpi_ns.utils.files import to_bytes, to_text


class Progress(nn.Module):
    """Windows, schedule, step, and the window being trained. All but the step are stored in checkpoints."""

    def __init__(self, windows: WindowedPlan, schedule: Schedule) -> None:
        super().__init__()
        self.windows, self.schedule = windows, schedule
        self.step = 0
        self.window = 0
        """The window being trained; earlier ones are finished, later ones do not exist yet."""
        self.windows_bytes: Tensor
        self.schedule_bytes: Tensor
        self.window_number: Tensor
        self.register_buffer("windows_bytes", to_bytes(windows.to_json()))
        self.register_buffer("schedule_bytes", to_bytes(schedule.to_json()))
        self.register_buffer("window_number", torch.tensor(0))

    @property
    def phase(self) -> Phase:
        return self.schedule.phase_at(self.step)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Plan and schedule of a run come from its checkpoint, whatever config and capture say now."""
        for name in ("windows_bytes", "schedule_bytes"):
            stored = state_dict.get(prefix + name)
            if stored is not None:  # nerfstudio loads the pipeline's own, empty state in a second pass
                setattr(self, name, torch.empty_like(stored, device=self.window_number.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self.windows = WindowedPlan.from_json(to_text(self.windows_bytes))
        self.schedule = Schedule.from_json(to_text(self.schedule_bytes))
        self.window = int(self.window_number)


def views_of(window: Window, views: TrainingViews | None) -> TrainingViews | None:
    """Training images whose rays the window renders."""
    return None if views is None else views.some(cameras_of(window, views.origins.numpy()))


@dataclass(eq=False)
class TrainingRun:
    """Field, optimised parameters and window store of a run, changed from one step to the next."""

    progress: Progress
    field: MMPIField
    """Of the window that is trained, one after the other."""
    store: WindowStore
    """Finished windows."""
    views: TrainingViews | None
    """The training images; None: every texel is stored."""
    release_weight: float
    """Bricks in which no sample has this weight are released."""
    poses: list[Parameter]
    """Corrections of the cameras' poses, if they are refined."""
    scale_is_free: bool
    """No depth measurement fixes the scale of the capture."""
    shared: bool = False
    """Whether other processes train some of the windows."""
    _drawn_from: int | None = None

    def parameters(self) -> dict[str, list[Parameter]]:
        """Parameters by kind (``phases.ParameterKind``); each kind has its own learning rate."""
        field = self.field
        groups = {
            "density": [field.density],
            "features": [field.features],
            "colour": [field.networks.weights],
            "reliability": [field.reliability],
        }
        return groups | ({"camera_opt": self.poses} if self.poses else {})

    def prepare_step(self, attributes: TrainingCallbackAttributes | None, step: int) -> None:
        """Applies the schedule of a step: window, resolution, storage and frozen parameters.

        Args:
            attributes: the trainer's optimisers and data manager; None without a trainer.
            step: about to run.
        """
        progress, field, schedule = self.progress, self.field, self.progress.schedule
        progress.step = step
        field.forget_baked()
        optimizers = attributes.optimizers.optimizers if attributes and attributes.optimizers else {}
        groups, window = self.parameters(), schedule.window_at(step)
        if window != progress.window:  # the trainer has saved the previous one
            self.store.forget(window)
            field.views = views_of(progress.windows.windows[window], self.views)
            field.build(progress.windows.plans[window], schedule.texel_factor(step))
            field.renew_networks()
            progress.window_number.fill_(window)
            progress.window = window
            for kind, params in groups.items():
                if kind in optimizers:
                    optimizers[kind].reset_moments(params[0])
        prepare_storage(field, schedule, step, self.release_weight, optimizers)
        if attributes is not None and attributes.pipeline is not None:
            manager = attributes.pipeline.datamanager
            assert isinstance(manager, MMPIDataManager), "training needs MMPIDataManager"
            if self._drawn_from != window:
                centers, windows = manager.observations.centers, progress.windows.windows
                manager.use_cameras(cameras_of(windows[window], centers) if len(windows) > 1 else None)
                self._drawn_from = window
                if step == window * schedule.window_steps and manager.sources is not None:
                    start_from_depths(field, manager.sources, manager.config.seed)
        phase = progress.phase.name
        field.learns_cover = phase == "individual"
        for kind, params in groups.items():
            params[0].requires_grad_(kind in TRAINS[phase])
        if "camera_opt" in TRAINS[phase] and self.poses and self.views is not None:
            keep_frame(self.poses[0], self.views.origins, field.plan.content_near, self.scale_is_free)
