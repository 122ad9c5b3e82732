"""State of a training run, and its changes between two steps: window, resolution, bricks, pixels, frozen parameters.

Also the refined poses, with which the rays of a batch move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from torch import Tensor, nn
from torch.nn import Parameter

from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.data.rays import TrainingRays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.placement.defaults import RAYS, steps_for
from mmpi_ns.placement.split import cameras_of, most_pixels
from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.scene.windows import Window, WindowedPlan, to_bytes, to_text
from mmpi_ns.training.initial import start_from_depths
from mmpi_ns.training.phases import Schedule
from mmpi_ns.training.reliability import TRAINS, prepare_parameters
from mmpi_ns.training.storage import prepare_storage


@torch.no_grad()
def keep_frame(
    corrections: Float[Tensor, "M 6"], centers: Float[Tensor, "M 3"], distance: float, scale_is_free: bool
) -> None:
    """Removes from pose corrections, in place, the gauge: the motion of the whole capture that changes no training
    image.

    The scene would follow a rigid motion of all cameras, but test images keep their poses. Cameras that each rotate in
    place by the same angle are no rigid motion: that changes images, and is kept. The motion is fitted by least
    squares; the remaining corrections give the same images, to second order in the corrections.

    Args:
        corrections: shift in scene units and rotation vector of each camera, about world axes (nerfstudio's SO3xR3).
        centers: the cameras' positions before the corrections.
        distance: of the content, scene units; weights rotations by the shift of the content that they cause.
        scale_is_free: no depth measurement fixes the scale of the capture, so a change of scale is removed as well.
    """
    shifts, turns = corrections.double().split(3, -1)
    places = centers.to(shifts) + shifts
    places = places - places.mean(0)
    eye = torch.eye(3).to(places).expand(len(places), 3, 3)
    shift = torch.cat([eye, torch.linalg.cross(eye, places[:, None].expand(-1, 3, 3)), places[:, None]], 1)
    turn = torch.cat([torch.zeros_like(eye), eye, torch.zeros_like(places)[:, None]], 1)
    free = 7 if scale_is_free else 6
    motions = torch.cat([shift, turn], -1)[:, :free]  # of each camera, by each free motion
    weight = motions.new_tensor([1.0] * 3 + [max(distance, 1e-6)] * 3)
    system = (motions * weight).transpose(1, 2).reshape(-1, free)
    share = torch.linalg.pinv(system.mT @ system, hermitian=True) @ (system.mT @ (corrections * weight).flatten())
    shift, turn = torch.einsum("k,mkc->mc", share, motions).split(3, -1)
    # exp(-turn) exp(turns), by Baker, Campbell and Hausdorff.
    corrections -= torch.cat([shift, turn + torch.linalg.cross(turn, turns) / 2], -1).to(corrections)


def move_rays(bundle: RayBundle, poses: CameraOptimizer) -> None:
    """Moves a training batch's rays with their cameras, in place.

    Rays of new views and keypoint rays follow their camera but do not move it: their depths come from the original
    poses and would pull the camera back to them.
    """
    if poses.config.mode == "off":
        return
    poses.apply_to_raybundle(bundle)
    assert isinstance(bundle, TrainingRays) and bundle.through_pixel is not None
    moves_camera = bundle.through_pixel
    bundle.origins = torch.where(moves_camera, bundle.origins, bundle.origins.detach())
    bundle.directions = torch.where(moves_camera, bundle.directions, bundle.directions.detach())


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

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Plan and schedule of a run come from its checkpoint, not from config and capture."""
        for name in ("windows_bytes", "schedule_bytes"):
            stored = state_dict.get(prefix + name)
            if stored is not None:  # nerfstudio loads the pipeline's own, empty state in a second pass
                setattr(self, name, torch.empty_like(stored, device=self.window_number.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self.windows = WindowedPlan.from_json(to_text(self.windows_bytes))
        self.schedule = Schedule.from_json(to_text(self.schedule_bytes))
        self.window = int(self.window_number)


def views_of(window: Window, views: TrainingViews | None) -> TrainingViews | None:
    """Training images of a window; the same object where they are all."""
    if views is None or math.isinf(window.radius):
        return views
    chosen = torch.from_numpy(cameras_of(window, views.origins.numpy()))
    return TrainingViews(views.origins[chosen], views.inward[chosen])


@dataclass(eq=False)
class TrainingRun:
    """Field, optimised parameters and window store of a run, changed from one step to the next."""

    progress: Progress
    field: MMPIField
    """Field of the window being trained."""
    store: WindowStore
    """Finished windows."""
    views: TrainingViews | None
    """The training images; None: every texel is stored."""
    release_weight: float
    """Weight below which bricks are released."""
    poses: list[Parameter]
    """Corrections of the cameras' poses, if they are refined."""
    scale_is_free: bool
    """Whether no depth measurement fixes the scale of the capture."""
    _drawn_from: int | None = None

    def parameters(self) -> dict[str, list[Parameter]]:
        """Parameters by kind (``reliability.TRAINS``); each kind has its own learning rate."""
        field = self.field
        groups = {
            "density": [field.density],
            "features": [field.features],
            "colour": [field.networks.weights],
            "reliability": [field.reliability],
        }
        return groups | ({"camera_opt": self.poses} if self.poses else {})

    def prepare_step(self, attributes: TrainingCallbackAttributes | None, step: int) -> None:
        """Applies the schedule of a step that is about to run: window, resolution, storage and frozen parameters.
        ``attributes``: the trainer's optimisers and data manager; None without a trainer."""
        progress, field, schedule = self.progress, self.field, self.progress.schedule
        progress.step = step
        optimizers = attributes.optimizers.optimizers if attributes and attributes.optimizers else {}
        groups, window = self.parameters(), schedule.window_at(step)
        if window != progress.window:  # the trainer has saved the previous one
            self.store.forget(window)
            field.views = views_of(progress.windows.windows[window], self.views)
            field.build(progress.windows.plans[window], schedule.texel_factor(step))
            field.networks.resize(1 if field.shading == "ray" else field.full_plan.num_heads)
            progress.window_number.fill_(window)
            progress.window = window
            for kind, params in groups.items():
                if kind in optimizers:
                    optimizers[kind].state.pop(params[0], None)
        prepare_storage(field, schedule, step, self.release_weight, optimizers)
        if attributes is not None and attributes.pipeline is not None:
            manager = attributes.pipeline.datamanager
            assert isinstance(manager, MMPIDataManager), "training needs MMPIDataManager"
            manager.share_of_rays = 1.0 if schedule.sharpened(step) else schedule.growing_share
            if self._drawn_from != window:
                centers, windows = manager.observations.centers, progress.windows.windows
                cameras = cameras_of(windows[window], centers) if len(windows) > 1 else None
                manager.use_cameras(cameras)
                rays = RAYS * steps_for(most_pixels(manager.observations, windows))
                first = window * schedule.window_steps
                manager.jitter_from = first + rays / manager.config.train_num_rays_per_batch
                self._drawn_from = window
                if step == window * schedule.window_steps and manager.sources is not None:
                    start_from_depths(field, manager.sources, manager.config.seed)
        phase = schedule.phase_at(step).name
        prepare_parameters(field, groups, phase)
        if "camera_opt" in TRAINS[phase] and self.poses and self.views is not None:
            keep_frame(self.poses[0], self.views.origins, field.plan.content_near, self.scale_is_free)
