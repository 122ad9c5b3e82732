"""nerfstudio's pipeline, whose evaluation also prints its figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch import Tensor

from mmpi_ns.rendering.baked import exact_images
from mmpi_ns.rendering.eval_poses import refined_camera
from mmpi_ns.rendering.exposure import exposure_of_image
from mmpi_ns.utils.console import say

REFINED = "refined_"
"""Prefix of metrics of images whose own poses were refined against the model."""


@dataclass
class MMPIPipelineConfig(VanillaPipelineConfig):
    """Settings of the pipeline."""

    _target: type = field(default_factory=lambda: MMPIPipeline)
    refine_eval_poses: bool = False
    """Score each evaluated image a second time, with its pose refined against the trained model: metrics "refined_...",
    in addition to the plain ones (docs/captures.md, "Poses that are not exact")."""


class MMPIPipeline(VanillaPipeline):
    """Prints PSNR and SSIM of evaluated images, with the worst and the best of them."""

    config: MMPIPipelineConfig

    def get_average_image_metrics(self, data_loader: Any, image_prefix: str, *args: Any, **kwargs: Any) -> Any:
        """Means over the images of a loader, like nerfstudio's, and a summary line."""
        scores: list[tuple[int, dict[str, float]]] = []
        model: Any = self.model
        cameras = data_loader.input_dataset.cameras

        def score(outputs: dict[str, Tensor], batch: Any) -> tuple[dict[str, float], dict[str, Tensor]]:
            i = int(batch["image_idx"])
            outputs = self._as_exposed(cameras[i : i + 1], outputs, model.observed(batch))
            values, images = model.scores_and_images(outputs, batch)
            if self.config.refine_eval_poses:
                values |= self._refined_metrics(cameras, batch)
            scores.append((i, dict(values)))
            return values, images

        model.scoring = score
        try:
            with exact_images():
                means = super().get_average_image_metrics(data_loader, image_prefix, *args, **kwargs)
        finally:
            model.scoring = None
        # Of one image nerfstudio's deviations are NaN, which is no JSON.
        means = {name: 0.0 if math.isnan(value) and name.endswith("_std") else value for name, value in means.items()}
        names = [Path(name).name for name in data_loader.input_dataset.image_filenames]
        say(summary([(names[i], values) for i, values in scores]))
        return means

    def _as_exposed(self, camera: Any, outputs: dict[str, Tensor], observed: Tensor) -> dict[str, Tensor]:
        """The outputs at the exposure of the evaluated image itself, where exposures differ."""
        model: Any = self.model
        if "radiance" not in outputs:
            return outputs
        manager: Any = self.datamanager
        exposure = exposure_of_image(model.exposures, manager, camera, observed, outputs)
        if exposure is None:
            say("No training image shows what an evaluated one does, or they are gone: it is scored at mean exposure.")
            return outputs
        return outputs | {"rgb": (exposure.to(outputs["radiance"]) * outputs["radiance"]).clamp(0, 1)}

    def _refined_metrics(self, cameras: Any, batch: Any) -> dict[str, float]:
        """Metrics of an image with its pose refined against the model, and the size of the refinement."""
        model: Any = self.model
        i = int(batch["image_idx"])
        camera, observed = cameras[i : i + 1].to(model.device), model.observed(batch)
        camera, degrees, units = refined_camera(model, camera, observed, model.config.seed + i)
        outputs = self._as_exposed(camera, model.get_outputs_for_camera(camera), observed)
        values, _ = model.scores_and_images(outputs, batch)
        moved = {"rotation_degrees": degrees, "translation": units}
        return {REFINED + name: value for name, value in (values | moved).items()}


def summary(found: list[tuple[str, dict[str, float]]]) -> str:
    """PSNR and SSIM of evaluated images, in a line.

    Args:
        found: name and metrics of each.
    """
    psnr = [values["psnr"] for _, values in found]
    worst, best = (found[int(i)][0] for i in (np.argmin(psnr), np.argmax(psnr)))
    extremes = f"worst {min(psnr):.2f}, {worst}; best {max(psnr):.2f}, {best}"
    text = f"{len(found)} images: PSNR {np.mean(psnr):.2f} dB ({extremes})"
    ssim = [values["ssim"] for _, values in found if "ssim" in values]
    text += f", SSIM {np.mean(ssim):.3f} ({min(ssim):.3f} to {max(ssim):.3f})" if ssim else ""
    if not all(REFINED + "psnr" in values for _, values in found):
        return text
    names = [REFINED + name for name in ("psnr", "rotation_degrees")]
    again, degrees = (float(np.mean([values[name] for _, values in found])) for name in names)
    return f"{text}; {again:.2f} dB with each image's own pose refined against the model, by {degrees:.2f} degrees"
