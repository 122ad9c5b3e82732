"""The model: plan -> field -> sampler -> compositing -> losses -> outputs."""

from __future__ import annotations

from dataclasses import replace
from threading import current_thread, main_thread
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.model_components import renderers
from nerfstudio.models.base_model import Model
from nerfstudio.viewer.viewer_elements import ViewerDropdown
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.capture.datamanager import OBSERVATIONS, RAYS_PER_STEP, TRAINING_VIEWS, MMPIDataManager
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import Lookup, individual_rays, metadata_of
from mmpi_ns.ops import native
from mmpi_ns.ops.composite import composite_weights, median_inverse_distance, winning_heads
from mmpi_ns.ops.compositing import BlendForm, Composite, blended_optical_depth
from mmpi_ns.placement.split import cameras_in, place_windows
from mmpi_ns.rendering.chunks import rays_at_once
from mmpi_ns.rendering.metrics import ImageMetrics, pictures
from mmpi_ns.rendering.sampler import MergeReport, MMPISampler
from mmpi_ns.rendering.window_store import WindowStore, mix_windows
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.scene.windows import WindowedPlan, window_shares
from mmpi_ns.settings import MMPIModelConfig
from mmpi_ns.training import losses
from mmpi_ns.training.exposure import Exposure, departure
from mmpi_ns.training.loss_terms import TrainingRays, is_pixel_ray, over_background
from mmpi_ns.training.phases import TRAINS, Schedule
from mmpi_ns.utils.files import to_bytes, to_text
from mmpi_ns.utils.random_draws import generator

FAIR_SHARE = 0.1
"""Until the field has sharpened, samples of more than this part of an equal weight are kept."""
BACKGROUNDS = {"black": 0.0, "gray": 0.5, "white": 1.0}


class MMPIModel(Model):
    """K multi-plane images and a cube, merged by distance and blended by reliability."""

    config: MMPIModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        native.choose(self.config.ops)
        self.windows = self._initial_plan()
        self.window = 0
        budget, half = self.config.resident_gib * 2**30, self.config.half_windows
        self.store = WindowStore(self.config.windows_folder, budget, half)
        # One head has nothing to blend with, so it trains in one go.
        joint = self.config.training == "joint" or all(plan.num_heads == 1 for plan in self.windows.plans)
        self.schedule = self.config.schedule("joint" if joint else "two-phase", len(self.windows))
        self.field = self._new_field(self.views_of(0))
        self.exposure = Exposure(self.num_train_data) if self.config.exposure else None
        self.sampler = MMPISampler()
        self.metrics = ImageMetrics(self.config.lpips_net)
        self.register_buffer("schedule_bytes", to_bytes(self.schedule.to_json()))
        self.register_buffer("windows_bytes", to_bytes(self.windows.to_json()))
        self.window_number: Tensor
        self.register_buffer("window_number", torch.tensor(0))
        self.step = 0
        self._fed: int | None = None
        self.show = ViewerDropdown("Show MPI", "all", ["all", *self.windows.names], hint="One MPI alone, or all")
        self.register_load_state_dict_post_hook(lambda *_: self._after_loading())

    def _new_field(self, views: TrainingViews | None = None) -> MMPIField:
        """A field of this run's settings, with the smallest of plans: to build on or to load into."""
        shares_depth = self.schedule.phase_at(0).name == "joint"
        return MMPIField(
            self.windows.plans[self.window],
            shares_depth=shares_depth,
            factor=self.schedule.texel_factor(0),
            views=views,
            **self.config.field_settings(),
        )

    def views_of(self, window: int) -> TrainingViews | None:
        """The training images that ask a window."""
        views: TrainingViews | None = self.kwargs.get("metadata", {}).get(TRAINING_VIEWS)
        if views is None or len(self.windows) == 1:
            return views
        return views.some(self.cameras_of(views.origins.numpy(), window))

    def cameras_of(self, centers: NDArray[np.float64], number: int) -> NDArray[np.int64]:
        """Those of the cameras that ask a window."""
        window = self.windows.windows[number]
        return cameras_in(centers, np.asarray(window.center), window.radius + window.margin)

    def _initial_plan(self) -> WindowedPlan:
        if self.config.plan_file is not None:
            return WindowedPlan.load(self.config.plan_file)
        metadata = self.kwargs.get("metadata", {})
        observations = metadata.get(OBSERVATIONS)
        if observations is None:
            raise ValueError("The data manager gave no observations: use MMPIDataManager, or name a plan file.")
        steps = self.config.total_steps  # 1 unless a trainer has set it: then the plan comes from a checkpoint
        rays = steps * metadata[RAYS_PER_STEP] if steps > 1 and RAYS_PER_STEP in metadata else None
        return place_windows(observations, self.config.placement, rays)

    # State -------------------------------------------------------------------------------------------------------

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """The schedule of a run is the checkpoint's, and so is the plan, whatever config and capture say now."""
        stored = state_dict.get(prefix + "schedule_bytes")
        if stored is not None:
            self.schedule = Schedule.from_json(to_text(stored))
            self.schedule_bytes = stored.clone().to(self.device)
            self.field.shares_depth = self.schedule.phase_at(0).name == "joint"
            # A checkpoint from before there were windows holds a field of one plan alone.
            plans = state_dict.setdefault(prefix + "windows_bytes", state_dict.get(prefix + "field.plan_bytes"))
            state_dict.setdefault(prefix + "window_number", torch.tensor(0))
            if plans is not None:
                self.windows = WindowedPlan.from_json(to_text(plans))
                self.windows_bytes = plans.clone().to(self.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def _after_loading(self) -> None:
        self.window = int(self.window_number)
        self.show.set_options(["all", *self.windows.names])

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = {
            "density": [self.field.density],
            "features": [self.field.features],
            "colour": [self.field.networks.weights],
            "reliability": [self.field.reliability],
        }
        return groups if self.exposure is None else groups | {"exposure": [self.exposure.settings]}

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # type: ignore[override]
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.prepare_step, args=[attributes])
        ]

    def prepare_step(self, attributes: TrainingCallbackAttributes | None, step: int) -> None:
        """Brings resolution, freezing and what is stored to what the schedule says of this step."""
        self.step = step
        self.field.forget_shares()
        phase = self.schedule.phase_at(step)
        optimizers = attributes.optimizers.optimizers if attributes and attributes.optimizers else {}
        if self.schedule.window_at(step) != self.window:
            self._enter_window(self.schedule.window_at(step), self.schedule.texel_factor(step))
            for kind, params in self.get_param_groups().items():
                if kind in optimizers:
                    optimizers[kind].reset_moments(params[0])
        self.field.prepare_storage(self.schedule, step, self.config.release_weight, optimizers)
        if len(self.windows) > 1 and attributes is not None and self._fed != self.window:
            self._feed_window(attributes)
        self.field.learns_cover = phase.name in ("individual", "joint")
        for kind, params in self.get_param_groups().items():
            for p in params:
                p.requires_grad_(kind in TRAINS[phase.name])

    def _enter_window(self, window: int, factor: float) -> None:
        """Begins another window with fresh tables and networks; the trainer has put the one before away."""
        self.window = window
        self.window_number.fill_(window)
        self.store.forget(window)
        plan = self.windows.plans[window]
        self.field.views = self.views_of(window)
        self.field.build(plan, factor)
        self.field.renew_networks()
        if self.exposure is not None:
            self.exposure.reset()

    def _feed_window(self, attributes: TrainingCallbackAttributes) -> None:
        """Has the data manager draw from the cameras that ask this window."""
        manager = attributes.pipeline.datamanager if attributes.pipeline else None
        assert isinstance(manager, MMPIDataManager), "windows need MMPIDataManager"
        cameras = self.cameras_of(manager.observations.centers, self.window)
        manager.use_cameras(cameras)
        if self.exposure is not None:
            self.exposure.images = torch.from_numpy(cameras).to(self.device)
        self._fed = self.window

    @property
    def blends(self) -> bool:
        """Whether reliability takes part in rendering now; pictures taken during training are always blended."""
        if self.config.training == "joint" or self.field.plan.num_heads == 1:
            return False
        return not self.training or self.schedule.blends_at(self.step)

    # Rendering ---------------------------------------------------------------------------------------------------

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:  # type: ignore[override]
        """Renders rays: rgb, accumulation, depth and winning MPI, and in training what the losses need.

        In training the window at hand answers; later every ray asks the windows that it starts in.
        """
        if self.training or len(self.windows) == 1:
            return self._render(ray_bundle)
        # Windows are trained in order: those after the present one are not there yet.
        shares = window_shares(ray_bundle.origins, self.windows.windows[: self.window + 1])
        shown = self._shown_window()
        if shown is not None and shown <= self.window:
            shares = torch.zeros_like(shares).index_fill_(1, torch.tensor([shown], device=shares.device), 1.0)
        parts = {}
        for w in (shares > 0).any(0).nonzero()[:, 0].tolist():
            rays = (shares[:, w] > 0).nonzero()[:, 0]
            parts[w] = rays, self._render_window(w, ray_bundle[rays])
        return mix_windows(shares, parts)

    def _render_window(self, window: int, bundle: RayBundle) -> dict[str, Tensor]:
        """What one window shows; winning MPIs are counted through all windows."""
        trained = self.window, self.field
        try:
            if window != self.window:
                self.field = self.store.load(window, self._new_field, self.device)
                self.window = window
            outputs = self._render(bundle)
            outputs["winning_mpi"] = outputs["winning_mpi"] + self.windows.first_head(window)
        finally:
            self.window, self.field = trained
        return outputs

    def _render(self, ray_bundle: RayBundle) -> dict[str, Any]:
        bundle = self._bounded(ray_bundle)
        if self.training and self.schedule.phase_at(self.step).name == "individual":
            g = generator(self.config.seed, self.step, "assignment", self.device)
            bundle, head_mask, choose = individual_rays(bundle, self.field.plan, self.config.rays_per_mpi, g)
        else:
            head_mask, choose = self._shown(len(bundle)), None
        blend_form = self.config.blend_form if self.blends and head_mask is None else None
        bakes = self.config.render_shares == "baked" and blend_form is not None and not torch.is_grad_enabled()
        samples, report = self.sampler(
            bundle,
            field=self.field,
            threshold=self._threshold(),
            fair_share=FAIR_SHARE if self._sharpening else float("inf"),
            head_mask=head_mask,
            choose=choose,
            blend_form=blend_form,
            shares=self.field.baked_shares() if bakes else None,
        )
        tau, lookup = self._optical_depth(samples, blend_form)
        valid = metadata_of(samples)["valid"][..., 0]
        composite = composite_weights(tau, valid, metadata_of(samples)["skipped_before"][..., 0], report.skipped_total)
        if self.training and lookup and self.schedule.watches(self.step):
            self.field.note_use(lookup, composite.weights, report.live)
        # Keypoint rays are supervised in depth alone: no colours for them.
        wanted = is_pixel_ray(bundle) if self.training else None
        colors = self.field.render_colors(samples, lookup, composite, wanted)
        outputs = self._outputs(composite, colors.rgb, samples, report)
        if self.training:
            outputs["training"] = TrainingRays(bundle, samples, composite, colors, report, lookup)  # type: ignore
        return outputs

    @property
    def _sharpening(self) -> bool:
        """Whether surfaces are still forming, so that samples of little weight must learn too."""
        return self.training and not self.schedule.sharpened(self.step)

    def _threshold(self) -> float:
        """Weight below which samples are dropped; at first low enough for the cube, which starts nearly empty."""
        if not self.training:
            return self.config.render_threshold
        low = 0.1 * self.config.cube_alpha if self._sharpening and self.field.cube is not None else float("inf")
        return min(self.config.train_threshold, low)

    def _bounded(self, bundle: RayBundle) -> RayBundle:
        """Nears and fars: the plan's start of rays, and no end, unless a crop set tighter ones."""
        near = torch.full_like(bundle.origins[:, :1], self.field.plan.ray_near)
        bundle.nears = near if bundle.nears is None else torch.maximum(bundle.nears, near)
        bundle.fars = torch.full_like(near, torch.inf) if bundle.fars is None else bundle.fars
        return bundle

    def _shown(self, num_rays: int) -> Bool[Tensor, "R H"] | None:
        """The viewer's choice of one MPI, as a head mask."""
        names = self.windows.names
        if self.training or self.show.value not in names:
            return None
        number = names.index(self.show.value) - self.windows.first_head(self.window)
        return (torch.arange(self.field.plan.num_heads, device=self.device) == number).expand(num_rays, -1)

    def _shown_window(self) -> int | None:
        """The window of the viewer's choice of one MPI."""
        names = self.windows.names
        if self.show.value not in names:
            return None
        number = names.index(self.show.value)
        return max(w for w in range(len(self.windows)) if self.windows.first_head(w) <= number)

    def _optical_depth(self, samples: RaySamples, form: BlendForm | None) -> tuple[Tensor, Lookup | None]:
        """(Blended) optical depths, with gradients where they are wanted; else the sampler's own, without a lookup."""
        if not torch.is_grad_enabled():
            return metadata_of(samples)["tau"][..., 0], None
        tau, lookup = self.field.get_density(samples)
        tau = tau[..., 0]
        if form is not None and lookup.index.numel():
            tau = self._blend(tau, samples, lookup, form)
        return tau, lookup

    def _blend(self, tau: Tensor, samples: RaySamples, lookup: Lookup, form: BlendForm) -> Tensor:
        share, rest = self.field.sample_shares(samples, lookup)
        flat = blended_optical_depth(tau.reshape(-1)[lookup.index], share, rest, form)
        return tau.new_zeros(tau.numel()).index_put((lookup.index,), flat).view(tau.shape)

    def _outputs(
        self, composite: Composite, rgb: Tensor, samples: RaySamples, report: MergeReport
    ) -> dict[str, Tensor]:
        outputs = {
            "rgb": rgb + composite.transmittance * self._background(rgb) if not self.training else rgb,
            "accumulation": composite.accumulation,
            "depth": self._depth(composite, samples),
        }
        if not self.training:
            heads = metadata_of(samples)["heads"][..., 0]
            outputs["rgb"] = outputs["rgb"].clamp(0, 1)
            outputs["winning_mpi"] = winning_heads(composite.weights, heads, self.field.plan.num_heads)
            outputs["dropped_mass"] = report.dropped_mass
        return outputs

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Renders a camera's image, or what of it lies in a box.

        Raises:
            ValueError: the box has no size. Not so in the viewer, whose render thread an error would end while
                somebody types a size: there it shows the background.
        """
        if obb_box is not None and not bool((obb_box.S > 0).all()) and current_thread() is main_thread():
            raise ValueError(
                f"The crop box has no size (its sides are {[round(float(s), 6) for s in obb_box.S]}): give crop_scale "
                "three positive lengths, or leave the crop out."
            )
        return super().get_outputs_for_camera(camera, obb_box)

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> dict[str, Tensor]:
        """Renders an image, as many rays at once as asked for or as suit the device."""
        asked = self.config.eval_num_rays_per_chunk
        self.config.eval_num_rays_per_chunk = self.rays_at_once
        try:
            return super().get_outputs_for_camera_ray_bundle(camera_ray_bundle)
        finally:
            self.config.eval_num_rays_per_chunk = asked

    @property
    def rays_at_once(self) -> int:
        """Rays of an image that are rendered together."""
        most = max(plan.samples_per_ray for plan in self.windows.plans)
        return self.config.eval_num_rays_per_chunk or rays_at_once(most, self.device)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colours without their background, and how opaque each pixel is (ns-render's output "rgba")."""
        accumulation = outputs["accumulation"]
        colors = outputs[output_name] - (1 - accumulation) * self._background(accumulation)
        return torch.cat([(colors / accumulation.clamp(min=1e-6)).clamp(0, 1), accumulation], -1)

    def _background(self, like: Tensor) -> Tensor:
        """Colour behind everything: what the viewer or a crop asks for, else the config's."""
        asked = renderers.BACKGROUND_COLOR_OVERRIDE
        return like.new_full((3,), BACKGROUNDS[self.config.background]) if asked is None else asked.to(like)

    @torch.no_grad()
    def _depth(self, composite: Composite, samples: RaySamples) -> Float[Tensor, "R 1"]:
        """Euclidean distance at half the gathered mass; infinity is shown as ten times the farthest finite plane."""
        inverse_t, valid = metadata_of(samples)["inverse_t"][..., 0], metadata_of(samples)["valid"][..., 0]
        farthest = 10 * max(m.farthest for m in self.field.plan.mpis)
        return 1 / median_inverse_distance(composite.weights, inverse_t, valid).clamp(min=1 / farthest)

    # Losses and metrics ------------------------------------------------------------------------------------------

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        image = batch["image"].to(self.device)
        if "training" not in outputs:  # an evaluation batch during training
            observed = over_background(image, torch.full_like(image[:, :3], BACKGROUNDS[self.config.background]))
            return {"rgb_loss": losses.photometric(outputs["rgb"], observed)}
        rays: TrainingRays = outputs["training"]
        if self.exposure is not None:
            assert rays.bundle.camera_indices is not None
            exposed = self.exposure(rays.colors, rays.composite.accumulation, rays.bundle.camera_indices[:, 0])
            rays = replace(rays, colors=exposed)
        g = generator(self.config.seed, self.step, "background", self.device)
        total = rays.losses(self.field, image, self.config.loss, g, self.step)
        if self.exposure is not None:
            total["exposure"] = self.config.loss.exposure * departure(*self.exposure.gains_and_biases())
        # A batch that meets nothing that trains would have no gradient at all; this adds 0 with one.
        total["rgb_loss"] = total["rgb_loss"] + self.device_indicator_param.sum()
        return total

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Any]:
        if "training" in outputs:
            report = outputs["training"].report
            return {
                "live_samples": report.live.float().mean(),
                "kept_samples": metadata_of(outputs["training"].samples)["valid"].float().sum() / len(report.live),
                "dropped_mass": report.dropped_mass.mean(),
            }
        image = batch["image"].to(self.device)
        observed = over_background(image, torch.full_like(image[:, :3], BACKGROUNDS[self.config.background]))
        return {"psnr": -10 * torch.log10(losses.photometric(outputs["rgb"], observed))}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        image = batch["image"].to(outputs["rgb"].device)
        observed = over_background(image, torch.full_like(image[..., :3], BACKGROUNDS[self.config.background]))
        values = self.metrics(outputs["rgb"], observed)
        values["dropped_mass"] = float(outputs["dropped_mass"].mean())
        return values, pictures(observed, outputs, len(self.windows.names))
