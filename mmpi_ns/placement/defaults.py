"""Defaults of mmpi and mmpi-small that follow the capture: placement, and the length of training. Quick to import."""

from __future__ import annotations

from dataclasses import dataclass

from mmpi_ns.placement.rule import PlacementConfig


@dataclass(frozen=True)
class Default:
    """What the size of a method's texels follows from."""

    steps: int
    """Of a small capture."""
    rays: int
    """Of a step."""
    placement: PlacementConfig


DEFAULTS = {
    "mmpi": Default(20000, 4096, PlacementConfig(texel_pixels=1.2, max_planes=256, max_texels=200e6)),
    "mmpi-small": Default(4000, 1024, PlacementConfig(texel_pixels=1.2)),
}
PIXELS = 6e6
"""Training pixels of a window up to which it is a small capture."""
MOST_TIMES = 4.0
"""Largest multiple of a small capture's steps."""


def steps_for(method: str, pixels: float) -> int:
    """Training steps of a window, in hundreds: more for captures of many pixels, as their square root.

    Args:
        method: with defaults.
        pixels: training pixels of the window.
    """
    times = min(max(1.0, (pixels / PIXELS) ** 0.5), MOST_TIMES)
    return 100 * round(DEFAULTS[method].steps * times / 100)
