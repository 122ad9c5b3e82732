"""nerfstudio's trainer in this process: made from the arguments of an ``ns-train`` command, and run a step at a
time."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

P = "--pipeline.model.placement."
JOINT = ("--pipeline.model.schedule.training", "joint")
NO_TRACKS = ("--pipeline.datamanager.priors.sfm-path", "none", "--pipeline.datamanager.priors.triangulate", "False")
"""Options of our methods without pycolmap: points are estimated on surfaces (``mmpi_priors/observe.py``)."""
BARE = () if importlib.util.find_spec("pycolmap") else NO_TRACKS
"""Options of our methods on a machine without pycolmap."""


@dataclass(frozen=True)
class Scene:
    """A data set and the size of its images that is used."""

    data: Path
    downscale_factor: int

    @property
    def name(self) -> str:
        return self.data.resolve().name


def train_words(
    method: str, options: Sequence[str], scene: Scene, folder: Path, steps: int, seed: int, device: str
) -> list[str]:
    """An ``ns-train`` line that leaves evaluating and saving to the caller: it saves once, at the end. The options of
    the method come first, so that later words win."""
    words = [method, *options, "--machine.seed", str(seed)]
    words += ["--output-dir", str(folder), "--experiment-name", "run", "--timestamp", "1", "--vis", "tensorboard"]
    words += ["--machine.device-type", device, "--max-num-iterations", str(steps), "--steps-per-save", str(10**9)]
    words += [word for what in ("batch", "image", "all-images") for word in (f"--steps-per-eval-{what}", "0")]
    words += ["--logging.profiler", "none", "--logging.local-writer.enable", "False", "--data", str(scene.data)]
    return [*words, "nerfstudio-data", "--downscale-factor", str(scene.downscale_factor)]


def config_of(words: Sequence[str]) -> Any:
    """The config that ``ns-train`` would train with."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    config: Any = tyro.cli(AnnotatedBaseConfigUnion, args=list(words))
    config.pipeline.datamanager.data = config.data
    return config


def trainer_of(config: Any, seed_offset: int = 0) -> Any:
    """A trainer that is set up. Random draws start from the config's seed plus ``seed_offset``."""
    from nerfstudio.engine import trainer as nerfstudio_trainer
    from nerfstudio.scripts.train import _set_random_seed

    nerfstudio_trainer.writer.EVENT_WRITERS.clear()
    _set_random_seed(config.machine.seed + seed_offset)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def clock() -> float:
    """Seconds; on a GPU after synchronisation."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


class Steps:
    """The trainer of an ``ns-train`` command, a step at a time, without logging and saving."""

    def __init__(self, words: Sequence[str]) -> None:
        self.trainer = trainer_of(config_of(words))
        self.pipeline, self.step = self.trainer.pipeline, 0

    def run(self, count: int) -> float:
        """Trains; returns seconds."""
        from nerfstudio.engine.callbacks import TrainingCallbackLocation as At

        start = clock()
        for step in range(self.step, self.step + count):
            self.pipeline.train()
            for callback in self.trainer.callbacks:
                callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
            self.trainer.train_iteration(step)
            for callback in self.trainer.callbacks:
                callback.run_callback_at_location(step, location=At.AFTER_TRAIN_ITERATION)
        self.step += count
        return clock() - start

    @torch.no_grad()
    def render(self, larger: int = 1, rays: int = 0) -> tuple[float, int]:
        """Renders a test view, or the first so many rays of it; returns seconds and pixels."""
        self.pipeline.eval()
        camera = self.pipeline.datamanager.eval_dataset.cameras[0:1].to(self.pipeline.device)
        camera.rescale_output_resolution(larger)
        bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
        if rays:
            bundle = bundle.flatten()[:rays].reshape((min(rays, bundle.size), 1))
        start = clock()
        self.pipeline.model.get_outputs_for_camera_ray_bundle(bundle)
        return clock() - start, bundle.size
