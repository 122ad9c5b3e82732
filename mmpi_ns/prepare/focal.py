"""How well the images determine the focal length: how far it moves when something else that is assumed is let go."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pycolmap

from mmpi_ns.prepare.mapping import adjust, bundle_options

STARTS = (0.7, 1.2)
"""Focal lengths over the longer side that are tried where none is known: telephones and cars, then COLMAP's guess."""
PARTS = 20
"""Images from which the two halves of a capture are asked on their own."""
WIDE = 0.08
"""Width of the interval, as a share of the focal length, from which to ask for --focal."""


def focal_interval(folder: Path, threads: int) -> tuple[float, float]:
    """Focal lengths, in pixels, that bundle adjustments of one model end at under different assumptions.

    They are: the principal point in the middle; free; and each half of the images on its own. The statistical error of
    one adjustment is far smaller and says little: what is wrong is what was assumed. Of several cameras the first.

    Args:
        folder: of the model; read anew for each adjustment.
        threads: CPU threads; below 1 for all.
    """
    model = pycolmap.Reconstruction(folder)
    ids = sorted(model.reg_image_ids())
    found = [_first_focal(model)]
    found.append(_after(folder, lambda m: None, True, threads))
    if len(ids) >= PARTS:
        for part in (ids[: len(ids) // 2], ids[len(ids) // 2 :]):
            found.append(_after(folder, lambda m, part=part: _keep(m, part), False, threads))
    return min(found), max(found)


def _after(
    folder: Path, change: Callable[[pycolmap.Reconstruction], None], principal_point: bool, threads: int
) -> float:
    model = pycolmap.Reconstruction(folder)
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
