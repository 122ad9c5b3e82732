"""Undistortion of images, masks and keypoints to a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image

from mmpi_ns.prepare.export import save_like
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import progress


def undistort(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], images: Path, masks: Path | None, target: Path
) -> list[Photo]:
    """Writes undistorted images and masks to ``target`` and changes the model's cameras and keypoints to match.

    Args:
        model: changed in place: pinhole cameras, keypoints moved.
        photos: registered images.
        images: folder of the images.
        masks: folder of the masks (``NAME.png``), or None.
        target: gets ``images`` and ``masks``.

    Returns:
        The images with their new sizes.
    """
    pinholes = {n: pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), c) for n, c in model.cameras.items()}
    maps = {n: _map(pinholes[n], camera) for n, camera in model.cameras.items()}
    by_name = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    (target / "images").mkdir(parents=True, exist_ok=True)
    done = []
    with progress("Undistorting", len(photos)) as advance:
        for photo in photos:
            image = by_name[photo.name]
            old, new, grid = model.cameras[image.camera_id], pinholes[image.camera_id], maps[image.camera_id]
            _warp(images / photo.name, target / "images" / photo.name, grid, cv2.INTER_LINEAR)
            if masks is not None:
                (target / "masks").mkdir(exist_ok=True)
                name = f"{photo.name}.png"
                _warp(masks / name, target / "masks" / name, grid, cv2.INTER_NEAREST)
            _move_keypoints(image, old, new)
            done.append(Photo(photo.name, new.width, new.height, photo.lens, None, photo.source))
            advance(1)
    for number, pinhole in pinholes.items():
        camera = model.cameras[number]
        camera.model, camera.params = pinhole.model, pinhole.params
        camera.width, camera.height = pinhole.width, pinhole.height
    model.update_point_3d_errors()
    return done


def _map(pinhole: pycolmap.Camera, camera: pycolmap.Camera) -> np.ndarray:
    """Where each pixel of the pinhole lies in the distorted image, in OpenCV's pixel centres. [height, width, 2]"""
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = np.asarray(pinhole.cam_from_img(np.stack([columns.ravel(), rows.ravel()], -1)))
    pixels = camera.img_from_cam(np.c_[rays, np.ones(len(rays))])
    return (np.asarray(pixels).reshape(pinhole.height, pinhole.width, 2) - 0.5).astype(np.float32)


def _warp(source: Path, target: Path, grid: np.ndarray, interpolation: int) -> None:
    if target.exists():
        return
    with Image.open(source) as image:
        pixels = np.asarray(image)
    # Masks: outside the lens nothing is known. Images: undistort_camera leaves no such pixel.
    border = cv2.BORDER_CONSTANT if interpolation == cv2.INTER_NEAREST else cv2.BORDER_REPLICATE
    save_like(Image.fromarray(cv2.remap(pixels, grid[..., 0], grid[..., 1], interpolation, borderMode=border)), target)


def _move_keypoints(image: pycolmap.Image, old: pycolmap.Camera, new: pycolmap.Camera) -> None:
    points = list(image.points2D)
    if not points:
        return
    rays = np.asarray(old.cam_from_img(np.array([p.xy for p in points])))
    pixels = np.asarray(new.img_from_cam(np.c_[rays, np.ones(len(rays))]))
    for point, xy in zip(image.points2D, pixels, strict=True):
        point.xy = xy
