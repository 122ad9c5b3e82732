"""Exposure of procedural images: gains that follow the content, white balance, vignetting and a tone curve, all exact.

    pixel value = tone(min(1, gain * (1 - vignetting * r^2) * light)),    r = 1 in the corners

Light is what the tone curve makes the scene's colours of, so that a gain of 1 without vignetting changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.synthetic.cameras import Array, Cameras
from mmpi_ns.synthetic.scene import Colors, Scene

ExposureName = Literal["none", "auto", "vignetting"]
GAMMA, CONTRAST = 2.2, 0.3
"""tone(x) = y + CONTRAST y (1 - y) (2 y - 1) with y = x^(1 / GAMMA)."""
RANGE, WHITE_BALANCE = 3.0, 0.1
"""Ratio of the largest and the least automatic gain; largest change of red and of blue, opposite to each other."""
LAG = 4.0
"""Images over which an automatic exposure follows the content."""
METERED = 24, 16
"""Rays across and down an image by which its light is measured."""
LOST = {"auto": 0.3, "vignetting": 0.5}
"""Share of the light that is lost in the corners."""
SECONDS, SPEED, APERTURE = 0.01, 100, 1.8
"""What EXIF says of an image whose gain is 1."""
KNOTS = np.linspace(0.0, 1.0, 1 << 14)


def tone(light: NDArray[Any]) -> Array:
    """Pixel values in [0, 1] of light in [0, 1]."""
    y = np.asarray(light, np.float64) ** (1 / GAMMA)
    return y + CONTRAST * y * (1 - y) * (2 * y - 1)


def light_of(values: NDArray[Any]) -> Array:
    """Light in [0, 1] of pixel values in [0, 1]: the inverse of ``tone``."""
    return np.interp(values, tone(KNOTS**GAMMA), KNOTS) ** GAMMA


@dataclass(frozen=True)
class Exposure:
    """Exposures of M images."""

    gains: Array
    """[M, 3] factors on red, green and blue light."""
    vignetting: float
    """Share of the light that is lost in the corners."""

    def expose(self, cameras: Cameras, camera: int, colors: Colors) -> Colors:
        """Pixel values [H, W, 3] of an image whose colours with a gain of 1 are [H, W, 3]."""
        offset = (cameras.pixel_centers - cameras.center) / np.hypot(*cameras.center)
        passed = (1 - self.vignetting * (offset**2).sum(-1)).reshape(cameras.height, cameras.width, 1)
        return tone(np.minimum(1, self.gains[camera] * passed * light_of(colors))).astype(np.float32)

    def exif(self, camera: int) -> Image.Exif:
        """EXIF of an image: the gain of green is its exposure time."""
        exif = Image.Exif()
        seconds = Fraction(SECONDS * self.gains[camera, 1]).limit_denominator(10**6)
        exif[0x8769] = {33434: float(seconds), 33437: APERTURE, 34855: SPEED}  # its own directory: time, f-number, ISO
        return exif

    def to_object(self, names: list[str]) -> dict[str, Any]:
        """What is written beside the images."""
        return {
            "model": "value = tone(min(1, gain * (1 - vignetting * r^2) * light)), r = 1 in the corners; "
            "tone(x) = y + contrast * y * (1 - y) * (2 * y - 1), y = x^(1 / gamma)",
            "gamma": GAMMA,
            "contrast": CONTRAST,
            "vignetting": self.vignetting,
            "gains": {name: gains.tolist() for name, gains in zip(names, self.gains, strict=True)},
        }


def make_exposure(name: ExposureName, scene: Scene) -> Exposure | None:
    """Exposures of a scene's images.

    Args:
        name: none: one exposure, pixel values are the scene's colours. auto: gains follow what an image sees, a few
            images late, three-fold between the darkest and the brightest; white balance wanders by a tenth.
            vignetting: one exposure, half of the light lost in the corners.
        scene: with its cameras in the order in which they took the images.
    """
    if name == "none":
        return None
    count, log_gains = len(scene.cameras), np.zeros((len(scene.cameras), 3))
    if name == "auto":
        cameras, (across, down) = scene.cameras, METERED
        x, y = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(down) + 0.5) / down)
        pixels: Array = np.stack([x, y], -1).reshape(-1, 2) * np.array([cameras.width, cameras.height], np.float64)
        pixel = cameras.width / across / cameras.focal
        seen = (scene.trace(*cameras.rays(i, pixels), pixel)[1] for i in range(count))
        followed = np.log([float(light_of(colors).mean()) for colors in seen])
        for i in range(1, count):
            followed[i] += (1 - 1 / LAG) * (followed[i - 1] - followed[i])
        spread = np.ptp(followed)
        if spread > 0:
            log_gains -= ((followed - np.median(followed)) * np.log(RANGE) / spread)[:, None]
        random = np.random.default_rng([scene.seed, 18])
        period, phase = random.uniform(40, 90), random.uniform(0, 2 * np.pi)
        warmth = np.log1p(WHITE_BALANCE) * np.sin(2 * np.pi * np.arange(count) / period + phase)
        log_gains += warmth[:, None] * [1.0, 0.0, -1.0]
    return Exposure(np.exp(log_gains), LOST[name])
