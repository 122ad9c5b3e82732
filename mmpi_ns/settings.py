"""Options of the method, quick to import: every ``ns-*`` command reads those of all methods.

Their targets are imported when they are called (``Later``). The options of the data manager are beside it: ns-render
changes the class that its ``_target`` names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from mmpi_ns.utils.errors import log

Route = Literal["auto", "torch", "native"]
Shading = Literal["ray", "sample"]
"""Whether the network is evaluated once a ray or for every sample."""


@dataclass(frozen=True)
class Later:
    """A class or function that is imported when it is first called: the ``_target`` of settings."""

    module: str
    name: str

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(import_module(self.module), self.name)(*args, **kwargs)


@dataclass
class PlacementConfig:
    """Placement and resolution of the MPIs."""

    arrangement: Literal["automatic", "drive", "room"] = "automatic"
    """automatic: by the expected pixel error; drive: front, left, right, below; room: five around the centre."""
    max_mpis: int = 64
    """Maximum number of MPIs (automatic)."""
    max_texels: float = 16e6
    """Approximate maximum of texels and voxels in total; texels are made larger to meet it; 0: no limit (automatic)."""
    min_gain: float = 1.0
    """Minimum gain of an MPI in bits, one for each halving of the expected error of one training image (automatic)."""
    planes: int = 64
    """Planes of every MPI (drive, room)."""
    max_planes: int = 256
    """Maximum planes of an MPI; each gets as many as the points it serves need (automatic)."""
    plane_pixels: float = 0.35
    """Plane error allowed for four fifths of the points of an MPI, relative to a texel's pixels (automatic)."""
    texel_pixels: float = 1.5
    """Image pixels that a texel spans, seen from the origin of the MPI (automatic)."""
    rays_per_texel: float = 5.0
    """Minimum number of training rays through a texel, from all images that see it: short runs on large images with
    little overlap get larger texels (automatic)."""
    height: int = 96
    """Texel rows of every MPI (drive, room)."""
    width: int = 256
    """Texel columns of every MPI (drive, room)."""
    window_length: float = 5.0
    """Length of the windows into which longer captures are split, in median distances of the content; 0: no windows."""
    faces: tuple[str, ...] = ("front", "left", "right", "below")
    """MPIs of the drive to use (drive)."""
    cube_voxels: int = 0
    """Voxels along each side of the centred cube; 0 for none (room)."""


@dataclass
class ScheduleConfig:
    """Training schedule: ``--pipeline.model.schedule.*``."""

    training: Literal["two-phase", "joint"] = "joint"
    """Train each MPI alone, then reliability (two-phase), or all MPIs together without reliability (joint)."""
    rays_per_mpi: Literal["split", "all"] = "all"
    """Individual phase: each MPI renders all rays of a batch (all; K times the work, about that of joint training), or
    the MPIs share them (split)."""
    blend_share: float = 0.05
    """Share of the steps in which only reliability trains."""
    finetune_share: float = 0.4
    """Share of the steps in which everything trains together at the end."""
    decay_decades: float = 1.0
    """Decades that learning rates fall over a phase (DVGO: x0.1 per 20k of 30k steps = 1.5),"""
    decay_from: float = 0.5
    """after being constant for this fraction of it."""
    growth_shares: tuple[float, ...] = (1 / 15, 2 / 15, 3 / 15, 4 / 15)
    """Times at which the texels of a plane double, as shares of the first phase. Surfaces have formed at the last one;
    with depth priors, at the second, shares are of at most 4,000 steps, and 1.5 times as large unless cameras look
    along their path."""
    release_shares: tuple[float, ...] = (0.15, 3 / 15, 4 / 15, 0.3, 0.5, 0.75, 0.95)
    """Times at which empty bricks (8 x 8 texels of a plane) are released, as shares of the first phase: after growth,
    or just before the texels double."""
    release_weight: float = 7.5e-3
    """Bricks in which no sample of a training ray has this weight are released; 0 keeps all reachable ones."""


@dataclass
class SamplingConfig:
    """Samples of a ray: ``--pipeline.model.sampling.*``."""

    threshold: float = 3e-3
    """Weight below which samples get no gradient (at most a tenth of an equal share until surfaces have formed)."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample at full resolution: 1e-2 for a small room to 1e-4."""


@dataclass
class ColourConfig:
    """Features and networks of colours: ``--pipeline.model.colour.*``."""

    shading: Shading = "ray"
    """Evaluate the colour network once a ray, after compositing (ray), or for every sample as in the paper (sample)."""
    feature_channels: int = 8
    """Channels of a texel besides its density: three of a colour, the others features for view-dependent appearance.
    Eight are half a cache line, so a CPU trains faster with them than with nine (docs/ablations.md)."""
    hidden_width: int = 64
    """Width of the colour networks."""


@dataclass
class RenderingConfig:
    """Images: ``--pipeline.model.rendering.*``."""

    threshold: float = 3e-3
    """Weight below which samples are not shaded when rendering; their total weight is reported (dropped_mass)."""
    background: Literal["black", "gray", "white"] = "gray"
    """Background when rendering. Training uses random colours where the MPIs cover the ray fully."""
    nearest_images: int = 6
    """Number of nearest training images whose details (residuals) are added to an image (docs/details.md); 0 renders
    the field alone, and a training with 0 writes no details."""
    resident_gib: float = 2.0
    """Device memory for rendering the windows of a long capture, GiB, in addition to the one trained last. As many as
    fit are kept, at least one; the least recently used is evicted first."""


@dataclass
class LossWeights:
    """Weights of the losses added to the photometric one."""

    point_color: float = 0.01
    """Colour of each sample against its ray's."""
    background_entropy: float = 0.001
    """Entropy of the transmittance of a ray."""
    distortion: float = 0.01
    """Spread of a ray's weights over distance (distortion)."""
    keypoint_depth: float = 0.02
    """-log of the weights near an SfM keypoint (scenes with tracks)."""
    depth_priors: float = 0.01
    """-log of the likelihood of a pixel's depth prior, from dense matches, an SfM point or a sensor. Falls with the
    learning rates, as colours are more accurate in the end."""
    tv_density: float = 1e-4
    """Total variation of the densities, in DVGO's normalisation (there: 1e-5)."""
    tv_features: float = 1e-5
    """Total variation of the features, in the same normalisation (there: 1e-6)."""
    tv_chroma: float = 50.0
    """Weight of differences of chroma (a texel's colour less the mean of its channels), as a multiple of
    ``tv_features``: colours are noisy where rays are few, and surfaces vary less in hue than in brightness."""


@dataclass
class MMPIModelConfig(ModelConfig):
    """Settings of the model: ``--pipeline.model.*``."""

    _target: Callable[..., Any] = Later("mmpi_ns.model", "MMPIModel")
    enable_collider: bool = False
    """Must stay off: a finite far would drop the plane at infinity."""
    eval_num_rays_per_chunk: int = 0
    """Rays in a rendering chunk; 0 chooses for the device (on a GPU: as many as fit in half of its free memory)."""
    size: float = 1.0
    """Factor on training rays where they follow the capture (``mmpi``): 0.3 for a quick look, also with fewer texels; 4
    for a better one. Rays are multiplied up to two per training pixel: images do not improve beyond."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """Placement and resolution of the MPIs."""
    plan_file: Path | None = None
    """A scene plan (JSON) to use instead of the placement rule."""
    camera_optimizer: CameraOptimizerConfig = field(default_factory=CameraOptimizerConfig)
    """Refines the poses of the training images during training (docs/captures.md, "Poses that are not exact")."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """Phases, growth, learning rates and release of bricks."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Samples of a ray, and their threshold in training."""
    colour: ColourConfig = field(default_factory=ColourConfig)
    """Features and networks."""
    ops: Route = "auto"
    """Inner loops: compiled at first use (native; by a C++ compiler on a CPU, by Triton on a GPU), plain torch (torch),
    or compiled if possible (auto)."""
    rendering: RenderingConfig = field(default_factory=RenderingConfig)
    """Images: threshold, background, details, and memory for windows."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    lpips_net: Literal["vgg", "alex", "none"] = "vgg"
    """Network of the LPIPS metric (the paper: VGG); omitted if its weights (0.5 GB for VGG) are not available."""
    seed: int = field(default=0, init=False)
    """Not an option: the trainer sets it from --machine.seed."""
    total_steps: int = field(default=1, init=False)
    """Not an option: the trainer sets it from --max-num-iterations; the phases are shares of it. 0: as many as the
    capture needs."""
    rays_times: int = field(default=1, init=False)
    """Not an option: the trainer sets it. Factor on the method's rays per step on this GPU."""
    windows_folder: Path | None = field(default=None, init=False)
    """Not an option: the trainer sets it, and config.yml stores it for evaluation. Folder of the finished windows."""


@dataclass
class MMPIPipelineConfig(VanillaPipelineConfig):
    """Settings of the pipeline."""

    _target: Callable[..., Any] = Later("mmpi_ns.rendering.pipeline", "MMPIPipeline")


@dataclass
class TouchedAdamConfig(OptimizerConfig):
    """Settings of TouchedAdam."""

    _target: Callable[..., Any] = Later("mmpi_ns.training.touched_adam", "TouchedAdam")
    lr: float = 0.1
    """Learning rate at the start of the group's phase."""


@dataclass
class MMPITrainerConfig(TrainerConfig):
    """nerfstudio's trainer settings."""

    _target: Callable[..., Any] = Later("mmpi_ns.training.trainer", "MMPITrainer")
    max_num_iterations: int = 0
    """Steps of the whole run, resumed or not; if a long capture is split into windows, of each window. 0: as many as
    its pixels need (2,500 to 12,000, times --pipeline.model.size)."""
    steps_per_save: int = 0
    """Steps between checkpoints; 0: a quarter of a window's, at least 500."""
    graphs: bool = True
    """On a GPU: replay steps as CUDA graphs, several times faster than one operation at a time (docs/gpu.md)."""

    def print_to_terminal(self) -> None:
        """Prints the path of config.yml in place of all settings, which would fill the terminal."""
        log(f"All settings of this run: {self.get_base_dir() / 'config.yml'}")

    def save_config(self) -> None:
        """Checks the options, makes the run's folder, and writes config.yml (``training/options.py``)."""
        TrainerConfig.save_config(Later("mmpi_ns.training.options", "checked")(self))
