"""Colour maps, and text on pictures."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from views import Picture

WORST_ERROR = 0.3
"""Mean absolute colour error at the end of the scale; colours run over [0, 1]."""
INK, FAINT = (30, 30, 30), (110, 110, 110)


def error_colors(error: Picture) -> Picture:
    """Black (right) to yellow (off by 0.3 or more) for errors [H, W]."""
    return matplotlib.colormaps["inferno"](np.clip(error / WORST_ERROR, 0, 1))[..., :3].astype(np.float32)


def depth_colors(inverse_depth: Picture, nearest: float) -> Picture:
    """Dark (far) to bright (at ``nearest`` or nearer) for inverse distances [H, W]."""
    return matplotlib.colormaps["viridis"](np.clip(inverse_depth * nearest, 0, 1))[..., :3].astype(np.float32)


def over_checks(rgba: Picture, side: int = 6) -> Picture:
    """A half transparent picture [H, W, 4] over the usual checkerboard."""
    y, x = np.indices(rgba.shape[:2]) // side
    checks = np.where((x + y) % 2, 0.97, 0.86)[..., None]
    return (rgba[..., :3] * rgba[..., 3:] + checks * (1 - rgba[..., 3:])).astype(np.float32)


def image_of(picture: Picture, width: int | None = None) -> Image.Image:
    """An 8-bit image of a picture in [0, 1], resized where a width is given."""
    image = Image.fromarray((np.clip(picture, 0, 1) * 255).round().astype(np.uint8))
    if width is None or width == image.width:
        return image
    return image.resize((width, round(width * image.height / image.width)), Image.Resampling.LANCZOS)


def write(
    draw: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int = 13, bold: bool = False, fill=INK
) -> None:
    """Writes text, its top left corner at ``at``."""
    draw.text(at, text, fill=fill, font=font(size, bold), spacing=4)


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)


def rgb8(color: tuple[float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * c) for c in color)
    return r, g, b


def scale_bar(colors: NDArray[np.float32], width: int, height: int, labels: list[tuple[float, str]]) -> Image.Image:
    """A colour scale with labels below it.

    Args:
        colors: from left to right. [N, 3]
        width, height: of the bar alone, pixels.
        labels: (place in [0, 1], text).
    """
    bar = Image.new("RGB", (width + 60, height + 16), "white")
    bar.paste(image_of(np.broadcast_to(colors, (8, *colors.shape))).resize((width, height)), (2, 0))
    draw = ImageDraw.Draw(bar)
    for place, text in labels:
        x = 2 + place * (width - 1)
        draw.line([(x, height), (x, height + 3)], fill=INK)
        shift = place * font(11).getlength(text)
        write(draw, (x - min(shift, width * place), height + 3), text, 11)
    return bar
