"""Image metrics: PSNR, SSIM, and LPIPS if its weights are available."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torchmetrics.functional.image import structural_similarity_index_measure

MOST_SORTED = 1 << 20
"""Pixels used for the brightness range of a depth image; torch computes quantiles of at most 16.7 M."""


class ImageMetrics:
    """Metrics of a rendered image. LPIPS downloads its weights on first use and is left out without them."""

    def __init__(self, lpips_net: Literal["vgg", "alex", "none"]) -> None:
        self.lpips_net: Literal["vgg", "alex", "none"] = lpips_net
        self._lpips: nn.Module | None = None
        self._lpips_tried = False

    @torch.no_grad()
    def __call__(self, predicted: Float[Tensor, "H W 3"], observed: Float[Tensor, "H W 3"]) -> dict[str, float]:
        a, b = (torch.moveaxis(x, -1, 0)[None].float() for x in (predicted, observed))
        values = {"psnr": psnr(predicted, observed)}
        if min(a.shape[-2:]) >= 11:  # SSIM's window
            ssim = structural_similarity_index_measure(a, b, data_range=1.0)
            assert isinstance(ssim, Tensor)
            values["ssim"] = float(ssim)
        values |= {"cc_psnr": psnr(color_corrected(predicted, observed), observed)}
        if self.lpips_net != "none" and not self._lpips_tried:
            self._lpips_tried = True
            try:
                from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

                metric = LearnedPerceptualImagePatchSimilarity(net_type=self.lpips_net, normalize=True)
                self._lpips = metric.to(a.device)
            except (OSError, RuntimeError, ImportError) as error:
                CONSOLE.print(
                    f"[yellow]LPIPS is left out: the weights of its {self.lpips_net} network are not "
                    f"available ({type(error).__name__}). Put them into torch's hub cache to get it."
                )
        if self._lpips is not None:
            values[f"lpips_{self.lpips_net}"] = float(self._lpips(a.clamp(0, 1), b.clamp(0, 1)))
        return values


def psnr(predicted: Float[Tensor, "*N 3"], observed: Float[Tensor, "*N 3"]) -> float:
    """PSNR of colours in [0, 1], dB; at most 120."""
    mse = ((predicted.double() - observed.double()) ** 2).mean().clamp(min=1e-12)
    return float(-10 * torch.log10(mse))


def color_corrected(predicted: Float[Tensor, "H W 3"], observed: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """The affine map of the predicted colours (a matrix and an offset) that comes nearest to the observed ones.

    Source: ``cc_psnr`` of nerfstudio's splatfacto, after MultiNeRF.
    """
    colors = predicted.reshape(-1, 3).double()
    design = torch.cat([colors, torch.ones_like(colors[:, :1])], -1)
    # Normal equations with a little of the identity: images of one colour have many solutions.
    normal = design.T @ design + 1e-6 * len(design) * torch.eye(4, dtype=design.dtype, device=design.device)
    target = design.T @ (observed.reshape(-1, 3).double() - colors)
    return (colors + design @ torch.linalg.solve(normal, target)).clamp(0, 1).view(predicted.shape).to(predicted)


def depth_metrics(predicted: Float[Tensor, "H W 1"], true: Float[Tensor, "H W 1"]) -> dict[str, float]:
    """Relative error of rendered distances at the pixels with a true one: median, and fraction above a tenth."""
    measured = true > 0
    if not bool(measured.any()):
        return {}
    error = (predicted[measured] / true[measured] - 1).abs()
    return {"depth_error": float(error.median()), "depth_outliers": float((error > 0.1).float().mean())}


def pictures(observed: Float[Tensor, "H W 3"], outputs: dict[str, Tensor], num_heads: int) -> dict[str, Tensor]:
    """Images for display of a rendered image."""
    near = 1 / outputs["depth"].clamp(min=1e-9)
    some = near.flatten()[:: 1 + near.numel() // MOST_SORTED]
    return {
        "img": torch.cat([observed, outputs["rgb"]], 1),
        "accumulation": outputs["accumulation"].expand(-1, -1, 3),
        "inverse_depth": (near / some.quantile(0.98).clamp(min=1e-9)).clamp(0, 1).expand(-1, -1, 3),
        "winning_mpi": head_palette(num_heads, observed.device)[outputs["winning_mpi"][..., 0].long()],
    }


def head_palette(count: int, device: torch.device | str) -> Float[Tensor, "H 3"]:
    """Distinct colours, one for each head."""
    hue = torch.arange(count, dtype=torch.float32, device=device) * 0.61803 % 1
    return 0.5 + 0.45 * torch.cos(2 * torch.pi * (hue[:, None] - torch.tensor([0.0, 1 / 3, 2 / 3], device=device)))
