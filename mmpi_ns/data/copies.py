"""Downscaled copies of images: their originals, and cameras that fit them exactly."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.files import opened

COPIES = re.compile(r"(.+)_(\d+)")
"""Name of a folder of downscaled copies: that of the originals, and the factor."""


def original_of(file: Path) -> tuple[Path, int]:
    """The original of a downscaled copy (``images/x.jpg`` of ``images_2/x.jpg``) and its factor, or the file and 1."""
    for folder in file.parents:
        if name := COPIES.fullmatch(folder.name):
            original = folder.parent / name[1] / file.relative_to(folder)
            if original.is_file():
                return original, int(name[2])
    return file, 1


def size_of(file: Path) -> NDArray[np.float64]:
    """Width and height of an image file. Raises InputError that names the file if it cannot be read."""
    with opened(file) as image:
        return np.array(image.size, np.float64)


def size_as_read(size: NDArray[np.float64], camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width and height of a file of this size according to its camera, which may lack a last row or column, or have
    another size if files are reduced when they are read."""
    return np.where(np.abs(size - camera) <= 1, size, camera)


def whole_of(file: Path, size: NDArray[np.float64]) -> tuple[Path, NDArray[np.float64], NDArray[np.float64]]:
    """Original of a downscaled copy, its size, and its pixels (columns, rows) per pixel of the copy.

    A file, of this width and height, without an original, or whose original has another shape, stands for itself.
    Raises InputError naming an image file that cannot be read.
    """
    original, factor = original_of(file)
    if factor > 1:
        whole = size_of(original)
        if (np.abs(whole - factor * size) <= factor).all():
            is_cut = (factor * size < whole).any() and (factor * size <= whole).all() and _is_cut(file.parent)
            return original, whole, np.full(2, float(factor)) if is_cut else whole / size
    return file, size, np.ones(2)


@lru_cache(maxsize=64)
def _is_cut(folder: Path) -> bool:
    """Whether downscaled copies leave out the last columns and rows of originals that are no multiple of the factor.

    Other programs reduce the whole image to a size that they round. The first such copy is compared with both.
    """
    for file in sorted(folder.iterdir()):
        original, factor = original_of(file)
        if factor > 1:
            with suppress(OSError), Image.open(original) as whole, Image.open(file) as copy:
                width, height = copy.size
                if (factor * width, factor * height) != whole.size:
                    gray, reduced_gray = whole.convert("L"), np.asarray(copy.convert("L"), float)
                    cut = gray.crop((0, 0, factor * width, factor * height)).reduce(factor)
                    reduced = gray.resize(copy.size, Image.Resampling.BOX)
                    errors = [np.square(np.asarray(image, float) - reduced_gray).sum() for image in (cut, reduced)]
                    return errors[0] < errors[1]
    return False


def fit_cameras(outputs: DataparserOutputs, factor: int | None) -> DataparserOutputs:
    """The parser's outputs with cameras that fit downscaled copies, in place.

    The parser divides intrinsics by the factor. Most copies show the whole image, rounded: 1242 x 375 pixels become
    310 x 93, which are no quarter.
    """
    for i, file in enumerate(outputs.image_filenames if factor is not None and factor > 1 else ()):
        with suppress(InputError):  # an image that cannot be read is named when it is read
            original, _, scale = whole_of(Path(file), size_of(Path(file)))
            if original != file:
                for name, ratio in zip(("fx", "fy", "cx", "cy"), np.tile((factor or 1) / scale, 2), strict=True):
                    getattr(outputs.cameras, name)[i] *= ratio
    return outputs
