"""Settings of the model: ``--pipeline.model.*``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nerfstudio.models.base_model import ModelConfig

from mmpi_ns.field.shading import Shading
from mmpi_ns.ops import native
from mmpi_ns.ops.compositing import BlendForm
from mmpi_ns.placement.rule import PlacementConfig
from mmpi_ns.training.loss_terms import LossWeights
from mmpi_ns.training.phases import Schedule, Training, make_schedule


def _model() -> type:
    from mmpi_ns.model import MMPIModel

    return MMPIModel


@dataclass
class MMPIModelConfig(ModelConfig):
    """Settings of the model."""

    _target: type = field(default_factory=_model)
    enable_collider: bool = False
    """Must stay off: a finite far would drop the plane at infinity."""
    eval_num_rays_per_chunk: int = 0
    """Rays rendered at once; 0 for what suits the device (on a GPU: what half of its free memory holds)."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """Where the MPIs stand and how fine they are."""
    plan_file: Path | None = None
    """A scene plan (JSON) to use instead of the placement rule."""
    windows_folder: Path | None = None
    """Set by the trainer: where the finished windows of a long capture lie."""
    resident_gib: float = 2.0
    """Device memory that rendering may take for the windows of a long capture, GiB, beside the one trained last: as
    many are held as fit, at least one; the one not used for longest goes first."""
    half_windows: bool = False
    """Write the finished windows of a long capture in half precision: half of the disk, and the same pictures to a
    fraction of a grey level."""
    training: Training = "joint"
    """Each MPI alone, then reliability (two-phase), or all together without reliability (joint)."""
    total_steps: int = 1
    """Set by the trainer from --max-num-iterations; the phases are shares of it."""
    blend_share: float = 0.05
    """Share of the steps in which only reliability trains."""
    finetune_share: float = 0.4
    """Share of the steps in which everything trains together at the end."""
    finetune_rate: float = 1.0
    """Learning rates at the start of the fine-tune relative to those of the first phase."""
    decay_decades: float = 1.5
    """Decades that learning rates fall over a phase."""
    growth_shares: tuple[float, ...] = (1 / 15, 2 / 15, 3 / 15, 4 / 15)
    """When the texels of a plane double, as shares of the first phase."""
    release_shares: tuple[float, ...] = (0.5, 0.75, 0.95)
    """When bricks (8 x 8 texels of a plane) in which nothing is seen are given up, as shares of the first phase."""
    release_weight: float = 5e-3
    """Bricks in which no sample of a training ray weighs this much are given up; 0 keeps all that rays can reach."""
    rays_per_mpi: Literal["split", "all"] = "all"
    """Individual phase: each MPI renders all rays of a batch (K times the work of a step, about what joint training
    takes), or the MPIs share them."""
    blend_form: BlendForm = "paper"
    """How reliability enters: P alpha (paper) or 1 - (1 - alpha)^P (opacity)."""
    shading: Shading = "ray"
    """Whether a network looks at what a ray has gathered, once, or colours every sample as in the paper."""
    shared_colour: bool = False
    """Shading of samples: one colour network for all MPIs instead of one each."""
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
    """Inner loops: compiled at first use (native; by a C++ compiler on a CPU, by Triton on a GPU), plain torch, or
    compiled where that can be done (auto)."""
    render_threshold: float = 3e-3
    """Samples of less weight are not coloured when rendering; the dropped mass is reported."""
    render_shares: Literal["exact", "baked"] = "exact"
    """After two-phase training: a sample's share from the reliabilities of all MPIs that see it, or from its texels,
    which keep theirs from the first rendering on (faster by the number of MPIs that overlap, and nearly the same)."""
    exposure: bool = False
    """A gain and a bias for each training image and colour channel, for captures whose exposure changes on the way.
    Their means over the images of a window are 1 and 0; other views get none."""
    background: Literal["black", "gray", "white"] = "gray"
    """Behind everything, when rendering. Training uses random colours where the MPIs explain the whole ray."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    lpips_net: Literal["vgg", "alex", "none"] = "vgg"
    """Network of the LPIPS metric (the paper: VGG); left out where its weights (0.5 GB for VGG) cannot be had."""
    seed: int = 0
    """Seed of the model's own random draws."""

    def schedule(self, training: Training, windows: int) -> Schedule:
        """The schedule of a run through so many windows."""
        return make_schedule(
            training,
            max(1, self.total_steps),
            blend_share=self.blend_share,
            finetune_share=self.finetune_share,
            growth_shares=self.growth_shares,
            decay_decades=self.decay_decades,
            finetune_rate=self.finetune_rate,
            windows=windows,
            release_shares=self.release_shares if self.release_weight > 0 else (),
        )

    def field_settings(self) -> dict[str, Any]:
        """What a field takes from here, by its arguments' names."""
        names = (
            "shading",
            "feature_channels",
            "hidden_width",
            "position_frequencies",
            "direction_frequencies",
            "shared_colour",
        )
        return {name: getattr(self, name) for name in (*names, "samples_per_voxel", "cube_alpha")}
