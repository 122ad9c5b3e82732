"""Masks of moving objects in the training images of a prepared scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import torch
from PIL import Image

from mmpi_ns.data.posed_images import PosedImages
from mmpi_prepare.images import Photo
from mmpi_prepare.poses import opencv_intrinsics
from mmpi_priors.moving import draw_moving, moving_masks


def write_masks(
    model: pycolmap.Reconstruction,
    photos: Sequence[Photo],
    train: Sequence[str],
    images: Path,
    target: Path,
    picture: Path,
    threads: int,
) -> tuple[dict[str, float], str]:
    """Finds what moves in the training images, which alone are compared; where anything does, writes a mask for each
    photo, ``target/NAME.png``, white where used and of test images, and a picture.

    Returns the masked share of each image with moving objects, by name, and the doubt of ``find_moving``.
    """
    if threads > 0:
        torch.set_num_threads(threads)
    entries = [model.images[i] for i in sorted(model.reg_image_ids()) if model.images[i].name in set(train)]
    poses = np.array([entry.cam_from_world().inverse().matrix() for entry in entries], np.float64)
    cameras = [model.cameras[entry.camera_id] for entry in entries]
    lenses, fisheye = (np.array(column) for column in zip(*map(opencv_intrinsics, cameras), strict=True))
    posed = PosedImages(
        files=tuple(images / entry.name for entry in entries),
        camera_to_worlds=poses @ np.diag([1.0, -1.0, -1.0, 1.0]),
        intrinsics=lenses[:, :4],
        sizes=np.array([[camera.width, camera.height] for camera in cameras], np.float64),
        distortion=lenses[:, 4:],
        fisheye=fisheye,
    )
    seen = [
        np.reshape([model.points3D[p.point3D_id].xyz for p in entry.points2D if p.has_point3D()], (-1, 3))
        for entry in entries
    ]
    seen_by = np.repeat(np.arange(len(entries)), [len(points) for points in seen])
    sizes = {photo.name: (photo.height, photo.width) for photo in photos}
    moving, doubt = moving_masks(posed, [sizes[entry.name] for entry in entries], seen_by, np.concatenate(seen))
    if not any(mask.any() for mask in moving):
        return {}, doubt
    target.mkdir(parents=True, exist_ok=True)
    masks, shares = {entry.name: mask for entry, mask in zip(entries, moving, strict=True)}, {}
    for photo in photos:
        mask = masks.get(photo.name, np.zeros(sizes[photo.name], bool))
        if mask.any():
            shares[photo.name] = float(mask.mean())
        Image.fromarray(np.where(mask, 0, 255).astype(np.uint8)).save(target / f"{photo.name}.png")
    draw_moving(picture, posed.files, list(moving))
    return shares, doubt
