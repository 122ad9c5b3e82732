"""The model: plan -> field -> sampler -> compositing -> outputs."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import Model
from nerfstudio.utils.math import intersect_obb
from nerfstudio.viewer.viewer_elements import ViewerDropdown
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.data.datamanager import CAPTURE, Capture
from mmpi_ns.data.rays import image_rays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march import Capacity, MarchOptions
from mmpi_ns.placement.defaults import steps_for
from mmpi_ns.placement.split import find_balls, most_pixels, place_windows
from mmpi_ns.rendering.details import DETAILS_FOLDER, Details, details_of
from mmpi_ns.rendering.images import rays_per_chunk, render_in_chunks, render_windows, square_by_square
from mmpi_ns.rendering.metrics import ImageMetrics, pictures, psnr_and_ssim
from mmpi_ns.rendering.rendered import BACKGROUNDS, Exposures, background_of, bounded, render_outputs, render_rays
from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.sampler import march_options
from mmpi_ns.scene.plan import NO_PLAN
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.settings import MMPIModelConfig
from mmpi_ns.training.checkpoints import last_checkpoint
from mmpi_ns.training.losses import batch_losses, over_background
from mmpi_ns.training.memory import check_memory, texel_bytes
from mmpi_ns.training.phases import make_schedule
from mmpi_ns.training.reliability import assign_heads, blends_in
from mmpi_ns.training.run import Progress, TrainingRun, move_rays, views_of
from mmpi_ns.utils.errors import InputError, log
from mmpi_ns.utils.parallel import torch_apart
from mmpi_ns.utils.random_draws import Generators
from mmpi_ns.viewer import PathControls


class MMPIModel(Model):
    """K multi-plane images and a cube, merged by distance and blended by reliability."""

    config: MMPIModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        config = self.config
        self.capture: Capture | None = self.kwargs.get("metadata", {}).get(CAPTURE)
        """Data of the training images; None where the plan comes from a checkpoint."""
        capture, device = self.capture, self.kwargs.get("device", "cpu")
        views = None if capture is None else capture.views
        windows = self._plan()
        # A single head always trains alone.
        joint = config.schedule.training == "joint" or all(plan.num_heads == 1 for plan in windows.plans)
        if capture is not None:
            per_texel = texel_bytes(config.colour.feature_channels, two_phase=not joint)
            check_memory(windows, lambda window: views_of(window, views), per_texel, device)
        phases = replace(config.schedule, training="joint" if joint else "two-phase")
        count = len(windows)
        start = (False, False, 0.0)
        if capture is not None:
            seen = capture.observations
            start = (capture.has_depths, seen.looks_along_path, windows.texel_tangent * seen.focal)
        schedule = make_schedule(phases, max(1, config.total_steps), count, *start)
        self.progress = Progress(windows, schedule)
        self.field = self._new_field(views_of(windows.windows[0], views))
        budget = config.rendering.resident_gib * 2**30
        self.store = WindowStore(config.windows_folder, self._new_field, budget)
        self.exposures = Exposures(None if capture is None else capture.gains)
        self.details: Details | None = None
        self.metrics = ImageMetrics(config.lpips_net)
        self.draws = Generators(config.seed, device)
        self.capacity: Capacity | None = None
        """Capacity of a training batch on a GPU; None: as many samples as there are."""
        self.register_buffer("decay", torch.tensor(1.0), persistent=False)
        """``Schedule.decay`` of the step."""
        self.decay: Tensor
        self.show = ViewerDropdown("Show MPI", "all", ["all"], hint="One MPI alone, or all")
        self.path_controls = PathControls()
        self._take_plan()
        dispatch.choose(config.ops)
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device=device)
        if config.camera_optimizer.mode != "off" and count > 1:
            raise InputError(
                f"The capture is trained in {count} windows, one after the other, and poses are refined in one alone: "
                "refine them before (mmpi-prepare --refine-poses), or give --pipeline.model.placement.window-length 0."
            )
        scale_is_free = capture is not None and not len(capture.observations.seen_by)
        release, adjustments = config.schedule.release_weight, [*self.camera_optimizer.parameters()]
        self.run = TrainingRun(self.progress, self.field, self.store, views, release, adjustments, scale_is_free)
        self.register_load_state_dict_post_hook(type(self)._take_plan)

    def _plan(self) -> WindowedPlan:
        """Scene plan of the option, or of the placement rule for the observations of the training cameras."""
        config, placement, capture = self.config, self.config.placement, self.capture
        observations = None if capture is None else capture.observations
        given = None
        if config.plan_file is not None and (observations is not None or config.plan_file.is_file()):
            given = WindowedPlan.load(config.plan_file)
        if observations is not None and config.total_steps == 0:
            windows = find_balls(observations, placement.window_length) if given is None else given.windows
            config.total_steps = steps_for(most_pixels(observations, windows), config.size, config.rays_times)
        if given is not None:
            return given
        if capture is None or observations is None:
            folder = None if config.windows_folder is None else config.windows_folder.parent / "nerfstudio_models"
            if folder is not None and folder.is_dir():
                last_checkpoint(folder)  # nerfstudio looks for it only after making the model, and ends in a traceback
            return WindowedPlan.single(NO_PLAN)
        sized = replace(placement, max_texels=min(config.size, 1.0) * placement.max_texels)
        return place_windows(observations, sized, config.total_steps * capture.rays_per_step)

    def _new_field(self, views: TrainingViews | None = None) -> MMPIField:
        """A field with this run's settings, of the first window at the first resolution: to train, or to load into."""
        schedule = self.progress.schedule
        return MMPIField(
            self.progress.windows.plans[0],
            shares_depth=schedule.is_joint,
            learns_reliability=not schedule.is_joint,
            factor=schedule.texel_factor(0),
            views=views,
            **asdict(self.config.colour),
            cube_alpha=self.config.sampling.cube_alpha,
        )

    def _take_plan(self, _: Any = None) -> None:
        """Applies plan and schedule, also those of a loaded checkpoint."""
        self.field.shares_depth = self.progress.schedule.is_joint
        self.field.learns_reliability = not self.field.shares_depth
        self.show.set_options(["all", *self.progress.windows.names])

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        return self.run.parameters()

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # type: ignore[override]
        location = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION
        return [TrainingCallback([location], self.run.prepare_step, args=[attributes])]

    # Rendering: nothing is assigned to the model, so threads may render while another trains or saves -------------

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:  # type: ignore[override]
        """Outputs of an image's rays; ``RenderedRays`` for the losses of a training batch, of the window at hand."""
        if not self.training:
            return self.image_outputs(ray_bundle)
        progress, field, bundle, asked = self.progress, self.field, ray_bundle, len(ray_bundle)
        phase = progress.schedule.phase_at(progress.step).name
        move_rays(bundle, self.camera_optimizer)
        drawn = self.config.schedule.rays_per_mpi, self.draws, progress.step
        bundle, head_mask, choose = assign_heads(bounded(bundle, field.plan), field.plan, phase, *drawn)
        blends = blends_in(phase, field)
        forming = not progress.schedule.sharpened(progress.step)
        options = march_options(self.config.sampling, field.plan, forming, blends)._replace(capacity=self.capacity)
        rays = render_rays(bundle, field, options, head_mask, choose)
        return {"training": replace(rays, times=len(bundle) // asked)}

    def image_outputs(self, bundle: RayBundle, chunk: int | None = None) -> dict[str, Tensor]:
        """rgb, accumulation, depth, winning MPI and dropped mass [R, .] of rays, from the windows that they start in.
        ``chunk``: rays that a window renders at once; None: all."""
        windows, trained = self.progress.windows, self.progress.window
        chosen = windows.find(self.show.value)  # by the viewer

        def render(window: int, rays: Tensor | slice) -> dict[str, Tensor]:
            field = self.field if window == trained else self.store.load(window, self.device)
            return render_in_chunks(
                bundle[rays], chunk or len(bundle), self.device,
                lambda part: self.window_outputs(window, field, part, chosen),
            )  # fmt: skip

        if len(windows) == 1:
            return render(0, slice(None))
        there = windows.windows[: trained + 1]  # finished windows, and the one being trained
        only = chosen[0] if chosen is not None and chosen[0] <= trained else None
        return render_windows(bundle.origins, there, render, only, (trained, *self.store.in_memory))

    def window_outputs(
        self, window: int, field: MMPIField, bundle: RayBundle, chosen: tuple[int, int] | None = None
    ) -> dict[str, Tensor]:
        """``image_outputs`` of one window, by its number and field; winning MPIs are counted through all windows, a
        finer copy as its MPI. ``chosen``: the only (window, head) to render; None for all."""
        first_head = sum(p.num_heads for p in self.progress.windows.plans[:window])
        background = background_of(self.config.rendering.background, bundle.origins)
        bundle = bounded(bundle, field.plan)
        blends, head_mask = field.blends, None
        if chosen is not None:
            head = chosen[1] if chosen[0] == window else -1
            heads = field.planned_heads(torch.arange(field.plan.num_heads, device=self.device))
            head_mask = (heads == head).expand(len(bundle), -1)
            blends = False
        threshold = self.config.rendering.threshold
        outputs = render_outputs(bundle, field, blends=blends, threshold=threshold, head_mask=head_mask)
        behind = outputs.pop("transmittance") * background.to(outputs["rgb"])
        outputs["winning_mpi"] = field.planned_heads(outputs["winning_mpi"]) + first_head
        exposure = self.exposures.mean
        if exposure is None:
            return outputs | {"rgb": (outputs["rgb"] + behind).clamp(0, 1)}
        radiance = outputs["rgb"] + behind / exposure
        return outputs | {"rgb": (exposure * radiance).clamp(0, 1), "radiance": radiance}

    # Images ------------------------------------------------------------------------------------------------------

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Renders a camera's image, or the part inside a box. Raises InputError if it has no size."""
        width, height = int(camera.width), int(camera.height)
        if min(width, height) < 1:
            raise InputError(f"An image of {width} x {height} pixels shows nothing: give a smaller --downscale-factor.")
        bundle = image_rays(camera.to(self.device))  # nerfstudio's rays have NaN in the centre of a fisheye
        if obb_box is not None:
            ends = intersect_obb(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3), obb_box)
            bundle.nears, bundle.fars = (t.view(*bundle.shape, 1) for t in ends)
        return self.get_outputs_for_camera_ray_bundle(bundle)

    @torch.no_grad()
    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> dict[str, Tensor]:
        """Renders an image: window by window, in chunks of the configured size or of one that suits the device."""
        with torch_apart():
            height, width = camera_ray_bundle.shape
            order = square_by_square(height, width, camera_ray_bundle.origins.device)
            outputs = self.image_outputs(camera_ray_bundle.flatten()[order], self.chunk_size)
            outputs = {
                k: torch.empty_like(v).index_copy_(0, order, v).view(height, width, -1) for k, v in outputs.items()
            }
            if self.details is None or self.progress.windows.find(self.show.value) is not None:
                return outputs
            nearest = self.config.rendering.nearest_images
            return self.details.added(outputs, camera_ray_bundle, nearest, self.exposures.mean)

    def update_to_step(self, step: int) -> None:
        """Loads the details of a checkpoint's step, before the checkpoint."""
        folder = self.config.windows_folder
        if self.config.rendering.nearest_images and folder is not None and self.capture is None:
            self.details = details_of(folder.parent / DETAILS_FOLDER, step)
            if self.details is None:
                log("This checkpoint has no details of the training images (they are made after the last step): images "
                    "show the field alone.")  # fmt: skip

    @property
    def chunk_size(self) -> int:
        """Rays of an image that are rendered at once."""
        if self.config.eval_num_rays_per_chunk:
            return self.config.eval_num_rays_per_chunk
        most = max(plan.largest.samples_per_ray for plan in self.progress.windows.plans)
        field, kept = self.field, MarchOptions(self.config.rendering.threshold).most_kept(most)
        one_pass = field.shading == "ray" and dispatch.form_of("render_fused", field.features) != "reference"
        return rays_per_chunk(most, self.device, kept if one_pass else None)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colours without their background, and accumulation (ns-render's output "rgba")."""
        accumulation = outputs["accumulation"]
        background = background_of(self.config.rendering.background, accumulation)
        colors = outputs[output_name] - (1 - accumulation) * background
        return torch.cat([(colors / accumulation.clamp(min=1e-6)).clamp(0, 1), accumulation], -1)

    # Losses and metrics ------------------------------------------------------------------------------------------

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        rays, image, step = outputs["training"], batch["image"].to(self.device), self.progress.step
        g, decay = self.draws.of(step, "background"), self.progress.schedule.decay(step)
        if not self.draws.recording:
            self.decay.fill_(decay)
        held = self.decay if dispatch.on_gpu(self.decay) else decay
        total, errors = batch_losses(rays, self.field, image, self.config.loss, g, step, held)
        if rays.lookup is not None and self.progress.schedule.watches(step):
            self.field.note_use(rays.lookup, rays.samples, rays.composite.weights, errors)
        self.camera_optimizer.get_loss_dict(total)
        # A batch of rays that meet nothing trainable would have no gradient; this adds 0 with a gradient.
        total["rgb_loss"] = total["rgb_loss"] + self.device_indicator_param.sum()
        return total

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Any]:
        samples = outputs["training"].samples
        counts = {
            "intersected_samples": samples.num_intersected.mean(dtype=torch.float32),
            "kept_samples": samples.starts[-1] / len(samples.dropped_mass),
            "dropped_mass": samples.dropped_mass.mean(),
        }
        self.camera_optimizer.get_metrics_dict(counts)
        return counts

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of an image, "field_..." of the field without details, the mean "dropped_mass" and, with true
        distances, the relative error of rendered ones, median and share above a tenth; and pictures of it."""
        observed, true = self.observed(batch).to(outputs["rgb"].device), batch.get("distance")
        values = self.metrics(outputs["rgb"], observed)
        if "field_rgb" in outputs:
            values |= {f"field_{k}": value for k, value in psnr_and_ssim(outputs["field_rgb"], observed).items()}
        values["dropped_mass"] = float(outputs["dropped_mass"].mean())
        if true is not None and bool((true > 0).any()):
            predicted, true = outputs["depth"], true.to(outputs["depth"])
            error = (predicted[true > 0] / true[true > 0] - 1).abs()
            values |= {"depth_error": float(error.median()), "depth_outliers": float((error > 0.1).float().mean())}
        return values, pictures(observed, outputs, len(self.progress.windows.names))

    def observed(self, batch: dict[str, Tensor]) -> Tensor:
        """The pixels of a batch, over the background where they are transparent."""
        return over_background(batch["image"].to(self.device), BACKGROUNDS[self.config.rendering.background])
