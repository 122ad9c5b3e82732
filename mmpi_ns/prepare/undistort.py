"""Undistortion of images, masks and keypoints to a pinhole camera, by COLMAP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from mmpi_ns.capture.matching import quiet
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import progress

QUALITY = 97
"""Of JPEG."""


def undistort(
    model: pycolmap.Reconstruction,
    photos: Sequence[Photo],
    images: Path,
    masks: Path | None,
    target: Path,
    threads: int,
) -> tuple[pycolmap.Reconstruction, list[Photo]]:
    """Writes undistorted images, with their EXIF, and masks.

    Args:
        model: not changed.
        photos: registered images.
        images: folder of the images.
        masks: folder of the masks (``NAME.png``), or None.
        target: gets ``images`` and ``masks``.
        threads: CPU threads; below 1 for all.

    Returns:
        The model with pinhole cameras and moved keypoints, and the images with their new sizes.
    """
    (target / "bent").mkdir(parents=True)
    model.write(target / "bent")
    names = [photo.name for photo in photos]
    with progress("Undistorting", 1) as advance, quiet():
        pycolmap.undistort_images(
            target, target / "bent", images, image_names=names, jpeg_quality=QUALITY, num_threads=threads
        )
        advance()
    flat = pycolmap.Reconstruction(target / "sparse")
    flat.update_point_3d_errors()
    flat_photos = []
    for photo in photos:
        number = next(i.camera_id for i in model.images.values() if i.name == photo.name)
        with Image.open(images / photo.name) as image:
            alpha = image.getchannel("A") if image.mode == "RGBA" else None
        if alpha is not None:  # COLMAP reads colours alone
            with Image.open(target / "images" / photo.name) as image:
                tags = image.getexif()
                image.putalpha(_undistort_mask(alpha, model.cameras[number]))
            image.save(target / "images" / photo.name, exif=tags)
        if masks is not None:
            (target / "masks").mkdir(exist_ok=True)
            with Image.open(masks / f"{photo.name}.png") as mask:
                flat_mask = _undistort_mask(mask, model.cameras[number]).point(lambda v: 255 if v == 255 else 0)
            flat_mask.save(target / "masks" / f"{photo.name}.png")
        size = flat.cameras[number]
        flat_photos.append(replace(photo, width=size.width, height=size.height, exif_focal=None))
    return flat, flat_photos


def _undistort_mask(mask: Image.Image, camera: pycolmap.Camera) -> Image.Image:
    bitmap = pycolmap.Bitmap.from_array(np.asarray(mask))
    flat, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, camera)
    return Image.fromarray(flat.to_array())
