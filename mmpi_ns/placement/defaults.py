"""Placement defaults of mmpi and mmpi-small: settings and training rays. Quick to import."""

from __future__ import annotations

from dataclasses import dataclass

from mmpi_ns.placement.rule import PlacementConfig


@dataclass(frozen=True)
class Default:
    """What the size of a method's texels follows from."""

    steps: int
    rays: int
    """Of a step."""
    placement: PlacementConfig


DEFAULTS = {
    "mmpi": Default(20000, 4096, PlacementConfig(texel_pixels=1.2, max_planes=256, max_texels=200e6)),
    "mmpi-small": Default(4000, 1024, PlacementConfig(texel_pixels=1.2)),
}
