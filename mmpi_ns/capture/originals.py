"""Training images at their original size, if the data parser lists downscaled copies.

A data parser with a downscale factor N reads ``images_N/x.jpg``; the original lies beside it as ``images/x.jpg``.
Features are detected and depths measured in the originals, which are sharper.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from mmpi_ns.capture.tracks import PosedImages
from mmpi_ns.utils.errors import InputError, brief

COPIES = re.compile(r"(.+)_(\d+)")
"""Name of a folder of downscaled copies: that of the originals, and the factor."""


def original_of(file: Path) -> tuple[Path, int]:
    """The original of an image file and its downscale factor; the file itself and 1 where there is none."""
    for folder in file.parents:
        found = COPIES.fullmatch(folder.name)
        if found:
            original = folder.parent / found[1] / file.relative_to(folder)
            if original.is_file():
                return original, int(found[2])
    return file, 1


def at_full_size(images: PosedImages) -> PosedImages:
    """The same views in their originals, with exact cameras; a view whose original has another shape is kept.

    A copy shows the whole original, however its size was rounded: a position relative to width and height is the same
    in both. Focal lengths are those of the copy times the factor, as nerfstudio divided them by it.

    Raises:
        InputError: an image file cannot be read (names it).
    """
    files, sizes, intrinsics = [], images.sizes.copy(), images.intrinsics.copy()
    for i, file in enumerate(images.files):
        original, factor = original_of(file)
        real = np.array(_size(original), np.float64)
        if factor > 1 and (np.abs(real - factor * images.sizes[i]) > factor).any():
            original, factor, real = file, 1, np.array(_size(file), np.float64)
        files.append(original)
        sizes[i] = real
        intrinsics[i] *= factor
    return replace(images, files=tuple(files), sizes=sizes, intrinsics=intrinsics)


def _size(file: Path) -> tuple[int, int]:
    try:
        with Image.open(file) as image:
            return image.size
    except OSError as error:
        raise InputError(
            f"Training image {file} cannot be read ({brief(error)}): repair it or remove its frame."
        ) from error
