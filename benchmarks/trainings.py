"""One training by nerfstudio's own trainer, evaluated on the way, in a process of its own.

The trainer is untouched but for a callback after each step, which counts rays and, at given steps, stops the clock,
renders test pixels and starts it again. Whatever draws random numbers meanwhile is given its old state back.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shlex
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from apart import Tell, run_apart
from lab import end_helpers, peak_gib
from methods import Method
from numpy.typing import NDArray
from peers import give_depths, leave_lpips_out, look_up_quickly, read_points_ourselves
from report import read_json, write_json
from score import evenly
from trainers import Scene, clock, config_of, trainer_of

from mmpi_ns.rendering.metrics import ImageMetrics

PROGRESS = "progress.json"


@dataclass(frozen=True)
class Request:
    """What to train and where to look."""

    words: tuple[str, ...]
    """For ns-train: the method, its options and the data parser's."""
    data: str
    downscale_factor: int
    work: str
    """Folder of the run."""
    checks: tuple[int, ...]
    """Evaluate after so many steps; the last is the length of the run."""
    check_images: int = 0
    """Test images, evenly spaced, that are looked at on the way; 0 for all."""
    check_pixels: int = 64
    """Pixels of each, drawn once; 0 for all. Methods that splat whole images render all and are scored on these."""
    final_images: int = 0
    """Test images, evenly spaced, that are rendered whole at the end; 0 for all."""
    whole_images: bool = False
    """The method renders no single pixels."""
    keep: bool = False
    """Keep checkpoints."""
    go_on: bool = False
    """Save at every check, and go on from the last one of a run in the same folder that was cut off or was shorter.
    For methods whose schedule does not depend on how long they train."""
    quick_hashes: bool = False
    """Give nerfstudio's hash tables the compiled lookups of ``peers.look_up_quickly``."""
    wants_depths: bool = False
    """Give nerfstudio's reader of depth images those of ``peers.give_depths``."""

    @staticmethod
    def of(
        method: Method, scene: Scene, work: Path, steps: int, rays: int | None = None, seed: int = 0,
        device: str = "cpu", **looks: Any,
    ) -> Request:  # fmt: skip
        """A training of a method; looked at when it ends unless ``looks`` says otherwise."""
        words = method.words(scene, work, steps, rays, seed, device)
        own = {"checks": (steps,), "whole_images": method.whole_images, "wants_depths": method.wants_depths}
        own |= looks
        return Request(tuple(words), str(scene.data), scene.downscale_factor, str(work), **own)

    @property
    def rendered(self) -> str:
        """The words without where things lie on this machine."""
        hidden = {"--output-dir", "--data", "--experiment-name", "--timestamp"}
        return shlex.join(w for i, w in enumerate(self.words) if not {w, *self.words[max(i - 1, 0) : i]} & hidden)


def train_apart(request: Request, threads: int) -> dict[str, Any]:
    """The row of a training in a fresh process, or why there is none."""
    variables = {}
    if request.quick_hashes:  # else half of nerfacto's time goes into fetching the same pages from the system again
        variables |= {"MALLOC_MMAP_THRESHOLD_": str(8 * 10**9), "MALLOC_TRIM_THRESHOLD_": str(16 * 10**9)}
    if request.go_on:  # nerfstudio's checkpoints hold numpy scalars, which torch refuses unless told otherwise
        variables["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"
    return run_apart(train, asdict(request), Path(request.work), threads, extra=variables)


@dataclass
class Progress:
    """How far a training has come, and where its checkpoints lie: what a run that goes on must know."""

    words: list[str]
    """What ``ns-train`` was asked for, but for the number of steps."""
    curve: list[dict[str, float]] = field(default_factory=list)
    """One point for each look: step, rays, seconds by the clock and of processors, psnr."""
    rays: int = 0
    setup_seconds: float = 0.0
    checkpoints: str = ""
    """Folder."""

    @property
    def last(self) -> dict[str, Any]:
        """The last look."""
        return self.curve[-1] if self.curve else {"step": 0, "seconds": 0.0, "processor": 0.0}

    def save(self, trainer: Any, folder: Path) -> None:
        """Saves a checkpoint of nerfstudio's trainer, and then what belongs to it."""
        trainer.save_checkpoint(self.last["step"] - 1)
        self.checkpoints = str(trainer.checkpoint_dir)
        write_json(folder / PROGRESS, asdict(self))

    @staticmethod
    def before(words: tuple[str, ...], folder: Path, last: int) -> Progress:
        """That of a run in this folder from which one of ``last`` steps can go on; else none yet."""
        own = [w for i, w in enumerate(words) if i == 0 or words[i - 1] != "--max-num-iterations"]
        if known := read_json(folder / PROGRESS):
            results = Progress(**known)
            step = results.last["step"]
            saved = Path(results.checkpoints) / f"step-{step - 1:09d}.ckpt"
            if results.words == own and 0 < step < last and saved.is_file():
                return results
        return Progress(own)


class Stopwatch:
    """Seconds that training took, without what it was stopped for: by the clock, and of this process's processors."""

    def __init__(self) -> None:
        self._start = _now()

    def set(self, seconds: float, processor: float) -> None:
        """Makes it show so many seconds."""
        self._start = _now() - np.array([seconds, processor])

    def read(self) -> dict[str, float]:
        """seconds, processor."""
        return dict(zip(("seconds", "processor"), (_now() - self._start).tolist(), strict=True))

    @contextlib.contextmanager
    def stopped(self) -> Iterator[None]:
        """Does not count what runs inside, nor lets it change random draws outside."""
        begin, numpy_state = _now(), np.random.get_state()  # noqa: NPY002
        with torch.random.fork_rng():  # of all devices
            yield
        np.random.set_state(numpy_state)  # noqa: NPY002
        self._start += _now() - begin


def _now() -> NDArray[np.float64]:
    return np.array([clock(), time.process_time()])


def chosen_pixels(image: int, height: int, width: int, wanted: int) -> torch.Tensor:
    """Indices of the pixels of a test image that are scored on the way; equal for every method."""
    g = torch.Generator().manual_seed(image)
    return torch.randperm(height * width, generator=g)[: wanted or None]


@torch.no_grad()
def score(pipeline: Any, images: list[int], pixels: int, whole_images: bool) -> dict[str, float]:
    """Mean PSNR over some test images, and over whole images SSIM and rays/s too.

    Args:
        pipeline: nerfstudio's.
        images: which of the test images.
        pixels: of each image; 0 for all.
        whole_images: the model renders no single pixels.
    """
    pipeline.eval()
    metrics, rows, rays, seconds = ImageMetrics("none"), [], 0, 0.0
    for index, (camera, batch) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
        if index not in images:
            continue
        truth = batch["image"].to("cpu")
        truth = truth.float() / 255 if truth.dtype == torch.uint8 else truth
        if truth.shape[-1] != 3:
            raise ValueError("A test image is see-through: methods put it over different backgrounds.")
        chosen = chosen_pixels(index, *truth.shape[:2], pixels)
        start = time.perf_counter()
        if pixels and not whole_images:
            bundle = camera.generate_rays(camera_indices=0, keep_shape=True).flatten()
            bundle = bundle[chosen.to(bundle.origins.device)].reshape((len(chosen), 1))
            rgb = pipeline.model.get_outputs_for_camera_ray_bundle(bundle)["rgb"].cpu()
        else:
            rgb = pipeline.model.get_outputs_for_camera(camera)["rgb"].cpu()  # on a GPU, waits for it
        seconds += time.perf_counter() - start
        rays += rgb.shape[0] * rgb.shape[1]
        if pixels:
            rgb = rgb if not whole_images else rgb.reshape(-1, 1, 3)[chosen]
            truth = truth.reshape(-1, 1, 3)[chosen]
        rows.append(metrics(rgb.clamp(0, 1), truth))
    pipeline.train()
    means = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
    return {**means, "rays_per_s": rays / seconds, "frame_s": seconds / len(rows), "images": len(rows)}


def split_of(datamanager: Any) -> dict[str, Any]:
    """Which images a method trains with and is tested on: names, image size, and a hash of names, sizes, focal lengths
    and how far apart the cameras are."""
    results: dict[str, Any] = {}
    digest = hashlib.sha256()
    parts = {"train": datamanager.train_dataparser_outputs, "test": datamanager.eval_dataset._dataparser_outputs}
    for name, outputs in parts.items():
        results[name] = [str(p) for p in outputs.image_filenames]
        cameras = outputs.cameras
        digest.update(json.dumps([name, [Path(p).name for p in results[name]]]).encode())
        # Distances, since loading points may turn the world by a quarter.
        travel = (cameras.camera_to_worlds[:, :, 3] - cameras.camera_to_worlds[:1, :, 3]).norm(dim=-1)
        for value in (cameras.width, cameras.height, cameras.fx, travel):
            digest.update(np.ascontiguousarray(value.cpu().double().numpy().round(3)).tobytes())
        results["size"] = [int(cameras.width[0]), int(cameras.height[0])]
    return {**results, "digest": digest.hexdigest()[:16]}


def check_split(split: dict[str, Any], data: Path, downscale_factor: int) -> None:
    """Compares with what the scene's own test list says.

    Raises:
        ValueError: the trainer would evaluate on other images than the test images, or one is in both lists.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    parser = NerfstudioDataParserConfig(data=data, downscale_factor=downscale_factor).setup()
    for name in ("train", "test"):
        wanted = [str(p) for p in parser.get_dataparser_outputs(split=name).image_filenames]
        if split[name] != wanted:
            raise ValueError(f"{data}: the {name} images are not those of its {name} list; val and test must be equal.")
    if both := sorted(set(split["train"]) & set(split["test"])):
        raise ValueError(f"{data}: {both[0]} is in both lists.")


def train(asked: dict[str, Any], tell: Tell = print) -> dict[str, Any]:
    """Trains as ``ns-train`` with these words would, and says how good it was when.

    Args:
        asked: the fields of a ``Request``.
        tell: of progress.

    Returns:
        curve: for each check step, rays, seconds since the trainer was set up (placement and loading included,
        evaluation not; by the clock, and of processors) and PSNR; psnr, ssim, rays_per_s, frame_s over whole test
        images; setup_seconds, seconds, processor_seconds, rays, parameters, peak_gib, split.
    """
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in asked.items()}
    request = Request(**plain)
    leave_lpips_out()
    read_points_ourselves()
    if request.quick_hashes:
        look_up_quickly()
    if request.wants_depths:
        give_depths(Path(request.data), request.downscale_factor)
    config = config_of(request.words)
    progress = Progress.before(request.words, Path(request.work), request.checks[-1] if request.go_on else 0)
    done = int(progress.last["step"])
    if done:
        config.load_dir, config.load_step = Path(progress.checkpoints), done - 1
        config.max_num_iterations -= done  # nerfstudio's trainer makes so many more
        tell(f"goes on from step {done}")
    config.save_config()
    watch = Stopwatch()
    # Random draws are not saved with a checkpoint: the second part must not repeat those of the first.
    trainer = trainer_of(config, done)
    if done:
        watch.set(progress.last["seconds"], progress.last["processor"])
    else:
        progress.setup_seconds = watch.read()["seconds"]
    row = _follow(trainer, request, watch, tell, progress)
    end_helpers(trainer)
    if not request.keep:
        shutil.rmtree(trainer.checkpoint_dir)
    return row


def _follow(trainer: Any, request: Request, watch: Stopwatch, tell: Tell, progress: Progress) -> dict[str, Any]:
    """Trains with the callback that looks."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    pipeline = trainer.pipeline
    split = split_of(pipeline.datamanager)
    check_split(split, Path(request.data), request.downscale_factor)
    count = len(split["test"])
    final: dict[str, float] = {}

    def look(step: int) -> None:
        progress.rays += pixels_of_step(pipeline)
        if step + 1 not in request.checks:
            return
        taken = watch.read()
        with watch.stopped():
            results = score(pipeline, evenly(count, request.check_images), request.check_pixels, request.whole_images)
            progress.curve.append({"step": step + 1, "rays": progress.rays, **taken, "psnr": results["psnr"]})
            tell(f"step {step + 1}: {taken['seconds']:.0f} s of training, {results['psnr']:.2f} dB")
            if request.go_on:
                progress.save(trainer, Path(request.work))
            if step + 1 == request.checks[-1]:
                final.update(score(pipeline, evenly(count, request.final_images), 0, request.whole_images))

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], look))
    trainer.train()
    on_gpu = {"peak_gpu_gib": torch.cuda.max_memory_allocated() / 2**30} if torch.cuda.is_available() else {}
    return {
        "curve": progress.curve,
        **final,
        "setup_seconds": progress.setup_seconds,
        "seconds": progress.last["seconds"],
        "processor_seconds": progress.last["processor"],
        "rays": progress.rays,
        "parameters": sum(p.numel() for p in pipeline.model.parameters()),
        "peak_gib": peak_gib(),
        **on_gpu,
        "split": {**split, "train": len(split["train"]), "test": count},
    }


def pixels_of_step(pipeline: Any) -> int:
    """Pixels that the step which just ended compared; splats are trained on images that grow."""
    pixels = int(pipeline.datamanager.get_train_rays_per_batch())
    shrink = getattr(pipeline.model, "_get_downscale_factor", None)
    return pixels if shrink is None else pixels // int(shrink()) ** 2
