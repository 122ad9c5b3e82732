"""nerfstudio's data set of images, with errors that name the file and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from PIL import ExifTags, Image

from mmpi_ns.data.exif import tags_of
from mmpi_ns.data.rays import image_rays
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.files import UNREADABLE, opened

SIXTEEN_BIT = ("I", "I;16", "I;16B", "I;16L", "I;16N")
"""Pillow's modes of gray images with up to 16 bits a pixel."""


class MMPIDataset(InputDataset):
    """Images, masks and distances of the size of their cameras; raises ``InputError`` where one cannot be used."""

    @cached_property
    def has_alpha(self) -> bool:
        """Whether any image has an alpha channel; files that cannot be read are named when they are needed."""
        for name in self.image_filenames:
            with suppress(*UNREADABLE), Image.open(name) as image:  # the header, without the pixels
                if image.has_transparency_data:
                    return True
        return False

    moving: Sequence[NDArray[np.bool_]] | None = None
    """Masks of moving objects in each image [H, W], used in images that have no mask file."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        if not dataparser_outputs.cameras.shape:  # nerfstudio's parser for Instant NGP: [4, 3] of a 4 x 4 matrix
            raise InputError(
                f"nerfstudio's data parser loses the pose of {dataparser_outputs.image_filenames[0]}, the only image "
                "of its split: let two or more be evaluated (--train-split-fraction, --eval-mode)."
            )
        self.mask_files = dataparser_outputs.mask_filenames or [None] * len(dataparser_outputs.image_filenames)
        # Masks are read here: nerfstudio's data set would ask for one of each image.
        super().__init__(replace(dataparser_outputs, mask_filenames=None), scale_factor)
        self.mask_color = None  # masked pixels are not used, whatever their colour

    def reduced_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height of a file of this size when it is read, rounded as cameras are, in 32 bits."""
        width, height = (np.array(size, np.float32) * np.float32(self.scale_factor)).astype(int).tolist()
        return width, height

    @property
    def has_masks(self) -> bool:
        return self.moving is not None or any(file is not None for file in self.mask_files)

    def get_numpy_image(self, image_idx: int) -> NDArray[np.uint8]:
        """Image [H, W, 3 or 4]: red, green, blue, and alpha where the file has it, in 8 bits."""
        with opened(self.image_filenames[image_idx]) as image:  # gray, a palette, CMYK, 16 bits
            if image.mode == "F":
                raise ValueError("its pixels are floating-point numbers")
            if image.mode in SIXTEEN_BIT:
                deep = np.asarray(image).astype(np.int64)
                if deep.min() < 0 or deep.max() > 65535:
                    raise ValueError("its pixels have more than 16 bits")
                gray = (deep // 257).astype(np.uint8)  # 65535 becomes 255
                pixels = np.repeat(gray[..., None], 3, axis=-1)
            else:
                pixels = np.array(image.convert("RGBA" if image.has_transparency_data else "RGB"))
        if self.scale_factor == 1.0:
            return pixels
        small = Image.fromarray(pixels)
        return np.array(small.resize(self.reduced_size(small.size), resample=Image.Resampling.BILINEAR))

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """The image, and its mask where any image has one."""
        data = super().get_data(image_idx, image_type)
        file, shape = self.mask_files[image_idx], data["image"].shape[:2]
        if self.has_masks and file is None:
            data["mask"] = torch.from_numpy(self.usable(image_idx))[..., None]
        elif file is not None:
            try:
                with Image.open(file) as image:
                    gray = image.convert("L") if image.mode == "P" else image  # the numbers of a palette are no shades
                    if self.scale_factor != 1.0:
                        gray = gray.resize(self.reduced_size(gray.size), resample=Image.Resampling.NEAREST)
                    shades = np.array(gray)
                if shades.ndim != 2:
                    raise ValueError("it has several channels")
                if shades.shape != shape:
                    raise ValueError(f"it has {shades.shape[1]} x {shades.shape[0]} pixels")
                data["mask"] = torch.from_numpy(shades != 0)[..., None]
            except UNREADABLE as error:
                raise InputError(
                    f"Mask {file} cannot be used ({brief(error)}): give one channel of the image's size, white where "
                    "used."
                ) from error
        rows, columns = shape
        height, width = self._checked_size(image_idx, rows, columns)
        if image_type == "float32" and (files := self.metadata.get("depth_filenames")):
            unit = self.metadata.get("depth_unit_scale_factor", 1.0) * self._dataparser_outputs.dataparser_scale
            depth = read_depth_image(Path(files[image_idx]), unit)
            depth = cv2.resize(depth, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT)
            camera = self.cameras[image_idx : image_idx + 1]
            along_axis = -(image_rays(camera).directions * camera.camera_to_worlds[0, :, 2]).sum(-1)
            data["distance"] = (torch.from_numpy(depth[:height, :width]) / along_axis.clamp(min=1e-6))[..., None]
        return data | {k: data[k][:height, :width] for k in ("image", "mask", "distance") if k in data}

    def check_files(self) -> None:
        """Check of all files without reading pixels. Raises InputError for an image that cannot be opened or has
        another size than its camera, and for a missing depth image."""
        for file in map(Path, self.metadata.get("depth_filenames") or ()):
            try:
                file.stat()
            except OSError as error:
                raise InputError(f"Depth image {file} cannot be read ({brief(error)}): repair or remove it.") from error
        for i, name in enumerate(self.image_filenames):
            with opened(name) as image:
                columns, rows = self.reduced_size(image.size)
            self._checked_size(i, rows, columns)

    def _checked_size(self, image_idx: int, rows: int, columns: int) -> tuple[int, int]:
        """Height and width of an image's camera; InputError where the image with these rows and columns has another."""
        height, width = (int(n.reshape(-1)[image_idx]) for n in (self.cameras.height, self.cameras.width))
        # Downscaled images may have been rounded up where cameras are rounded down: one pixel is cut off.
        if not (0 <= rows - height <= 1 and 0 <= columns - width <= 1):
            name, size = self.image_filenames[image_idx], f"{columns} x {rows} pixels and its camera {width} x {height}"
            with Image.open(name) as image:
                shows_rows_as_columns = tags_of(image).get(ExifTags.Base.Orientation, 1) in (5, 6, 7, 8)
            if shows_rows_as_columns and 0 <= columns - height <= 1 and 0 <= rows - width <= 1:
                raise InputError(
                    f"Image {name} has {size}: its EXIF alone turns it, so turn its pixels, as mmpi-prepare does."
                )
            raise InputError(
                f"Image {name} has {size}: correct the camera's size or give the images that the cameras belong to."
            )
        return height, width

    def usable(self, image_idx: int) -> NDArray[np.bool_]:
        """Mask of the usable pixels of an image. [H, W]"""
        if self.mask_files[image_idx] is not None:
            return self.get_data(image_idx, image_type="uint8")["mask"][..., 0].numpy().astype(bool)
        if self.moving is not None:
            return ~self.moving[image_idx]
        return np.ones([int(n.reshape(-1)[image_idx]) for n in (self.cameras.height, self.cameras.width)], bool)


def read_depth_image(file: Path, unit: float) -> NDArray[np.float32]:
    """Depths of a sensor along the optical axis [h, w], scene units; 0 where there is none.

    Args:
        file: 16-bit PNG or .npy (nerfstudio's depth_file_path); InputError names a file with other content.
        unit: scene units of a depth of 1 (nerfstudio's depth_unit_scale_factor).
    """
    try:
        is_array = file.suffix == ".npy"
        depth = np.load(file) if is_array else cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_UNCHANGED)
        depth = None if depth is None or np.iscomplexobj(depth) else np.squeeze(depth).astype(np.float32)
    except (OSError, ValueError, EOFError, cv2.error) as error:
        raise InputError(f"Depth image {file} cannot be read ({brief(error)}): repair or remove it.") from error
    if depth is None or depth.ndim != 2 or not depth.size:
        raise InputError(f"Depth image {file} is not one channel of depths: give a 16-bit PNG or a .npy file.")
    depth = depth * unit
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def image_and_mask(dataset: MMPIDataset, i: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colours of an image [H, W, C] and mask of its usable pixels [H, W]."""
    data = dataset.get_data(i, image_type="uint8")
    image = data["image"].numpy()
    usable = np.ones(image.shape[:2], np.uint8) if "mask" not in data else data["mask"][..., 0].numpy().astype(np.uint8)
    if image.shape[-1] == 4:
        usable &= image[..., 3] == 255
    elif dataset.has_alpha:
        image = np.concatenate([image, np.full_like(image[..., :1], 255)], -1)
    return image, usable
