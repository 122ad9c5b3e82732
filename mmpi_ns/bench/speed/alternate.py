"""Training steps of ours, of the dense reference and of nerfacto in turns, in one process of their own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle

from mmpi_ns.bench.apart import answer
from mmpi_ns.bench.speed.dense import _dense as dense_colors
from mmpi_ns.bench.trainings import replace_lpips
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.rendering.rendered import bounded


@dataclass(frozen=True)
class Request:
    """What takes turns, and for how long."""

    ours: list[str]
    """Words for ns-train."""
    nerfacto: list[str]
    steps: int
    """Of ours in all; the rounds share them."""
    dense_steps: int
    """Of the dense reference in each round."""
    nerfacto_steps: int
    rounds: int
    full_size: int
    """A large frame has so many times the width and height."""
    nerfacto_rays: int
    """Rays of a test image that nerfacto renders in each round."""


class Steps:
    """A nerfstudio trainer, a step at a time: what its own loop does in a step, without logging and saving."""

    def __init__(self, words: list[str]) -> None:
        import tyro
        from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
        from nerfstudio.engine import trainer as nerfstudio_trainer
        from nerfstudio.scripts.train import _set_random_seed

        replace_lpips()
        nerfstudio_trainer.writer.EVENT_WRITERS.clear()
        config: Any = tyro.cli(AnnotatedBaseConfigUnion, args=words)
        config.pipeline.datamanager.data = config.data
        _set_random_seed(config.machine.seed)
        self.trainer = config.setup(local_rank=0, world_size=1)
        self.trainer.setup()
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

    @property
    def rays(self) -> int:
        """Pixel rays of a step."""
        return self.pipeline.datamanager.get_train_rays_per_batch()

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

    def close(self) -> None:
        """Ends the processes that prepare batches."""
        for process in getattr(self.pipeline.datamanager, "data_procs", []):
            process.terminate()


class DenseSteps:
    """The dense reference on the same plan, at all its texels, with the same batches: photometric loss, plain Adam."""

    def __init__(self, like: Steps) -> None:
        model = like.pipeline.model
        config = model.config
        self.like, self.model, self.step = like, model, 0
        self.field = MMPIField(
            model.field.full_plan,
            feature_channels=config.feature_channels,
            hidden_width=config.hidden_width,
            position_frequencies=config.position_frequencies,
            direction_frequencies=config.direction_frequencies,
            shared_colour=config.shared_colour,
            shares_depth=True,
        ).to(model.device)
        rates = {self.field.density: 0.1, self.field.features: 0.1, self.field.networks.weights: 1e-3}
        self.optimizer = torch.optim.Adam([{"params": [p], "lr": lr} for p, lr in rates.items()], betas=(0.9, 0.99))
        self.samples = 0.0

    def run(self, count: int) -> float:
        """Trains; returns seconds."""
        start = clock()
        for step in range(self.step, self.step + count):
            bundle, batch = self.like.pipeline.datamanager.next_train(step)
            image = batch["image"].to(self.model.device)
            bundle = bounded(_first(bundle, len(image)), self.model.field.plan)  # rays to keypoints come last
            rgb, self.samples = dense_colors(self.field, bundle)
            self.optimizer.zero_grad()
            ((rgb - image[:, :3]) ** 2).mean().backward()
            self.optimizer.step()
        self.step += count
        return clock() - start


def _first(bundle: RayBundle, count: int) -> RayBundle:
    return RayBundle(bundle.origins[:count], bundle.directions[:count], bundle.pixel_area[:count])


def clock() -> float:
    """Seconds; on a GPU, once it has done all."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def run(request: Request, tell: Callable[[str], None]) -> dict[str, Any]:
    """Rounds of everything in turn.

    Returns:
        Rays/s of each round for ours, dense and nerfacto; after training, seconds of a frame and of a large one and
        rays/s of nerfacto's rendering; pixels of the frames; samples a ray of the dense reference.
    """
    ours = Steps(request.ours)
    dense, nerfacto = DenseSteps(ours), Steps(request.nerfacto)
    assert nerfacto.rays == ours.rays
    nerfacto.run(2)  # its process that prepares batches takes seconds to start
    dense.run(1)
    training = ("rays_per_s", "dense_rays_per_s", "nerfacto_rays_per_s")
    frames = ("frame_s", "frame_full_s", "nerfacto_render_rays_per_s")
    found: dict[str, Any] = {name: [] for name in (*training, *frames)}

    def told(number: int, names: tuple[str, ...]) -> None:
        tell(f"round {number} of {request.rounds}: " + ", ".join(f"{n} {found[n][-1]:.3g}" for n in names))

    steps, seconds = request.steps // request.rounds, 0.0
    for number in range(1, request.rounds + 1):
        spent = ours.run(steps)
        seconds += spent
        found["rays_per_s"].append(steps * ours.rays / spent)
        for name, other, count in (
            ("dense_rays_per_s", dense, request.dense_steps),
            ("nerfacto_rays_per_s", nerfacto, request.nerfacto_steps),
        ):
            found[name].append(count * ours.rays / other.run(count))
        told(number, training)
    for number in range(1, request.rounds + 1):  # of the trained model
        for name, larger in (("frame_s", 1), ("frame_full_s", request.full_size)):
            frame_s, found[name.replace("_s", "_pixels")] = ours.render(larger)
            found[name].append(frame_s)
        render_s, rays = nerfacto.render(rays=request.nerfacto_rays)
        found["nerfacto_render_rays_per_s"].append(rays / render_s)
        told(number, frames)
    nerfacto.close()
    whole_run = steps * request.rounds * ours.rays / seconds
    return {**found, "whole_run_rays_per_s": whole_run, "dense_samples": dense.samples}


if __name__ == "__main__":
    answer(lambda request, tell: run(Request(**request), tell))
