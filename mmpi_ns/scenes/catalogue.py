"""The scenes by name."""

from __future__ import annotations

from mmpi_ns.scenes.scene import Scene
from mmpi_ns.scenes.street import long_road, street


def make_scene(name, seed=0, width=320, height=96, count=64, length=40.0):
    return {"street": street, "long-road": long_road}[name](seed, count, width, height, length)
