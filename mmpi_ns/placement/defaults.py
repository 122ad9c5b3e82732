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


RAYS_PER_PROCESSOR = 256
"""Pixel rays of a step for each multiprocessor of a GPU. By its registers the march has eight programs of 16 rays there
at a time, so these and the rays of new views are some three rounds of them."""
MOST_RAYS_TIMES = 8
"""Largest multiple of a method's rays: steps become as many times fewer."""


def rays_times(method: str, processors: int) -> int:
    """How many times its rays a method draws in a step, in as many times fewer steps; a power of two.

    Args:
        method: with defaults.
        processors: multiprocessors of the GPU; 0 on a CPU.
    """
    fit = RAYS_PER_PROCESSOR * processors // DEFAULTS[method].rays
    return min(1 << max(fit, 1).bit_length() - 1, MOST_RAYS_TIMES)


def steps_for(method: str, pixels: float, times: int = 1) -> int:
    """Training steps of a window, in hundreds: more for captures of many pixels, as their square root.

    Args:
        method: with defaults.
        pixels: training pixels of the window.
        times: how many times the method's rays a step draws (``rays_times``).
    """
    multiple = min(max(1.0, (pixels / PIXELS) ** 0.5), MOST_TIMES)
    return 100 * round(DEFAULTS[method].steps * multiple / 100) // times
