"""nerfstudio's pipeline, whose evaluation says its figures and not only writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from mmpi_ns.utils.console import say


class MMPIPipeline(VanillaPipeline):
    """Prints PSNR and SSIM of evaluated images, with the worst and the best of them."""

    def get_average_image_metrics(self, data_loader: Any, image_prefix: str, *args: Any, **kwargs: Any) -> Any:
        """Means over the images of a loader, as nerfstudio's, and a line about them."""
        found: list[tuple[int, dict[str, float]]] = []
        model: Any = self.model
        measure = model.get_image_metrics_and_images

        def noted(outputs: Any, batch: Any) -> Any:
            values, images = measure(outputs, batch)
            found.append((int(batch["image_idx"]), dict(values)))
            return values, images

        model.get_image_metrics_and_images = noted
        try:
            means = super().get_average_image_metrics(data_loader, image_prefix, *args, **kwargs)
        finally:
            del model.get_image_metrics_and_images
        names = [Path(name).name for name in data_loader.input_dataset.image_filenames]
        say(summary([(names[i], values) for i, values in found]))
        return means


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
    return text + (f", SSIM {np.mean(ssim):.3f} ({min(ssim):.3f} to {max(ssim):.3f})" if ssim else "")
