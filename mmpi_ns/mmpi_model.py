"""The model: plan -> field -> sampler -> compositing -> losses -> outputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components import renderers
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.viewer.viewer_elements import ViewerDropdown
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns import losses
from mmpi_ns.compositing import (
    BlendForm,
    Composite,
    blended_optical_depth,
    composite_weights,
    median_inverse_distance,
    render_colors,
)
from mmpi_ns.metrics import ImageMetrics, head_palette
from mmpi_ns.mmpi_datamanager import OBSERVATIONS, RAYS_PER_STEP
from mmpi_ns.mmpi_field import MMPIField
from mmpi_ns.mmpi_losses import LossWeights, TrainingRays, is_pixel_ray, over_background
from mmpi_ns.mmpi_sampler import MergeReport, MMPISampler
from mmpi_ns.mmpi_samples import Lookup, metadata_of
from mmpi_ns.ops import native
from mmpi_ns.phases import TRAINS, Schedule, Training, make_schedule
from mmpi_ns.placement.plan import ScenePlan
from mmpi_ns.placement.rule import PlacementConfig, place
from mmpi_ns.random_draws import generator

FAIR_SHARE = 0.1
"""Until the field has sharpened, samples of more than this part of an equal weight are kept."""
BACKGROUNDS = {"black": 0.0, "gray": 0.5, "white": 1.0}


@dataclass
class MMPIModelConfig(ModelConfig):
    """Settings of the model."""

    _target: type = field(default_factory=lambda: MMPIModel)
    enable_collider: bool = False
    """Must stay off: a finite far would drop the plane at infinity."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """Where the MPIs stand and how fine they are."""
    plan_file: Path | None = None
    """A scene plan (JSON) to use instead of the placement rule."""
    training: Training = "joint"
    """Each MPI alone, then reliability (two-phase), or all together without reliability (joint)."""
    total_steps: int = 1
    """Set by the trainer from --max-num-iterations; the phases are shares of it."""
    blend_share: float = 0.1
    """Share of the steps in which only reliability trains."""
    finetune_share: float = 0.3
    """Share of the steps in which everything trains together at the end."""
    finetune_rate: float = 0.3
    """Learning rates at the start of the fine-tune relative to those of the first phase."""
    decay_decades: float = 1.5
    """Decades that learning rates fall over a phase."""
    growth_shares: tuple[float, ...] = (1 / 15, 2 / 15, 3 / 15, 4 / 15)
    """When the texels of a plane double, as shares of the first phase."""
    rays_per_mpi: Literal["split", "all"] = "split"
    """Individual phase: the MPIs share a batch's rays, or each renders all of them (K times the work a step)."""
    blend_form: BlendForm = "paper"
    """How reliability enters: P alpha (paper) or 1 - (1 - alpha)^P (opacity)."""
    shared_colour: bool = False
    """One colour network for all MPIs instead of one each."""
    feature_channels: int = 9
    """Colour features of a texel."""
    hidden_width: int = 64
    """Width of the colour networks."""
    position_frequencies: int = 2
    """Octaves of the positional encoding of NDC positions."""
    direction_frequencies: int = 2
    """Octaves of the positional encoding of directions."""
    samples_per_voxel: float = 1.0
    """Samples per voxel side along a ray through the cube."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample: 1e-2 for a small room to 1e-4."""
    train_threshold: float = 3e-3
    """Samples of less weight get no gradient (while resolution grows: nor more than a tenth of an equal share)."""
    ops: native.Route = "auto"
    """Inner loops on a CPU: compiled at first use (native), plain torch, or compiled where a C++ compiler is found."""
    render_threshold: float = 3e-3
    """Samples of less weight are not coloured when rendering; the dropped mass is reported."""
    background: Literal["black", "gray", "white"] = "gray"
    """Behind everything, when rendering. Training uses random colours where the MPIs explain the whole ray."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    lpips_net: Literal["vgg", "alex", "none"] = "vgg"
    """Network of the LPIPS metric (the paper: VGG); left out where its weights (0.5 GB for VGG) cannot be had."""
    seed: int = 0
    """Seed of the model's own random draws."""


class MMPIModel(Model):
    """K multi-plane images and a cube, merged by distance and blended by reliability."""

    config: MMPIModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        native.choose(self.config.ops)
        plan = self._initial_plan()
        # One head has nothing to blend with, so it trains in one go.
        joint = self.config.training == "joint" or plan.num_heads == 1
        self.schedule = self._make_schedule("joint" if joint else "two-phase")
        self.field = MMPIField(
            plan,
            feature_channels=self.config.feature_channels,
            hidden_width=self.config.hidden_width,
            position_frequencies=self.config.position_frequencies,
            direction_frequencies=self.config.direction_frequencies,
            shared_colour=self.config.shared_colour,
            shares_depth=joint,
            samples_per_voxel=self.config.samples_per_voxel,
            cube_alpha=self.config.cube_alpha,
        )
        self.field.build(plan, self.schedule.texel_factor(0))
        self.sampler = MMPISampler()
        self.metrics = ImageMetrics(self.config.lpips_net)
        self.register_buffer("schedule_bytes", _to_bytes(self.schedule.to_json()))
        self.step = 0
        self.show = ViewerDropdown("Show MPI", "all", ["all", *plan.names], hint="One MPI alone, or all blended")
        self.register_load_state_dict_post_hook(lambda *_: self.show.set_options(["all", *self.field.full_plan.names]))

    def _initial_plan(self) -> ScenePlan:
        if self.config.plan_file is not None:
            return ScenePlan.load(self.config.plan_file)
        metadata = self.kwargs.get("metadata", {})
        observations = metadata.get(OBSERVATIONS)
        if observations is None:
            raise ValueError("The data manager gave no observations: use MMPIDataManager, or name a plan file.")
        steps = self.config.total_steps  # 1 unless a trainer has set it: then the plan comes from a checkpoint
        rays = steps * metadata[RAYS_PER_STEP] if steps > 1 and RAYS_PER_STEP in metadata else None
        return place(observations, self.config.placement, rays)

    def _make_schedule(self, training: Training) -> Schedule:
        c = self.config
        return make_schedule(
            training,
            max(1, c.total_steps),
            blend_share=c.blend_share,
            finetune_share=c.finetune_share,
            growth_shares=c.growth_shares,
            decay_decades=c.decay_decades,
            finetune_rate=c.finetune_rate,
        )

    # State -------------------------------------------------------------------------------------------------------

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """The schedule of a run is the checkpoint's, and so is the plan, whatever config and capture say now."""
        stored = state_dict.get(prefix + "schedule_bytes")
        if stored is not None:
            self.schedule = Schedule.from_json(bytes(stored.cpu().numpy().tolist()).decode())
            self.schedule_bytes = stored.clone().to(self.device)
            self.field.shares_depth = self.schedule.phase_at(0).name == "joint"
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        return {
            "density": [self.field.density],
            "features": [self.field.features],
            "colour": [self.field.networks.weights],
            "reliability": [self.field.reliability],
        }

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # type: ignore[override]
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.prepare_step, args=[attributes])
        ]

    def prepare_step(self, attributes: TrainingCallbackAttributes | None, step: int) -> None:
        """Brings resolution, freezing and released texels to what the schedule says of this step."""
        self.step = step
        phase = self.schedule.phase_at(step)
        factor = self.schedule.texel_factor(step)
        if factor != float(self.field.texel_factor):
            self.field.grow(factor)
            optimizers = attributes.optimizers.optimizers if attributes and attributes.optimizers else {}
            for kind in ("density", "features", "reliability"):
                if kind in optimizers:
                    optimizers[kind].reset_moments(self.get_param_groups()[kind][0])
        if phase.name == "blend" and step == phase.start:
            self.field.release_untouched()
        self.field.learns_cover = phase.name in ("individual", "joint")
        for kind, params in self.get_param_groups().items():
            for p in params:
                p.requires_grad_(kind in TRAINS[phase.name])

    @property
    def blends(self) -> bool:
        """Whether reliability takes part in rendering now; pictures taken during training are always blended."""
        if self.config.training == "joint" or self.field.plan.num_heads == 1:
            return False
        return not self.training or self.schedule.blends_at(self.step)

    # Rendering ---------------------------------------------------------------------------------------------------

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:  # type: ignore[override]
        """Renders rays: rgb, accumulation, depth and winning MPI, and in training what the losses need."""
        bundle = self._bounded(ray_bundle)
        if self.training and self.schedule.phase_at(self.step).name == "individual":
            bundle, head_mask, choose = self._individual(bundle)
        else:
            head_mask, choose = self._shown(len(bundle)), None
        blend_form = self.config.blend_form if self.blends and head_mask is None else None
        samples, report = self.sampler(
            bundle,
            field=self.field,
            threshold=self._threshold(),
            fair_share=FAIR_SHARE if self._sharpening else float("inf"),
            head_mask=head_mask,
            choose=choose,
            blend_form=blend_form,
        )
        tau, lookup = self._optical_depth(samples, blend_form)
        valid = metadata_of(samples)["valid"][..., 0]
        composite = composite_weights(tau, valid, metadata_of(samples)["skipped_before"][..., 0], report.skipped_total)
        # Keypoint rays are supervised in depth alone: no colours for them.
        colored = lookup.of_rays(is_pixel_ray(bundle)) if lookup and self.training else lookup
        colors = self.field.get_outputs(samples, colored)[FieldHeadNames.RGB]
        outputs = self._outputs(composite, colors, samples, report)
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

    def _individual(self, bundle: RayBundle) -> tuple[RayBundle, Tensor | None, Tensor | None]:
        """Gives each ray to one MPI (by random priorities), or to every MPI in turn; the cube joins each."""
        num_mpis, heads = len(self.field.plan.mpis), self.field.plan.num_heads
        if num_mpis == 1:
            return bundle, None, None
        if self.config.rays_per_mpi == "split":
            g = generator(self.config.seed, self.step, "assignment", self.device)
            return bundle, None, torch.rand(len(bundle), num_mpis, generator=g, device=self.device)
        repeated = _repeat(bundle, num_mpis)
        own = torch.arange(num_mpis, device=self.device).repeat_interleave(len(bundle))
        mask = torch.arange(heads, device=self.device) == own[:, None]
        mask[:, num_mpis:] = True
        return repeated, mask, None

    def _shown(self, num_rays: int) -> Bool[Tensor, "R H"] | None:
        """The viewer's choice of one MPI, as a head mask."""
        names = self.field.plan.names
        if self.training or self.show.value not in names:
            return None
        chosen = torch.arange(len(names), device=self.device) == names.index(self.show.value)
        return chosen.expand(num_rays, -1)

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
        self, composite: Composite, colors: Tensor, samples: RaySamples, report: MergeReport
    ) -> dict[str, Tensor]:
        rgb = render_colors(composite, colors)
        outputs = {
            "rgb": rgb + composite.transmittance * self._background(rgb) if not self.training else rgb,
            "accumulation": composite.accumulation,
            "depth": self._depth(composite, samples),
        }
        if not self.training:
            heads = metadata_of(samples)["heads"][..., 0]
            mass = rgb.new_zeros(rgb.shape[0], self.field.plan.num_heads).scatter_add(1, heads, composite.weights)
            outputs["rgb"] = outputs["rgb"].clamp(0, 1)
            outputs["winning_mpi"] = mass.argmax(-1, keepdim=True).to(rgb.dtype)
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
        g = generator(self.config.seed, self.step, "background", self.device)
        total = rays.losses(self.field, image, self.config.loss, g, self.step)
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
        palette = head_palette(self.field.plan.num_heads, outputs["rgb"].device)
        near = 1 / outputs["depth"].clamp(min=1e-9)
        images = {
            "img": torch.cat([observed, outputs["rgb"]], 1),
            "accumulation": outputs["accumulation"].expand(-1, -1, 3),
            "inverse_depth": (near / near.flatten().quantile(0.98).clamp(min=1e-9)).clamp(0, 1).expand(-1, -1, 3),
            "winning_mpi": palette[outputs["winning_mpi"][..., 0].long()],
        }
        return values, images


def _repeat(bundle: RayBundle, times: int) -> RayBundle:
    def repeat(x: Tensor | None) -> Any:
        return None if x is None else x.repeat(times, *([1] * (x.ndim - 1)))

    return RayBundle(
        origins=repeat(bundle.origins),
        directions=repeat(bundle.directions),
        pixel_area=repeat(bundle.pixel_area),
        camera_indices=repeat(bundle.camera_indices),
        nears=repeat(bundle.nears),
        fars=repeat(bundle.fars),
        metadata={k: repeat(v) for k, v in bundle.metadata.items()},
    )


def _to_bytes(text: str) -> Tensor:
    return torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8)
