"""nerfstudio's pipeline, with printed evaluation scores."""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import Any, cast

import numpy as np
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor
from torchvision.utils import save_image

from mmpi_ns.utils.errors import log


class MMPIPipeline(VanillaPipeline):
    """Pipeline that scores images at their exposure, and prints mean, worst and best PSNR and SSIM."""

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
        for name in dict.fromkeys(name for _, values in scores for name in values):
            each = [values[name] for _, values in scores if name in values]  # depth_error: where a depth is known
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
        """Metrics and pictures of an image, by its camera and its batch from the data set."""
        model: Any = self.model
        return model.get_image_metrics_and_images(self.outputs_of(camera, batch)[0], batch)

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


def summary(scores: list[tuple[str, dict[str, float]]]) -> str:
    """PSNR and SSIM of evaluated images, given by name and metrics, in a line."""
    psnr = [values["psnr"] for _, values in scores]
    worst, best = (scores[int(i)][0] for i in (np.argmin(psnr), np.argmax(psnr)))
    extremes = f"worst {min(psnr):.2f}, {worst}; best {max(psnr):.2f}, {best}"
    text = f"{len(scores)} images: PSNR {np.mean(psnr):.2f} dB ({extremes})"
    ssim = [values["ssim"] for _, values in scores if "ssim" in values]
    text += f", SSIM {np.mean(ssim):.3f} ({min(ssim):.3f} to {max(ssim):.3f})" if ssim else ""
    return text
