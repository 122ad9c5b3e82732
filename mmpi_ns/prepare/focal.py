"""How well the images determine the focal length: how much it changes under other assumptions."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pycolmap

from mmpi_ns.prepare.mapping import adjust, bundle_options
from mmpi_ns.prepare.polish import with_fewer_points

STARTS = (0.7, 1.2)
"""Focal lengths over the longer side that are tried where none is known: telephones and cars, then COLMAP's guess."""
PARTS = 20
"""Number of images from which the two halves of a capture are also used separately."""
WIDE = 0.08
"""Width of the interval, relative to the focal length, from which --focal is asked for."""


def focal_interval(model: pycolmap.Reconstruction, threads: int) -> tuple[float, float]:
    """Focal lengths, in pixels, that bundle adjustments of one model end at under different assumptions.

    Principal point in the middle; principal point free; each half of the images alone. The statistical error of one
    adjustment is far smaller and means little, because the assumptions dominate. Of several cameras, the first.

    Args:
        model: not changed.
        threads: CPU threads; below 1 for all.
    """
    light = with_fewer_points(model)
    ids = sorted(model.reg_image_ids())
    found = [_first_focal(model)]
    found.append(_after(light, lambda m: None, True, threads))
    if len(ids) >= PARTS:
        for part in (ids[: len(ids) // 2], ids[len(ids) // 2 :]):
            found.append(_after(light, lambda m, part=part: _keep(m, part), False, threads))
    return min(found), max(found)


def _after(
    light: pycolmap.Reconstruction,
    change: Callable[[pycolmap.Reconstruction], None],
    principal_point: bool,
    threads: int,
) -> float:
    model = copy.deepcopy(light)
    change(model)
    adjust(model, bundle_options(True, True, principal_point, threads, robust=True))
    return _first_focal(model)


def _keep(model: pycolmap.Reconstruction, images: list[int]) -> None:
    for image_id in set(model.reg_image_ids()) - set(images):
        model.deregister_frame(model.images[image_id].frame_id)


def _first_focal(model: pycolmap.Reconstruction) -> float:
    first = model.images[min(model.reg_image_ids())]
    return float(model.cameras[first.camera_id].mean_focal_length())


def focal_in_words(low: float, high: float) -> str:
    """The interval of a focal length, for the report."""
    return f"between {low:.1f} and {high:.1f} px, {(high - low) / high:.1%} wide"
