"""nerfstudio's data manager: training batches, drawn ahead, and the cameras, SfM points and depths for the model.

And the observations of a scene outside training, as ``ns-train`` would pass them to placement.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

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

from mmpi_ns.data.checks import PARSER_OPTIONS, check_transforms, colmap_models, say_once
from mmpi_ns.data.dataset import MMPIDataset, take_local_origins
from mmpi_ns.data.exif import light_of
from mmpi_ns.data.ray_sources import PixelPool, RaySources, rays_to_keypoints
from mmpi_ns.data.rays import CameraRays, TrainingRays
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.visible_tiles import TrainingViews
from mmpi_ns.utils.errors import InputError, say
from mmpi_ns.utils.host import arguments, command, values_of
from mmpi_ns.utils.parallel import num_threads
from mmpi_ns.utils.random_draws import Generators, generator
from mmpi_ns.utils.values import check_options
from mmpi_priors.known_depth import KnownDepth, know_depths, of_cells
from mmpi_priors.moving import draw_moving, moving_masks, share_of_moving
from mmpi_priors.new_views import find_shared_points, image_and_mask
from mmpi_priors.observe import drop_masked, observe, posed_images
from mmpi_priors.photometry import SAME_LIGHT, Gains, color_ratios, image_gains
from mmpi_priors.tracks import at_full_size

Batch = tuple[TrainingRays, dict[str, Tensor]]
Parser = Literal["auto", "nerfstudio", "colmap"]
OBSERVATIONS = "mmpi_observations"
"""Key of the scene's Observations in the data set's metadata, for the model."""
GAINS = "mmpi_gains"
"""Key of the exposures of the training images (``photometry.Gains``); missing where they are equal."""
DEPTHS_KNOWN = "mmpi_depths_known"
"""Metadata: whether enough training pixels have a known depth to start training with surfaces."""
MANY_DEPTHS = 0.4
"""That share of the training pixels: two thirds in most captures, a fifth in one whose images hardly overlap."""
RAYS_PER_STEP = "mmpi_rays_per_step"
"""Key of the pixel rays of a training step."""
TRAINING_VIEWS = "mmpi_training_views"
"""Key of the positions and fields of view of the training cameras (``TrainingViews``)."""


@dataclass
class MMPIDataManagerConfig(VanillaDataManagerConfig):
    """Settings of the data manager."""

    _target: type = field(default_factory=lambda: MMPIDataManager)
    train_num_rays_per_batch: int = 4096
    """Pixel rays a training step."""
    eval_num_rays_per_batch: int = 1024
    """Rays of an evaluation batch during training."""
    keypoint_rays: int = 384
    """Extra rays a step through SfM keypoints of training images, if few pixels have a depth shared by two images
    (scenes with tracks only)."""
    sfm_path: Path = Path("colmap/sparse/0")
    """COLMAP model with the tracks, relative to the data, in the frame of transforms.json (colmap parser: its own)."""
    triangulate: bool = True
    """Scenes without tracks: match and triangulate the training images' features at the start (a second or so each)."""
    dense_depth: bool = True
    """Match the originals of neighbouring training images densely at the start, for the depth of most pixels (about a
    second for a million pixels on one core, on all cores; kept in ~/.cache/mmpi_ns for the next start)."""
    depth_images: bool = True
    """Use the depth images that a data parser lists (depth_file_path)."""
    mask_moving: bool = True
    """Mask what moves (cars, people) in the training images that have no mask: its pixels are not trained on."""
    new_view_share: float = 0.75
    """Rays of new views for each pixel ray: from between two training cameras to points that both show at the same
    known depth (0: none)."""
    correct_exposure: bool = True
    """Calibrate exposure and white balance of the images, by surfaces that several show and by EXIF, and compare each
    image with the scene at its own exposure, if that explains how images differ."""
    resident_pixels: float = 60e6
    """Training pixels held in memory at once (at most 12 bytes each). Longer captures are read window by window; if a
    window has more pixels, a random subset of this size is used. 0: window by window, all of them."""
    seed: int = field(default=0, init=False)
    """Not an option: the trainer sets it from --machine.seed. Batches depend on it and the step alone, so a resumed run
    draws what an uninterrupted one would."""
    backdrop: float | None = field(default=None, init=False)
    """Not an option: ns-render sets it to the gray level of the background of its images, over which it then shows the
    originals too. nerfstudio takes four channels for features and shows their principal components."""


class MMPIDataManager(VanillaDataManager[MMPIDataset]):
    """Draws training batches from ``RaySources`` and hands the scene's observations to the model."""

    config: MMPIDataManagerConfig
    _thread: ClassVar = ThreadPoolExecutor(1, thread_name_prefix="mmpi-rays")
    """Draws the rays of the next step during this one: small operations of torch, which take the time of one core."""

    def __init__(self, config: MMPIDataManagerConfig, **kwargs: Any) -> None:
        self.known_depth: KnownDepth | None = None
        self.gains: Gains | None = None
        self.moves = ""
        """How much of the training images moves, in a sentence; empty where nobody looked."""
        self.sources: RaySources | None = None
        """Sources that a step draws from now."""
        self.share_of_rays = 1.0
        """Share of the pixel rays that a step draws now, with new views in proportion."""
        self._resident: RaySources | None = None
        """The sources of all cameras, if they are in memory all the time."""
        self.draws = Generators(config.seed, kwargs.get("device", "cpu"))
        self._ahead: tuple[RaySources, tuple[int, int], Future[Batch]] | None = None
        """Rays of the next step with what they are drawn from, their step and number."""
        parser: Any = config.dataparser
        factor = getattr(parser, "downscale_factor", None)
        if isinstance(factor, float) and factor.is_integer():  # of ns-render dataset
            parser.downscale_factor = int(factor)
        check_options(parser, {name: number for name, number in PARSER_OPTIONS.items() if hasattr(parser, name)}, "--")
        if isinstance(parser, NerfstudioDataParserConfig):
            mode = kwargs.get("test_mode", "val")
            splits = ("train", "val", "test") if mode == "val" else ("train", "test")  # for the evaluation after it too
            check_transforms(parser, Path(config.data or parser.data), splits, opens=mode != "inference")
        take_local_origins(parser)
        super().__init__(config, **kwargs)
        self.train_dataset.backdrop = self.eval_dataset.backdrop = config.backdrop
        passed = self.train_dataset if "train" in values_of("--pose-source") else self.eval_dataset
        if command() == "ns-render" and "interpolate" in arguments() and len(passed) < 2:
            raise InputError(
                f"A path from image to image needs two, and its split has {passed.image_filenames[0]} alone: give "
                "--pose-source train."
            )

    def create_train_dataset(self) -> MMPIDataset:
        # First, so that what is wrong with images is said before minutes of matching.
        self._test_images = super().create_eval_dataset()
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
        dataset.metadata[RAYS_PER_STEP] = self.config.train_num_rays_per_batch
        dataset.metadata[TRAINING_VIEWS] = TrainingViews.of(dataset.cameras)
        device = self.device
        generate = CameraRays.of(dataset.cameras, device) or RayGenerator(dataset.cameras.to(device))
        self.train_ray_generator: Any = lambda pixels: generate(pixels.to(device))
        if self.test_mode == "val":  # elsewhere the plan comes from a checkpoint
            if self.config.mask_moving and None in dataset.mask_files:
                # A mask file of the user wins over what is seen to move.
                masks, doubt = moving_masks(self.observations, dataset)
                masks = [mask & (file is None) for mask, file in zip(masks, dataset.mask_files, strict=True)]
                self.moves = share_of_moving(masks)
                is_masked = any(mask.any() for mask in masks)
                say(self.moves + (" (--pipeline.datamanager.mask-moving False keeps them)." if is_masked else "."))
                if doubt:
                    say(doubt, "yellow")
                if is_masked:
                    dataset.moving = masks
                    self.observations = drop_masked(self.observations, dataset)
            depths, self.observations = know_depths(
                self.train_dataparser_outputs, self.observations, dataset, self.train_ray_generator,
                dense=self.config.dense_depth, sensor=self.config.depth_images,
            )  # fmt: skip
            self.known_depth, seen = depths, self.observations
            dataset.metadata[DEPTHS_KNOWN] = depths is not None and depths.share >= MANY_DEPTHS
            dataset.metadata[OBSERVATIONS] = seen if depths is None else of_cells(seen, depths, dataset)
            has_keypoints = self.config.keypoint_rays > 0 and len(self.observations.seen_at) > 0
            if not has_keypoints and (depths is None or depths.share == 0):
                say("No depths are known, from tracks, matches or a sensor: geometry is learned from colours alone.")
        return dataset

    @cached_property
    def observations(self) -> Observations:
        """Observations of the training cameras. Only training searches the images, later perhaps absent, for points."""
        return observe(
            self.train_dataparser_outputs,
            self.train_dataset,
            self.dataparser.config,
            self.config.sfm_path,
            find_points=self.test_mode == "val",
            triangulates=self.config.triangulate,
        )

    def create_eval_dataset(self) -> MMPIDataset:
        if count := len(self._test_images):
            names = (self._test_images.image_filenames, self.train_dataset.image_filenames)
            if shared := len(set(names[0]).intersection(names[1])):
                say(f"{shared} of {count} test images are training images too: scores say little about new views.")
            return self._test_images
        say("The capture has no test images: scores are of training images, and say nothing about new views.")
        return self.dataset_type(self.train_dataparser_outputs, scale_factor=self.config.camera_res_scale_factor)

    def setup_train(self) -> None:
        """Reads the pixels into memory, unless there are too many, instead of nerfstudio's image cache."""
        # Samples nothing: ns-export sets its batches' size here.
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, self.config.train_num_rays_per_batch)
        gains = self.calibrated() if self.config.correct_exposure and self.test_mode == "val" else None
        if gains is not None:
            say(gains.describe())
            if gains.matter:
                self.gains = self.train_dataset.metadata[GAINS] = gains
        if self._pixels.sum() <= self.config.resident_pixels and self.test_mode == "val":
            CONSOLE.print(f"Reading {len(self.train_dataset)} training images.")
            self.sources = self._resident = self._read_sources(None)

    def calibrated(self) -> Gains | None:
        """Exposures of the training images; None if EXIF says that they are equal, or nothing tells them."""
        posed = posed_images(self.observations, self.train_dataset)
        if self.known_depth is None or posed is None or len(posed.files) < 2:
            return None
        light = np.array([light_of(file) for file in at_full_size(posed).files])
        if np.isfinite(light).all() and np.ptp(np.log(light)) < SAME_LIGHT:
            say("Exposure: EXIF notes the same for all images.")
            return None
        ratios = color_ratios(
            posed, self.known_depth, self.train_ray_generator,
            lambda i: image_and_mask(self.train_dataset, i), self.config.seed,
        )  # fmt: skip
        return None if ratios is None else image_gains(ratios, len(posed.files), light)

    def use_cameras(self, cameras: NDArray[np.int64] | None) -> None:
        """Draws from these training cameras from now on, None for all, and prints the share of each source. Raises
        InputError if an image cannot be used, or the masks leave no pixel."""
        if self._resident is None:
            self.sources = None  # before the next pixels are read
            self.sources = self._read_sources(cameras)
        else:
            self.sources = self._resident if cameras is None else self._resident.of_images(cameras)
        say_once(self.sources.describe(self.get_train_rays_per_batch()))

    def _read_sources(self, cameras: NDArray[np.int64] | None) -> RaySources:
        """The pixels, new views and keypoints of all training cameras, or of some; notes if pixels are left out."""
        config, images = self.config, list(range(len(self.train_dataset))) if cameras is None else cameras.tolist()
        total, most = self._pixels[images].sum(), int(config.resident_pixels)
        if 0 < most < total:
            CONSOLE.print(
                f"{most / 1e6:.3g} of {total / 1e6:.3g} M training pixels are used, drawn at random: more are "
                "held with --pipeline.datamanager.resident-pixels."
            )
        exposures = None if self.gains is None else torch.from_numpy(self.gains.from_field).float().to(self.device)
        depths, rays = self.known_depth, self.train_ray_generator
        pixels = PixelPool.from_dataset(self.train_dataset, self.device, images, depths, most, config.seed)
        new_views, no_new_views = None, "no two images show a point at the same depth"
        if config.new_view_share <= 0:
            no_new_views = "--pipeline.datamanager.new-view-share 0"
        elif depths is None or depths.share == 0:
            no_new_views = "no pixel has a known depth"
        elif (posed := posed_images(self.observations, self.train_dataset)) is None:
            no_new_views = "a camera is neither perspective nor fisheye"
        else:
            chosen = images, config.seed, self.device, exposures
            new_views = find_shared_points(self.train_dataset, posed, depths, rays, *chosen)
        keypoints = rays_to_keypoints(self.observations, self.device, images) if self.test_mode == "val" else None
        counts = config.new_view_share, config.keypoint_rays
        return RaySources(pixels, new_views, keypoints, rays, *counts, no_new_views, exposures)

    def describe(self) -> str:
        """Size of the capture in images, points and depths, in one line."""
        cameras, seen = self.train_dataset.cameras, self.observations
        sizes = sorted({(int(w), int(h)) for w, h in zip(cameras.width.view(-1), cameras.height.view(-1), strict=True)})
        shapes = f"{sizes[0][0]} x {sizes[0][1]}" + (f" to {sizes[-1][0]} x {sizes[-1][1]}" if len(sizes) > 1 else "")
        parts = [f"{len(cameras)} training and {len(self.eval_dataset)} test images of {shapes}"]
        if len(seen.points):
            parts.append(f"{len(seen.points):,} points seen {len(seen.seen_by):,} times")
        if self.known_depth is not None:
            parts.append(f"{100 * self.known_depth.share:.0f} % of the training pixels have a known depth")
        return f"Capture: {'; '.join(parts)}."

    def pixel_bytes(self, cameras: NDArray[np.int64] | None = None) -> int:
        """Bytes of the training pixels in memory while these cameras are drawn from; where masks hide some, at most."""
        if self._resident is not None:
            return self._resident.pixels.nbytes
        sizes = self._pixels if cameras is None else self._pixels[cameras]
        dataset, most = self.train_dataset, int(self.config.resident_pixels)
        share = min(1.0, most / sizes.sum()) if most else 1.0
        # As in ``PixelPool``: colour, place in the image where it must be kept, and depth.
        place, depth = share < 1 or dataset.has_masks, self.known_depth is not None
        each = (4 if dataset.has_alpha else 3) + 4 * place + 4 * depth
        return each * sum(int(share * size) for size in sizes.tolist())

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

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        """Pixels of one evaluation image, keyed on (seed, step)."""
        self.eval_count += 1
        g = generator(self.config.seed, step, "evaluation", "cpu")
        number = int(torch.randint(len(self.eval_dataset), (1,), generator=g))
        data = self.eval_dataset[number]
        shown = data["mask"][..., 0] if "mask" in data else torch.ones(data["image"].shape[:2], dtype=torch.bool)
        pixels = shown.nonzero()
        if not len(pixels):
            raise InputError(f"The mask of {self.eval_dataset.image_filenames[number]} leaves no pixel: correct it.")
        chosen = pixels[torch.randint(len(pixels), (self.config.eval_num_rays_per_batch,), generator=g)]
        batch = {name: data[name][chosen[:, 0], chosen[:, 1]] for name in ("image", "distance") if name in data}
        batch["indices"] = torch.cat([torch.full_like(chosen[:, :1], number), chosen], -1)
        return self.eval_ray_generator(batch["indices"]), batch

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """The rays of a step, keyed on (seed, step), as by ``RaySources.draw``; with several threads, those of the next
        step are drawn meanwhile.

        Outside training (ns-export always requests step 0) only pixel rays, different ones in each call.
        """
        self.train_count += 1
        if self.sources is None:  # nobody said which window
            self.use_cameras(None)
        sources, batch = self.sources, None
        pixel_rays = max(1, round(self.share_of_rays * self.get_train_rays_per_batch()))
        assert sources is not None
        draw, seed, device = partial(sources.draw, pixel_rays), self.config.seed, self.device
        if not self.training:
            return draw(generator(seed, self.train_count, "pixels", device), pixels_alone=True)
        if self._ahead is not None:
            source, key, future = self._ahead
            batch = future.result() if source is sources and key == (step, pixel_rays) else None
        batch = batch or draw(self.draws.of(step, "pixels"))
        if num_threads() > 1 and torch.device(device).type == "cpu":
            future = self._thread.submit(draw, generator(seed, step + 1, "pixels", device))
            self._ahead = sources, (step + 1, pixel_rays), future
        return batch


def load_observations(
    data: Path, downscale_factor: int | None = None, parser: Parser = "auto", moving: Path | None = None
) -> tuple[Observations, str]:
    """The observations that training on a scene would use, and a sentence on what moves in its images. Raises
    InputError if the folder holds no scene, or one that cannot be trained.

    Args:
        data: the scene's folder.
        downscale_factor: size of the images, as for the data parser; None leaves it to the parser.
        parser: format of the scene; auto means nerfstudio's format if there is a transforms.json.
        moving: file for a picture of what moves. None: neither movers nor depths of pixels are searched, which takes
            minutes; tracks or searched surfaces take their place.
    """
    config = MMPIDataManagerConfig(dataparser=NerfstudioDataParserConfig(load_3D_points=True))
    is_nerfstudio = data.suffix == ".json" or (data / "transforms.json").is_file()
    if parser == "colmap" or (parser == "auto" and not is_nerfstudio):
        models = colmap_models(data)
        if not models:
            raise InputError(f"{data} holds neither a transforms.json nor a COLMAP model: it is not a scene.")
        config.sfm_path = Path(models[0])
        config.dataparser = ColmapDataParserConfig(colmap_path=config.sfm_path)
    parser_config = config.dataparser
    config.data = parser_config.data = data
    parser_config.downscale_factor = downscale_factor  # type: ignore[attr-defined]
    if isinstance(parser_config, NerfstudioDataParserConfig):
        check_transforms(parser_config, data, ("train",), opens=True)
    take_local_origins(parser_config)
    outputs = parser_config.setup().get_dataparser_outputs(split="train")
    if any(Path(name).is_file() for name in outputs.image_filenames):
        # As ns-train does, so that it refuses what ns-train would refuse, and finds the depths that it would find.
        config.mask_moving = config.dense_depth = config.depth_images = moving is not None
        config.new_view_share, config.correct_exposure = 0.0, False  # placement asks for neither
        manager = config.setup(device="cpu", test_mode="val")
        masks = manager.train_dataset.moving
        if moving is not None and masks is not None:
            names = [Path(name).name for name in outputs.image_filenames]
            colors = (manager.train_dataset.get_data(i, "uint8")["image"][..., :3] for i in range(len(names)))
            draw_moving(moving, zip(names, (np.flip(x.numpy(), -1) for x in colors), strict=True), masks)
        return manager.train_dataset.metadata[OBSERVATIONS], manager.moves
    CONSOLE.print(f"The images of {data} are not there: its cameras and points alone are judged.")
    cameras = MMPIDataset(outputs), parser_config, config.sfm_path
    return observe(outputs, *cameras, find_points=True, triangulates=config.triangulate), ""
