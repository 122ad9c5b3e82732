"""Details of training images in a baked scene: residuals and depths as WebP, which browsers can read."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import interpolate

from mmpi_ns.rendering.details import DetailView

STEP = 1 / 381
"""Step of the codes of residuals: two thirds of a grey level."""
ZERO = 128
"""Code of a residual of 0."""
QUALITY = 80
"""WebP quality of residuals."""
COARSE = 4
"""Downscale factor of depths."""
MOST_SIDE = 2048
"""Maximum side of a residual image, pixels; larger ones are reduced."""


@dataclass(frozen=True)
class StoredView:
    """A training image, as ``DetailView``, encoded."""

    camera: tuple[float, ...]
    """As ``DetailView.camera``, for an image of this size."""
    size: tuple[int, int]
    """Width and height, pixels."""
    most: float
    """Inverse distance of code 255."""
    difference: bytes
    """Codes of red, green and blue."""
    inverse: bytes
    """Codes of inverse distances, without loss: 0 is masked."""


def stored_view(view: DetailView) -> StoredView:
    """The encoded form of a training image."""
    masked = view.image[..., 3:] < 0
    planes = torch.where(masked, 0.0, view.image[..., :3]).movedim(-1, 0)[None]
    height, width = planes.shape[2:]
    scale = min(1.0, MOST_SIDE / max(height, width))
    if scale < 1:
        height, width = (max(1, round(scale * x)) for x in (height, width))
        planes = interpolate(planes, (height, width), mode="area")
    camera = view.camera.clone()
    camera[12:16] *= torch.tensor([width, height] * 2) / torch.tensor([view.image.shape[1], view.image.shape[0]] * 2)
    inverse = view.image[None, None, ..., 3].float()
    inverse = interpolate(inverse, (-(-height // COARSE), -(-width // COARSE)), mode="nearest-exact")[0, 0]
    most = max(float(inverse.max()), 1e-12)
    depths = torch.where(inverse < 0, 0, 1 + (254 * (inverse.clamp(min=0) / most).sqrt()).round())
    colours = (ZERO + planes[0].movedim(0, -1) / STEP).round().clamp(0, 255)
    files = io.BytesIO(), io.BytesIO()
    for file, codes, how in zip(files, (colours, depths), ({"quality": QUALITY}, {"lossless": True}), strict=True):
        Image.fromarray(codes.to(torch.uint8).cpu().numpy()).convert("RGB").save(file, "WEBP", method=6, **how)
    numbers = tuple(float(f"{x:.8g}") for x in camera.tolist())
    return StoredView(numbers, (width, height), most, *(file.getvalue() for file in files))


def restored_view(view: StoredView, device: torch.device) -> DetailView:
    """The training image of a ``StoredView``, as accurate as its codes.

    Raises:
        OSError: an image is damaged.
    """
    width, height = view.size
    depths, colours = (
        torch.from_numpy(np.array(Image.open(io.BytesIO(data)).convert("RGB"))).float()
        for data in (view.inverse, view.difference)
    )
    codes = interpolate(depths[None, None, ..., 0], (height, width), mode="bilinear", align_corners=False)[0, 0]
    inverse = view.most * ((codes - 1).clamp(min=0) / 254).square()
    image = torch.cat([STEP * (colours - ZERO), torch.where(codes < 0.5, -1.0, inverse)[..., None]], -1)
    return DetailView(image.to(device), torch.tensor(view.camera, device=device))
