"""Image metrics: PSNR, SSIM, and LPIPS if its weights are available."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.nn.functional import pad

MOST_SORTED = 1 << 20
"""Pixels used for the brightness range of a depth image; torch computes quantiles of at most 16.7 M."""
PART = 1 << 18
"""Pixels compared at once: all of a 12-megapixel photo would take 8 GiB."""
WINDOW = 11
"""Side of SSIM's window, pixels."""


@dataclass(eq=False)
class ImageMetrics:
    """Metrics of a rendered image. LPIPS downloads its weights on first use and is omitted without them."""

    lpips_net: Literal["vgg", "alex", "none"]

    @torch.no_grad()
    def __call__(self, predicted: Float[Tensor, "H W 3"], observed: Float[Tensor, "H W 3"]) -> dict[str, float]:
        from nerfstudio.model_components.lib_bilagrid import color_correct  # imports tensorly: a second

        values = psnr_and_ssim(predicted, observed)
        with suppress(AssertionError):  # a grey image has no fit
            corrected = color_correct(predicted.float(), observed.float())  # as in nerfstudio's splatfacto
            values["cc_psnr"] = psnr(corrected, observed)
        if self._lpips is not None:
            a, b = (torch.moveaxis(x, -1, 0)[None].float().clamp(0, 1) for x in (predicted, observed))
            values[f"lpips_{self.lpips_net}"] = float(self._lpips.to(a.device)(a, b))
        return values

    @cached_property
    def _lpips(self) -> nn.Module | None:
        if self.lpips_net == "none":
            return None
        try:
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

            return LearnedPerceptualImagePatchSimilarity(net_type=self.lpips_net, normalize=True)
        except (OSError, RuntimeError, ImportError) as error:
            CONSOLE.print(
                f"[yellow]LPIPS is left out: the weights of its {self.lpips_net} network are not "
                f"available ({type(error).__name__}). Put them into torch's hub cache to get it."
            )
            return None


def psnr_and_ssim(predicted: Float[Tensor, "H W 3"], observed: Float[Tensor, "H W 3"]) -> dict[str, float]:
    """PSNR and SSIM of an image in [0, 1]; PSNR alone if it is smaller than SSIM's window."""
    values = {"psnr": psnr(predicted, observed)}
    return values if min(predicted.shape[:2]) < WINDOW else values | {"ssim": ssim(predicted, observed)}


def psnr(predicted: Float[Tensor, "*N 3"], observed: Float[Tensor, "*N 3"]) -> float:
    """PSNR of colours in [0, 1], dB; at most 120."""
    parts = zip(predicted.reshape(-1, 3).split(PART), observed.reshape(-1, 3).split(PART), strict=True)
    squares = [((a.double() - b.double()) ** 2).sum() for a, b in parts]
    return float(-10 * torch.log10((torch.stack(squares).sum() / predicted.numel()).clamp(min=1e-12)))


def ssim(predicted: Float[Tensor, "H W 3"], observed: Float[Tensor, "H W 3"]) -> float:
    """Mean structural similarity of the windows about all pixels of two images in [0, 1], mirrored at their borders."""
    from torchmetrics.functional.image import structural_similarity_index_measure  # imports scipy.signal: seconds

    height, width = predicted.shape[:2]
    rows, total, border = max(1, PART // width), 0.0, WINDOW // 2
    images = [torch.moveaxis(x, -1, 0)[None].float() for x in (predicted, observed)]
    a, b = (pad(x, (0, 0, border, border), "reflect") for x in images)
    for first in range(0, height, rows):
        part = slice(first, min(first + rows, height) + 2 * border)
        _, values = structural_similarity_index_measure(
            a[:, :, part], b[:, :, part], data_range=1.0, return_full_image=True
        )
        total += float(values[:, :, border:-border].double().sum())
    return total / predicted.numel()


def pictures(observed: Float[Tensor, "H W 3"], outputs: dict[str, Tensor], num_heads: int) -> dict[str, Tensor]:
    """Pictures of a rendered image's outputs."""
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
