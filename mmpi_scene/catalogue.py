"""The scenes by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mmpi_scene import indoor, street
from mmpi_scene.scene import Scene


@dataclass(frozen=True)
class Entry:
    """A kind of scene and its default options."""

    make: Any
    """(seed, count, width, height[, length]) -> Scene."""
    width: int = 240
    height: int = 160
    count: int = 64
    length: float | None = None
    """Metres driven or walked; None: it has no length."""


SCENES: dict[str, Entry] = {
    "street": Entry(street.street, 320, 96, 64, 40.0),
    "long-road": Entry(street.long_road, 320, 96, 0, 1000.0),
    "walk": Entry(street.walk, 960, 540, 300, 60.0),
    "room": Entry(indoor.room),
    "look-round": Entry(indoor.look_round, count=36),
    "object": Entry(indoor.orbited, count=48),
}
FRAME_SPACING = 1.5
"""Metres between the images of a long road."""


def make_scene(
    name: str,
    seed: int = 0,
    count: int | None = None,
    width: int | None = None,
    height: int | None = None,
    length: float | None = None,
) -> Scene:
    """A scene of the catalogue, with ``count`` images of this size and a drive of this length in metres; equal
    arguments give equal scenes. Raises ValueError if there is no such scene, or it cannot be made like this."""
    if name not in SCENES:
        raise ValueError(f"There is no scene {name!r}: choose one of {', '.join(SCENES)}.")
    entry = SCENES[name]
    sizes = {"width": entry.width if width is None else width, "height": entry.height if height is None else height}
    if length is not None and entry.length is None:
        raise ValueError(f"The scene {name} has no length: leave it out, or choose street, long-road or walk.")
    drive: dict[str, float] = {} if entry.length is None else {"length": entry.length if length is None else length}
    images = count if count is not None else entry.count or int(drive["length"] / FRAME_SPACING) + 1
    for what, value in {"count": images, **sizes, **drive}.items():
        if not value > 0:
            raise ValueError(f"The {what} of a scene must be positive, not {value}.")
    return entry.make(seed, images, *sizes.values(), *drive.values())
