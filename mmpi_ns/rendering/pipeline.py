"""nerfstudio's pipeline, with printed evaluation scores."""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import Any, cast

import numpy as np
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor
from torchvision.utils import save_image

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.details import moved_cameras
from mmpi_ns.settings import MMPIPipelineConfig
from mmpi_ns.utils.errors import log
from mmpi_ns.utils.random_draws import generator

REFINED = "refined_"
"""Prefix of metrics of images whose poses were refined against the model."""
STEPS = 80
"""Optimisation steps for each image."""
RAYS = 1024
"""Pixels of each step."""
RATES = (2e-3, 5e-5)
"""Learning rates at the start and at the end: radians, and scene units."""


class MMPIPipeline(VanillaPipeline):
    """Pipeline that scores images at their exposure, and prints mean, worst and best PSNR and SSIM."""

    config: MMPIPipelineConfig

    def get_average_image_metrics(
        self,
        data_loader: Any,
        image_prefix: str,
        step: int | None = None,
        output_path: Path | None = None,
        get_std: bool = False,
    ) -> dict[str, float]:
        """Means over the images of a loader, under nerfstudio's names, and a summary line."""
        self.eval()
        scores: list[tuple[str, dict[str, float]]] = []
        names = [Path(name).name for name in data_loader.input_dataset.image_filenames]
        if output_path is not None:
            output_path.mkdir(exist_ok=True, parents=True)
        for n, (camera, batch) in enumerate(track(data_loader, "Evaluating images", console=CONSOLE, transient=True)):
            start = monotonic()
            values, images = self.score(camera, batch)
            values["fps"] = 1 / (monotonic() - start)
            values["num_rays_per_sec"] = int(camera.width) * int(camera.height) * values["fps"]
            for name, image in images.items() if output_path is not None else ():
                save_image(image.permute(2, 0, 1).cpu(), cast(Path, output_path) / f"{image_prefix}_{name}_{n:04d}.png")
            scores.append((names[int(batch["image_idx"])], values))
        means: dict[str, float] = {}
        for name in scores[0][1]:
            each = [values[name] for _, values in scores]
            means[name] = float(np.mean(each))
            if get_std:
                means[f"{name}_std"] = float(np.std(each, ddof=1)) if len(each) > 1 else 0.0
        log(summary(scores))
        self.train()
        return means

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Scores and pictures of the next test image, during training."""
        self.eval()
        camera, batch = self.datamanager.next_eval_image(step)
        values, images = self.score(camera, batch)
        values["num_rays"] = int(camera.width) * int(camera.height)
        self.train()
        return values, images

    def score(self, camera: Cameras, batch: dict[str, Tensor]) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics and pictures of one image.

        Args:
            camera: of the image.
            batch: the image, from the data set, with ``image_idx``.
        """
        model: Any = self.model
        outputs, observed = self.outputs_of(camera, batch)
        values, images = model.get_image_metrics_and_images(outputs, batch)
        if self.config.refine_eval_poses:
            seed = model.config.seed + int(batch["image_idx"])
            moved, degrees, units = refined_camera(model, camera.to(model.device), observed, seed)
            outputs = self.as_exposed(moved, model.get_outputs_for_camera(moved), observed)
            refined = model.get_image_metrics_and_images(outputs, batch)[0]
            refined |= {"rotation_degrees": degrees, "translation": units}
            values |= {REFINED + name: value for name, value in refined.items()}
        return values, images

    def outputs_of(self, camera: Cameras, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """The rendering of an image at its exposure, and its colours [H, W, 3], for all scores."""
        model: Any = self.model
        observed = model.observed(batch)
        outputs = model.get_outputs_for_camera(camera.to(model.device))
        return self.as_exposed(camera, outputs, observed), observed

    def as_exposed(self, camera: Cameras, outputs: dict[str, Tensor], observed: Tensor) -> dict[str, Tensor]:
        """The outputs at the exposure of the evaluated image, if exposures differ."""
        model: Any = self.model
        if "radiance" not in outputs:
            return outputs
        manager: Any = self.datamanager
        exposures = model.exposures.factors, model.exposures.falloff
        exposure = manager.maker.exposure_of(manager.observations, *exposures, camera, observed, outputs)
        if exposure is None:
            log("No training image sees the surfaces of an evaluated one: it is scored at mean exposure.")
            return outputs
        exposed = {
            name.replace("radiance", "rgb"): outputs[name] for name in ("radiance", "field_radiance") if name in outputs
        }
        return outputs | {name: (exposure.to(radiance) * radiance).clamp(0, 1) for name, radiance in exposed.items()}


def refined_camera(model: Any, camera: Cameras, image: Tensor, seed: int) -> tuple[Cameras, float, float]:
    """A camera refined to the pose from which a frozen model renders its image best.

    If the training poses were wrong, or were refined, the model does not match the test poses exactly. The pose is
    optimised by the colours of the same pixels that are then scored, so this is no score of view synthesis.

    Args:
        model: ``MMPIModel``, in evaluation.
        camera: one.
        image: [H, W, 3] of it, over the model's background.
        seed: of the draw of pixels.

    Returns:
        The refined camera, its rotation in degrees, and its translation in scene units.
    """
    adjustment: CameraOptimizer = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=1, device=model.device)
    optimizer = torch.optim.Adam(adjustment.parameters(), lr=RATES[0])
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATES[1] / RATES[0]) ** (1 / STEPS))
    rays = image_rays(camera).flatten()
    observed = image.reshape(-1, 3).to(model.device)
    frozen = [p.requires_grad_(False) for p in model.parameters() if p.requires_grad]
    try:
        for step in range(STEPS):
            chosen = torch.randint(len(observed), (RAYS,), generator=generator(seed, step, "eval poses", "cpu"))
            bundle = rays[chosen.to(model.device)]
            bundle.camera_indices = torch.zeros_like(chosen, device=model.device)[:, None]
            with torch.enable_grad():
                adjustment.apply_to_raybundle(bundle)
                loss = ((model.image_outputs(bundle)["rgb"] - observed[chosen]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()
    finally:
        for p in frozen:
            p.requires_grad_(True)
    sizes: dict[str, Any] = {}
    adjustment.get_metrics_dict(sizes)
    return (
        moved_cameras(camera, adjustment),
        float(sizes["camera_opt_rotation_max"]),
        float(sizes["camera_opt_translation_max"]),
    )


def summary(scores: list[tuple[str, dict[str, float]]]) -> str:
    """PSNR and SSIM of evaluated images, given by name and metrics, in a line."""
    psnr = [values["psnr"] for _, values in scores]
    worst, best = (scores[int(i)][0] for i in (np.argmin(psnr), np.argmax(psnr)))
    extremes = f"worst {min(psnr):.2f}, {worst}; best {max(psnr):.2f}, {best}"
    text = f"{len(scores)} images: PSNR {np.mean(psnr):.2f} dB ({extremes})"
    ssim = [values["ssim"] for _, values in scores if "ssim" in values]
    text += f", SSIM {np.mean(ssim):.3f} ({min(ssim):.3f} to {max(ssim):.3f})" if ssim else ""
    if not all(REFINED + "psnr" in values for _, values in scores):
        return text
    names = [REFINED + name for name in ("psnr", "rotation_degrees")]
    again, degrees = (float(np.mean([values[name] for _, values in scores])) for name in names)
    return f"{text}; {again:.2f} dB with each image's own pose refined against the model, by {degrees:.2f} degrees"
