"""Masks of what moves in the training images of a prepared scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track

from mmpi_ns.data.posed_images import PosedImages
from mmpi_prepare.images import Photo
from mmpi_prepare.poses import opencv_intrinsics
from mmpi_priors.moving import draw_moving, find_moving, in_image
from mmpi_priors.views import straightened_color


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

    Returns the share that is masked of each image in which something moves, by name, and the doubt of ``find_moving``.
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
    views, moving, doubt = find_moving(
        posed,
        lambda i: np.reshape(
            [model.points3D[p.point3D_id].xyz for p in entries[i].points2D if p.has_point3D()], (-1, 3)
        ),
        lambda work, count: track(work, "Looking for what moves", count, console=CONSOLE),
    )
    if not any(mask.any() for mask in moving):
        return {}, doubt
    target.mkdir(parents=True, exist_ok=True)
    number, shares = {entry.name: i for i, entry in enumerate(entries)}, {}
    for photo in photos:
        shape, i = (photo.height, photo.width), number.get(photo.name)
        mask = np.zeros(shape, bool)
        if i is not None:
            mask = in_image(views[i], moving[i], posed, i, shape)
        if mask.any():
            shares[photo.name] = float(mask.mean())
        Image.fromarray(np.where(mask, 0, 255).astype(np.uint8)).save(target / f"{photo.name}.png")
    colors = ((entry.name, straightened_color(posed, i, views[i])) for i, entry in enumerate(entries))
    draw_moving(picture, colors, moving)
    return shares, doubt
