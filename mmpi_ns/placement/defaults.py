"""Options of placement: valid values, and defaults that follow the method and the capture. Quick to import."""

from __future__ import annotations

from dataclasses import dataclass

from mmpi_ns.placement.rule import PlacementConfig
from mmpi_ns.scene.plan import MOST_PLANES, MOST_TEXELS, MOST_VOXELS
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.values import Number, check_options, shown


@dataclass(frozen=True)
class Default:
    """Length of a method's training and its placement, from which the size of texels follows."""

    steps: int
    """Training steps of a small capture."""
    rays: int
    """Rays of a step."""
    placement: PlacementConfig


DEFAULTS = {
    "mmpi": Default(20000, 4096, PlacementConfig(texel_pixels=1.2, max_planes=256, max_texels=200e6)),
    "mmpi-small": Default(4000, 1024, PlacementConfig(texel_pixels=1.2)),
}
PIXELS = 6e6
"""Training pixels of a window up to which it is a small capture."""
MOST_TIMES = 4.0
"""Largest multiple of a small capture's steps."""
POSITIVE, NOT_NEGATIVE = Number(0, above=True), Number(0)
RANGES = {
    "max_mpis": Number(1, 10_000, whole=True),
    "max_texels": NOT_NEGATIVE,
    "min_gain": NOT_NEGATIVE,
    "planes": Number(2, MOST_PLANES, whole=True),
    "max_planes": Number(2, MOST_PLANES, whole=True),
    "plane_pixels": POSITIVE,
    "texel_pixels": POSITIVE,
    "rays_per_texel": NOT_NEGATIVE,
    "texels_per_ray": NOT_NEGATIVE,
    "height": Number(2, MOST_TEXELS, whole=True),
    "width": Number(2, MOST_TEXELS, whole=True),
    "enough": POSITIVE,
    "texel_cost": NOT_NEGATIVE,
    "max_voxels": Number(0, MOST_VOXELS, whole=True),
    "window_length": NOT_NEGATIVE,
    "drive_pull_back": NOT_NEGATIVE,
    "cube_voxels": Number(0, MOST_VOXELS, whole=True),
}
FACES = ("front", "left", "right", "below")


def steps_for(method: str, pixels: float) -> int:
    """Training steps of a window, in hundreds: more for captures of many pixels, as their square root.

    Args:
        method: with defaults.
        pixels: training pixels of the window.
    """
    times = min(max(1.0, (pixels / PIXELS) ** 0.5), MOST_TIMES)
    return 100 * round(DEFAULTS[method].steps * times / 100)


def check_placement(config: PlacementConfig, prefix: str) -> None:
    """Raises InputError naming the option whose value cannot be used.

    Args:
        config: the rule's settings.
        prefix: of the options on the command line, "--placement." for example.
    """
    check_options(config, RANGES, prefix)
    if not config.faces or not set(config.faces) <= set(FACES):
        raise InputError(f"{prefix}faces must be some of {', '.join(FACES)}, not {shown(config.faces)}.")
