"""nerfstudio's data set of images, with errors that name the file and the remedy, and its parsers with exact cameras.

Map coordinates: a local origin is subtracted in float64, before they round to float32. Downscaled copies: most show the
whole image, so 1242 x 375 pixels become 310 x 93, which are no quarter. Point clouds (PLY) are read in float64 too, and
without open3d, which is often missing or lacks system libraries.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from nerfstudio.data.dataparsers import nerfstudio_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNet
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from PIL import ExifTags, Image
from torch import Tensor

from mmpi_ns.data.checks import check_places, colmap_models, names_of_copies, say_once
from mmpi_ns.data.exif import tags_of
from mmpi_ns.data.rays import image_rays
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.files import UNREADABLE, opened
from mmpi_ns.utils.host import transforms_changed
from mmpi_priors.sfm import checked_model
from mmpi_priors.tracks import size_of, whole_of

SIXTEEN_BIT = ("I", "I;16", "I;16B", "I;16L", "I;16N")
"""Pillow's modes of gray images with up to 16 bits a pixel."""
NO_MASK = "no mask"
"""Name of the mask file of a frame that has none where others have one: nerfstudio's parser knows all or none."""
FAR = 10.0
"""Cameras this many times as far from the origin as from each other get a local origin."""
IDENTITY = np.eye(4)[:3]
"""Transform of a file that names none."""
GRAY = 128
"""Gray level of points without colours."""


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
    """Masks of what moves in each image [H, W], used in images that have no mask file."""
    backdrop: float | None = None
    """Gray level that see-through pixels are put over; None leaves images their alpha."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        if not dataparser_outputs.cameras.shape:  # nerfstudio's parser for Instant NGP: [4, 3] of a 4 x 4 matrix
            raise InputError(
                f"nerfstudio's data parser loses the pose of {dataparser_outputs.image_filenames[0]}, the only image "
                "of its split: let two or more be evaluated (--train-split-fraction, --eval-mode)."
            )
        masks = dataparser_outputs.mask_filenames or [Path(NO_MASK)] * len(dataparser_outputs.image_filenames)
        self.mask_files = [None if file.name == NO_MASK else file for file in masks]
        # Masks are read here: nerfstudio's data set would ask for one of each image.
        super().__init__(replace(dataparser_outputs, mask_filenames=None), scale_factor)

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
        size = [int(side * self.scale_factor) for side in pixels.shape[1::-1]]
        return np.array(Image.fromarray(pixels).resize(size, resample=Image.Resampling.BILINEAR))

    def get_image_float32(self, image_idx: int) -> Tensor:
        """Image [H, W, 3 or 4] in [0, 1]; over the backdrop if there is one."""
        image = super().get_image_float32(image_idx)
        if self.backdrop is None or image.shape[-1] == 3:
            return image
        colors, alpha = image.split([3, 1], -1)
        return alpha * colors + (1 - alpha) * self.backdrop

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
                        width, height = (int(side * self.scale_factor) for side in gray.size)
                        gray = gray.resize((width, height), resample=Image.Resampling.NEAREST)
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
        """Raises InputError for an image that cannot be opened, or is not as large as its camera, and for a depth image
        that is missing; reads no pixels."""
        for file in map(Path, self.metadata.get("depth_filenames") or ()):
            try:
                file.stat()
            except OSError as error:
                raise InputError(f"Depth image {file} cannot be read ({brief(error)}): repair or remove it.") from error
        for i, name in enumerate(self.image_filenames):
            with opened(name) as image:
                columns, rows = (int(side * self.scale_factor) for side in image.size)
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
        """Where an image is not masked. [H, W]"""
        if self.mask_files[image_idx] is not None:
            return self.get_data(image_idx, image_type="uint8")["mask"][..., 0].numpy().astype(bool)
        if self.moving is not None:
            return ~self.moving[image_idx]
        return np.ones([int(n.reshape(-1)[image_idx]) for n in (self.cameras.height, self.cameras.width)], bool)


def read_depth_image(file: Path, unit: float) -> NDArray[np.float32]:
    """Depths of a sensor along the optical axis [h, w], scene units; 0 where unknown.

    Args:
        file: 16-bit PNG or .npy (nerfstudio's depth_file_path); InputError names one that holds something else.
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


class MapOutputs(DataparserOutputs):
    """Parser outputs of a capture in map coordinates, with the transform in float64."""

    def transform_poses_to_original_space(
        self, poses: Tensor, camera_convention: Literal["opengl", "opencv"] = "opencv"
    ) -> Tensor:
        return super().transform_poses_to_original_space(poses.double(), camera_convention)


class LocalOrigin:
    """Origin of one capture, in the axes in which its poses are saved."""

    def __init__(self, meta: dict[str, Any], source: Path) -> None:
        """Subtracts the local origin from poses of a transforms.json or a COLMAP model that are far from the origin."""
        poses = np.array([frame["transform_matrix"] for frame in meta["frames"]], dtype=np.float64)
        centers = poses[:, :3, 3]
        applied = np.array(meta.get("applied_transform", IDENTITY), np.float64)
        self.place, self.applied = centers.mean(0), applied[:, 3]
        extent = float(np.ptp(centers, axis=0).max())
        self.taken = bool(max(np.abs(self.place).max(), np.abs(self.applied).max()) > FAR * extent)
        self._meta = meta
        if self.taken:
            centers -= self.place  # in ``poses``
            for frame, pose in zip(meta["frames"], poses, strict=True):
                frame["transform_matrix"] = pose.tolist()
            if "applied_transform" in meta:
                meta["applied_transform"] = np.c_[applied[:, :3], np.zeros(3)].tolist()
            place = ", ".join(f"{x:.10g}" for x in self.place)
            say_once(f"{source} has map coordinates: they are taken from ({place}).")

    def tell(self, outputs: DataparserOutputs, factor: int | None) -> DataparserOutputs:
        """The parser's outputs with the transform from the capture's own coordinates, in float64, for the points of a
        model, and with cameras that fit downscaled copies: the parser divides by the factor, whatever was rounded."""
        factor = factor or 1
        for i, file in enumerate(outputs.image_filenames if factor > 1 else ()):
            with suppress(InputError):  # is named when it is read
                original, _, scale = whole_of(Path(file), size_of(Path(file)))
                if original != file:
                    for name, ratio in zip(("fx", "fy", "cx", "cy"), np.tile(factor / scale, 2), strict=True):
                        getattr(outputs.cameras, name)[i] *= ratio
        if not self.taken:
            return outputs
        transform = outputs.dataparser_transform.double().numpy().copy()
        # The parser adds an applied_transform where the file has none.
        applied = np.array(self._meta.get("applied_transform", IDENTITY), np.float64)
        to_file = np.linalg.solve(applied[:, :3], self.applied - self.place)
        transform[:, 3] += transform[:, :3] @ to_file
        return MapOutputs(**{**vars(outputs), "dataparser_transform": torch.from_numpy(transform)})


class LocalNerfstudio(Nerfstudio):
    """nerfstudio's parser of a transforms.json."""

    _origin: LocalOrigin
    prompted_user, create_pc = True, False
    """The parser asks no question on the terminal where ``transforms.json`` names no point cloud."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        def subtract(meta: dict[str, Any], path: Path) -> dict[str, Any]:
            self._origin = LocalOrigin(meta, path)
            if any("mask_path" in frame for frame in meta["frames"]):
                for frame in meta["frames"]:
                    frame.setdefault("mask_path", NO_MASK)
            return meta

        with transforms_changed(nerfstudio_dataparser, subtract):
            outputs = super()._generate_dataparser_outputs(split)
        return self._origin.tell(outputs, self.downscale_factor)

    def _load_3D_points(self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float) -> Any:
        origin = self._origin.place if self._origin.taken else 0.0
        return parser_points(ply_file_path, transform_matrix, scale_factor, origin)


class LocalScanNet(ScanNet):
    """nerfstudio's parser of ScanNet's folders, whose default for the point cloud is a file of its author."""

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float, points_color: bool
    ) -> Any:
        return parser_points(ply_file_path, transform_matrix, scale_factor) if ply_file_path.is_file() else None


class LocalColmap(ColmapDataParser):
    """nerfstudio's parser of a COLMAP model."""

    _origin: LocalOrigin

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        with checked_model(recon_dir):
            try:
                meta = super()._get_all_images_and_cameras(recon_dir)
            except NotImplementedError as error:
                raise InputError(
                    f"The lens of {recon_dir} cannot be used ({brief(error)}): undistort the images with COLMAP's "
                    "image_undistorter, and use the images and the model that it writes."
                ) from error
        centers = np.array([frame["transform_matrix"] for frame in meta["frames"]])[:, :3, 3]
        names = [frame["file_path"] for frame in meta["frames"]]
        check_places(centers, names, recon_dir, "colmap", auto_scale=self.config.auto_scale_poses)
        self._origin = LocalOrigin(meta, recon_dir)
        return meta

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        model = self.config.data / self.config.colmap_path
        if not model.is_dir():
            there = "".join(f" ({place} holds one)" for place in colmap_models(self.config.data)[:1])
            raise InputError(
                f"There is no COLMAP model at {model}: check --data, and --colmap-path after colmap{there}."
            )
        outputs = super()._generate_dataparser_outputs(split, **kwargs)
        return self._origin.tell(outputs, self._downscale_factor)

    def _setup_downscale_factor(
        self, image_filenames: list[Path], mask_filenames: list[Path], depth_filenames: list[Path]
    ) -> Any:
        first, factor = image_filenames[0], self.config.downscale_factor
        if self._downscale_factor is None and not first.is_file() and hasattr(self, "downscale_factor"):
            self._downscale_factor = factor or 1  # rendering needs no images, which nerfstudio tells its other parsers
        try:
            return super()._setup_downscale_factor(image_filenames, mask_filenames, depth_filenames)
        except EOFError as error:  # it asks on the terminal whether to make copies, and nobody answers
            folder, factor = self.config.data / self.config.images_path, self._downscale_factor
            copies = names_of_copies(folder.parent)
            raise InputError(
                f"There are no copies of {folder} at 1/{factor} of their size: make them (mmpi-prepare does) or "
                f"give another --downscale-factor after colmap (there are {copies}; 1 takes the images themselves)."
            ) from error

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> Any:
        return {}  # in float32; ``find_sfm_model`` reads the model's points and tracks in float64


TARGETS: dict[Any, type] = {Nerfstudio: LocalNerfstudio, ColmapDataParser: LocalColmap, ScanNet: LocalScanNet}


def take_local_origins(config: DataParserConfig) -> None:
    """Makes a parser's settings build the one that reads map coordinates, if there is one; errors are a sentence."""
    if not isinstance(config._target, partial):
        config._target = partial(_with_sentences, TARGETS.get(config._target, config._target))  # type: ignore


def _with_sentences(target: type[DataParser], config: DataParserConfig) -> DataParser:
    """A parser whose own errors, which often name neither folder nor remedy, are an ``InputError``."""

    @contextmanager
    def named(what: str) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        except Exception as error:  # any, of any parser
            raise InputError(
                f"nerfstudio's data parser {target.__name__.removeprefix('Local')} cannot read {what} of {config.data} "
                f"({type(error).__name__}: {brief(error)}): check --data, the files there and the parser's options."
            ) from error

    with named("the files"):
        parser = target(config)
    read = parser.get_dataparser_outputs

    def get_dataparser_outputs(split: str = "train", **kwargs: Any) -> DataparserOutputs:
        with named(f"the {split} images"):
            return read(split, **kwargs)

    parser.get_dataparser_outputs = get_dataparser_outputs  # type: ignore[method-assign]
    return parser


def parser_points(
    path: Path, transform_matrix: Tensor, scale_factor: float, origin: NDArray[np.float64] | float = 0.0
) -> dict[str, Tensor] | None:
    """The point cloud of a PLY file, moved to the scene's axes [3, 4] and scaled, as nerfstudio's data parser returns
    it; None, with a warning, if it is no PLY file of points or holds none. ``origin`` is taken off before points are
    rounded to float32."""
    from plyfile import PlyData, PlyParseError  # slow to import; comes with nerfstudio's viewer

    try:
        points = PlyData.read(path)["vertex"]
        xyz = np.stack([np.asarray(points[name], dtype=np.float64) for name in "xyz"], -1)
        named = {p.name for p in points.properties} >= {"red", "green", "blue"}
        rgb = [np.asarray(points[name]) if named else np.full(len(xyz), GRAY) for name in ("red", "green", "blue")]
    except (PlyParseError, KeyError, ValueError, TypeError, OSError, MemoryError) as error:
        says = f"{path} is not a PLY file of points ({error}): write it again."
        say_once(f"[bold yellow]{says} Training goes on without the point cloud.")
        return None
    if not len(xyz):
        say_once(f"[bold yellow]The point cloud {path} holds no point: training goes on without it.")
        return None
    local, colors = torch.from_numpy(xyz - origin).float(), torch.from_numpy(np.stack(rgb, -1).astype(np.uint8))
    places = (local @ transform_matrix[:, :3].T + transform_matrix[:, 3]) * scale_factor
    return {"points3D_xyz": places, "points3D_rgb": colors}
