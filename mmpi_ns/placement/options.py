"""Valid values of the options of placement."""

from __future__ import annotations

from mmpi_ns.placement.rule import PlacementConfig
from mmpi_ns.scene.plan import MOST_PLANES, MOST_TEXELS, MOST_VOXELS
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.values import Number, check_options, shown

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


def check_placement(config: PlacementConfig, prefix: str) -> None:
    """Raises InputError naming the option whose value cannot be used.

    Args:
        config: the rule's settings.
        prefix: of the options on the command line, "--placement." for example.
    """
    check_options(config, RANGES, prefix)
    if not config.faces or not set(config.faces) <= set(FACES):
        raise InputError(f"{prefix}faces must be some of {', '.join(FACES)}, not {shown(config.faces)}.")
