"""nerfstudio's data manager: training batches, drawn one step ahead, and the priors of a capture for the model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from nerfstudio.model_components.ray_generators import RayGenerator
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.data.checks import check_transforms
from mmpi_ns.data.copies import fit_cameras
from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.data.priors import Gains, Priors, PriorsConfig
from mmpi_ns.data.ray_sources import PixelPool, RaySources, rays_to_keypoints
from mmpi_ns.data.rays import CameraRays, TrainingRays
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.utils.errors import InputError, log
from mmpi_ns.utils.random_draws import generator

Batch = tuple[TrainingRays, dict[str, Any]]
CAPTURE = "capture"
"""Key of the ``Capture`` in the data set's metadata, by which nerfstudio hands it to the model."""
AT_ONCE = 8
"""Steps whose rays are drawn together."""
MANY_DEPTHS = 0.4
"""Minimum share of the training pixels with a depth prior for training to start from surfaces: two thirds have one in
most captures, a fifth if images hardly overlap."""


@dataclass(frozen=True)
class Capture:
    """Data of the training images for the model."""

    observations: Observations
    """Observations for placement."""
    views: TrainingViews
    """Positions and fields of view of the cameras."""
    rays_per_step: int
    """Pixel rays of a training step."""
    has_depths: bool
    """Whether enough pixels have a depth prior for surfaces to form early."""
    gains: Gains | None
    """Exposures of the images; None if they are equal."""


@dataclass
class MMPIDataManagerConfig(VanillaDataManagerConfig):
    """Settings of the data manager."""

    _target: type = field(default_factory=lambda: MMPIDataManager)
    train_num_rays_per_batch: int = 4096
    """Pixel rays per training step."""
    priors: PriorsConfig = field(default_factory=PriorsConfig)
    """Priors of the images."""
    keypoint_rays: int = 384
    """Extra rays per step through SfM keypoints of training images, if few pixels have a depth that two images share
    (scenes with tracks only)."""
    new_view_share: float = 0.75
    """Rays of new views for each pixel ray: from between two training cameras to points that both see at the same
    depth (0: none)."""
    pixel_jitter: float = 0.29
    """Standard deviation of rays from the centres of pixels along both axes, in pixels, beyond as many rays as a run
    takes by default on a CPU (0: always through the centres). So longer runs learn less of the images' noise."""
    resident_pixels: float = 60e6
    """Training pixels held in memory at once (at most 12 bytes each). Longer captures are read window by window; if a
    window has more pixels, a random subset of this size is used. 0: window by window, all of them."""
    seed: int = field(default=0, init=False)
    """Not an option: the trainer sets it from --machine.seed. Batches depend on it and the step alone, so a resumed run
    draws what an uninterrupted one would."""


class MMPIDataManager(VanillaDataManager[MMPIDataset]):
    """Draws training batches from ``RaySources`` and hands the capture's priors to the model."""

    config: MMPIDataManagerConfig

    def __init__(self, config: MMPIDataManagerConfig, **kwargs: Any) -> None:
        self.priors: Priors | None = None
        """Priors of a training; None where the plan comes from a checkpoint."""
        self.sources: RaySources | None = None
        """Sources of the current steps."""
        self.share_of_rays = 1.0
        """Share of the pixel rays in the current steps, with new views in proportion."""
        self._resident: RaySources | None = None
        """The sources of all cameras, if they are in memory all the time."""
        self._drawn: tuple[RaySources, tuple[int, int], Batch] | None = None
        """Rays of some steps with their sources, number of rays and number of the steps."""
        self.jitter_from = math.inf
        """Step from which on pixel rays are jittered."""
        self._is_replayed = False
        self._place, self._place_read = 0, torch.zeros(1, dtype=torch.int64, device=kwargs.get("device", "cpu"))
        """Place of the step among them, and what recorded steps read of it."""
        parser: Any = config.dataparser
        factor = getattr(parser, "downscale_factor", None)
        if isinstance(factor, float) and factor.is_integer():  # ns-render dataset gives 2.0
            parser.downscale_factor = int(factor)
        if isinstance(parser, NerfstudioDataParserConfig):
            opens = kwargs.get("test_mode", "val") != "inference"
            check_transforms(parser, Path(config.data or parser.data), opens=opens)
        if isinstance(parser, NerfstudioDataParserConfig | ColmapDataParserConfig):
            # Points are read with the other priors, in float64. nerfstudio needs open3d for them, and asks on the
            # terminal where a capture names none.
            parser = replace(parser, load_3D_points=False)
        self._parser = replace(config.dataparser, data=Path(config.data or config.dataparser.data))
        super().__init__(replace(config, dataparser=parser), **kwargs)
        self.config.seed = config.seed

    def create_train_dataset(self) -> MMPIDataset:
        # First, so that errors of images are reported before minutes of matching.
        outputs, scale = self.dataparser.get_dataparser_outputs(self.test_split), self.config.camera_res_scale_factor
        self._test_images = self.dataset_type(fit_cameras(outputs, self._downscale_factor), scale_factor=scale)
        fit_cameras(self.train_dataparser_outputs, self._downscale_factor)
        self.train_dataset = dataset = super().create_train_dataset()
        if not len(dataset):
            raise InputError("The capture holds no training image: check the split that the data parser made.")
        if min(int(dataset.cameras.width.min()), int(dataset.cameras.height.min())) < 1:
            raise InputError(
                f"--pipeline.datamanager.camera-res-scale-factor {self.config.camera_res_scale_factor:g} leaves no "
                "pixel of an image: give a larger one."
            )
        for images in (self._test_images, dataset) if self.test_mode == "val" else ():
            images.check_files()
        self._pixels = (dataset.cameras.width * dataset.cameras.height).reshape(-1).cpu().numpy()
        """Of each training image."""
        device = self.device
        generate = CameraRays.of(dataset.cameras, device) or RayGenerator(dataset.cameras.to(device))
        self.train_ray_generator: Any = lambda pixels: generate(pixels.to(device))
        self.maker = self.config.priors.setup(
            outputs=self.train_dataparser_outputs, dataset=dataset, parser=self._parser,
            rays=self.train_ray_generator, seed=self.config.seed,
        )  # fmt: skip
        if self.test_mode == "val":
            self.priors = priors = self.maker.make()
            share = 0.0 if priors.depths is None else priors.depths.share
            dataset.metadata[CAPTURE] = Capture(
                priors.placement, TrainingViews.of(dataset.cameras), self.config.train_num_rays_per_batch,
                share >= MANY_DEPTHS, priors.gains,
            )  # fmt: skip
            has_keypoints = self.config.keypoint_rays > 0 and len(priors.observations.seen_at) > 0
            if not has_keypoints and share == 0:
                log("No depth priors, from tracks, matches or a sensor: geometry is learned from colours alone.")
        return dataset

    @cached_property
    def observations(self) -> Observations:
        """Observations of the training cameras. Only training reads the images, which may be absent later, for
        points."""
        return self.maker.observe(find_points=False) if self.priors is None else self.priors.observations

    @property
    def _downscale_factor(self) -> int | None:
        """Downscale factor of the images that the data parser has listed."""
        return getattr(self.dataparser, "downscale_factor", None) or getattr(self.dataparser, "_downscale_factor", None)

    def create_eval_dataset(self) -> MMPIDataset:
        if count := len(self._test_images):
            names = (self._test_images.image_filenames, self.train_dataset.image_filenames)
            if shared := len(set(names[0]).intersection(names[1])):
                log(f"{shared} of {count} test images are training images too: scores say little about new views.")
            return self._test_images
        log("The capture has no test images: scores are of training images, not of new views.")
        return self.dataset_type(self.train_dataparser_outputs, scale_factor=self.config.camera_res_scale_factor)

    def setup_train(self) -> None:
        """Reads the pixels into memory, unless there are too many, instead of nerfstudio's image cache."""
        # Draws no pixels: ns-export sets its batch size here.
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, self.config.train_num_rays_per_batch)
        if self._pixels.sum() <= self.config.resident_pixels and self.test_mode == "val":
            CONSOLE.print(f"Reading {len(self.train_dataset)} training images.")
            self.sources = self._resident = self._read_sources(None)

    def use_cameras(self, cameras: NDArray[np.int64] | None) -> None:
        """Draws from these training cameras from now on, None for all. Raises InputError if an image cannot be
        used, or the masks leave no pixel."""
        if self._resident is None:
            self.sources = None  # before the next pixels are read
            self.sources = self._read_sources(cameras)
        else:
            self.sources = self._resident if cameras is None else self._resident.of_images(cameras)

    def _read_sources(self, cameras: NDArray[np.int64] | None) -> RaySources:
        """Pixels, new views and keypoints of all training cameras, or of some; says if only some pixels are used."""
        config, images = self.config, list(range(len(self.train_dataset))) if cameras is None else cameras.tolist()
        total, most = self._pixels[images].sum(), int(config.resident_pixels)
        if 0 < most < total:
            CONSOLE.print(
                f"{most / 1e6:.3g} of {total / 1e6:.3g} M training pixels are used, drawn at random: more are "
                "held with --pipeline.datamanager.resident-pixels."
            )
        gains, depths, find = (None, None, None) if self.priors is None else (
            self.priors.gains, self.priors.depths, self.priors.new_views
        )  # fmt: skip
        exposures = None if gains is None else torch.from_numpy(gains.from_field).float().to(self.device)
        pixels = PixelPool.from_dataset(self.train_dataset, self.device, images, depths, most, config.seed)
        new_views = None if find is None or config.new_view_share == 0 else find(images, self.device, exposures)
        keypoints = None if self.priors is None else rays_to_keypoints(self.observations, self.device, images)
        counts, rays = (config.new_view_share, config.keypoint_rays), self.train_ray_generator
        return RaySources(pixels, new_views, keypoints, rays, *counts, exposures)

    def describe(self) -> str:
        """Size of the capture in images, points and depths, in one line."""
        cameras, seen = self.train_dataset.cameras, self.observations
        sizes = sorted({(int(w), int(h)) for w, h in zip(cameras.width.view(-1), cameras.height.view(-1), strict=True)})
        shapes = f"{sizes[0][0]} x {sizes[0][1]}" + (f" to {sizes[-1][0]} x {sizes[-1][1]}" if len(sizes) > 1 else "")
        parts = [f"{len(cameras)} training and {len(self._test_images)} test images of {shapes}"]
        if len(seen.points):
            parts.append(f"{len(seen.points):,} points seen {len(seen.seen_by):,} times")
        if self.priors is not None and self.priors.depths is not None:
            parts.append(f"{100 * self.priors.depths.share:.0f} % of the training pixels have a depth prior")
        return f"Capture: {'; '.join(parts)}."

    def setup_eval(self) -> None:
        """nerfstudio's loaders, except the one that holds every evaluation image in memory."""
        sizes = self.eval_dataset.cameras.width * self.eval_dataset.cameras.height
        # An image that cannot be used is named before training, not after it.
        reads = self.test_mode == "val" and sizes.sum() <= self.config.resident_pixels
        for i in range(len(self.eval_dataset)) if reads else ():
            self.eval_dataset.get_data(i, image_type="uint8")
        self.eval_ray_generator = RayGenerator(self.eval_dataset.cameras.to(self.device))
        loaders = {"input_dataset": self.eval_dataset, "device": self.device, "num_workers": 4}
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(**loaders)
        self.eval_dataloader = RandIndicesEvalDataloader(**loaders)

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """The rays of a step, keyed on (seed, step), as by ``RaySources.draw``.

        Outside training (ns-export always requests step 0) only pixel rays, different ones in each call.
        """
        self.train_count += 1
        if not self.training:
            g = generator(self.config.seed, self.train_count, "pixels", self.device)
            rays, batch = self._current().draw(self._pixel_rays, g, pixels_alone=True)
            return rays[0], {name: values[0] for name, values in batch.items()}
        self.draw_rays(step)
        assert self._drawn is not None
        rays, batch = self._drawn[2]
        if not self._is_replayed:
            return rays[self._place], {name: values[self._place] for name, values in batch.items()}
        place = self._place_read
        return rays[place][0], {name: values[place][0] for name, values in batch.items()}

    def keep_memory(self) -> None:
        """From now on recorded steps read the rays, so that those of later steps take the same memory."""
        self._is_replayed, self._drawn = True, None

    def draw_rays(self, step: int) -> None:
        """Draws the rays of ``AT_ONCE`` steps together, unless they are there: drawing is a hundred small operations,
        and their number is its cost."""
        sources, (number, place), pixel_rays = self._current(), divmod(step, AT_ONCE), self._pixel_rays
        held = self._drawn if self._drawn is not None and self._drawn[0] is sources else None
        if held is None or held[1] != (pixel_rays, number):
            steps = range(number * AT_ONCE, (number + 1) * AT_ONCE)
            jitter = self.config.pixel_jitter if steps.start >= self.jitter_from else 0.0
            generators = (generator(self.config.seed, i, "pixels", self.device) for i in steps)
            drawn = sources.draw(pixel_rays, *generators, jitter=jitter)
            if self._is_replayed and held is not None and held[1][0] == pixel_rays:
                for old, new in zip(_tensors(held[2]), _tensors(drawn), strict=True):
                    old.copy_(new)
                drawn = held[2]
            self._drawn = sources, (pixel_rays, number), drawn
        if self._is_replayed and (held is None or place != self._place):
            self._place_read.fill_(place)
        self._place = place

    def _current(self) -> RaySources:
        if self.sources is None:  # no window was chosen
            self.use_cameras(None)
        assert self.sources is not None
        return self.sources

    @property
    def _pixel_rays(self) -> int:
        return max(1, round(self.share_of_rays * self.get_train_rays_per_batch()))


def _tensors(batch: Batch) -> list[Tensor]:
    return [x for x in (*vars(batch[0]).values(), *batch[1].values()) if isinstance(x, Tensor)]
