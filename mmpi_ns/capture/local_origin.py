"""nerfstudio's data parsers with exact cameras.

Map coordinates: a local origin is subtracted in float64, before they round to float32. Downscaled copies: most show the
whole image, so 1242 x 375 pixels become 310 x 93, which are no quarter.

Point clouds (PLY) are read in float64 too, and without open3d, which is often missing or lacks system libraries.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.data.dataparsers import nerfstudio_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.capture.checks import say_once
from mmpi_ns.capture.dataset import NO_MASK
from mmpi_ns.capture.sfm import checked_model
from mmpi_ns.capture.tracks import size_of, whole_of
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.host import transforms_changed

FAR = 10.0
"""Cameras this many times as far from the origin as from each other get a local origin."""
GRAY = 128
"""Gray level of points without colours."""


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
        self.place, self.applied = centers.mean(0), self._applied(meta)[:, 3]
        extent = float(np.ptp(centers, axis=0).max())
        self.taken = bool(max(np.abs(self.place).max(), np.abs(self.applied).max()) > FAR * extent)
        self._meta = meta
        if self.taken:
            centers -= self.place  # in ``poses``
            for frame, pose in zip(meta["frames"], poses, strict=True):
                frame["transform_matrix"] = pose.tolist()
            if "applied_transform" in meta:
                meta["applied_transform"] = np.c_[self._applied(meta)[:, :3], np.zeros(3)].tolist()
            place = ", ".join(f"{x:.10g}" for x in self.place)
            say_once(f"{source} has map coordinates: they are taken from ({place}).")

    @staticmethod
    def _applied(meta: dict[str, Any]) -> NDArray[np.float64]:
        return np.array(meta.get("applied_transform", np.eye(4)[:3]), dtype=np.float64)

    def tell(self, outputs: DataparserOutputs) -> DataparserOutputs:
        """Gives the transform from the capture's own coordinates, in float64, for the points of a model."""
        if not self.taken:
            return outputs
        transform = outputs.dataparser_transform.double().numpy().copy()
        # The parser adds an applied_transform where the file has none.
        to_file = np.linalg.solve(self._applied(self._meta)[:, :3], self.applied - self.place)
        transform[:, 3] += transform[:, :3] @ to_file
        return MapOutputs(**{**vars(outputs), "dataparser_transform": torch.from_numpy(transform)})


def with_cameras_of_copies(outputs: DataparserOutputs, factor: int | None) -> DataparserOutputs:
    """Parser outputs whose cameras fit downscaled copies; the parser divides by the factor, whatever was rounded."""
    if factor is not None and factor > 1:
        cameras = outputs.cameras
        for i, file in enumerate(outputs.image_filenames):
            with suppress(InputError):  # is named when it is read
                original, _, scale = whole_of(Path(file), size_of(Path(file)))
                if original != file:
                    for name, ratio in zip(("fx", "fy", "cx", "cy"), np.tile(factor / scale, 2), strict=True):
                        getattr(cameras, name)[i] *= ratio
    return outputs


class LocalNerfstudio(Nerfstudio):
    """nerfstudio's parser of a transforms.json."""

    _origin: LocalOrigin
    prompted_user, create_pc = True, False
    """The parser asks no question on the terminal where ``transforms.json`` names no point cloud."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        def subtract(meta: dict[str, Any], path: Path) -> None:
            self._origin = LocalOrigin(meta, path)
            if any("mask_path" in frame for frame in meta["frames"]):
                for frame in meta["frames"]:
                    frame.setdefault("mask_path", NO_MASK)

        with transforms_changed(nerfstudio_dataparser, subtract):
            outputs = super()._generate_dataparser_outputs(split)
        return with_cameras_of_copies(self._origin.tell(outputs), self.downscale_factor)

    def _load_3D_points(self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float) -> Any:
        origin = self._origin.place if self._origin.taken else 0.0
        try:
            points = parser_points(ply_file_path, transform_matrix, scale_factor, origin)
        except InputError as error:
            say_once(f"[bold yellow]{error} Training goes on without the point cloud.")
            return None
        if points is None:
            say_once(f"[bold yellow]The point cloud {ply_file_path} holds no point: training goes on without it.")
        return points


class LocalColmap(ColmapDataParser):
    """nerfstudio's parser of a COLMAP model."""

    _origin: LocalOrigin

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        with checked_model(recon_dir):
            meta = super()._get_all_images_and_cameras(recon_dir)
        self._origin = LocalOrigin(meta, recon_dir)
        return meta

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        model = self.config.data / self.config.colmap_path
        if not model.is_dir():
            raise InputError(f"There is no COLMAP model at {model}: check --data, and --colmap-path after colmap.")
        outputs = super()._generate_dataparser_outputs(split, **kwargs)
        return with_cameras_of_copies(self._origin.tell(outputs), self._downscale_factor)

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> Any:
        return {}  # in float32; ``find_sfm_model`` reads the model's points and tracks in float64


TARGETS: dict[type, type] = {Nerfstudio: LocalNerfstudio, ColmapDataParser: LocalColmap}


def take_local_origins(config: DataParserConfig) -> None:
    """Makes a parser's settings build the one that reads map coordinates, if there is one."""
    config._target = TARGETS.get(config._target, config._target)


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions [P, 3] and colours [P, 3] of a PLY file of points.

    Raises:
        InputError: it is no such file.
    """
    from plyfile import PlyData, PlyParseError  # slow to import; comes with nerfstudio's viewer

    try:
        points = PlyData.read(path)["vertex"]
        xyz = np.stack([np.asarray(points[name], dtype=np.float64) for name in "xyz"], -1)
        named = {p.name for p in points.properties} >= {"red", "green", "blue"}
        rgb = [np.asarray(points[name]) if named else np.full(len(xyz), GRAY) for name in ("red", "green", "blue")]
    except (PlyParseError, KeyError, ValueError, TypeError, OSError) as error:
        raise InputError(f"{path} is not a PLY file of points ({error}): write it again.") from error
    return xyz, np.stack(rgb, -1).astype(np.uint8)


def parser_points(
    path: Path, transform_matrix: Tensor, scale_factor: float, origin: NDArray[np.float64] | float = 0.0
) -> dict[str, Tensor] | None:
    """A point cloud as nerfstudio's data parser returns it; None if it holds no point.

    Args:
        path: PLY file.
        transform_matrix: [3, 4], from the file's axes to the scene's.
        scale_factor: of the scene.
        origin: taken off the points before they are rounded to float32.
    """
    xyz, colors = read_ply(path)
    if not len(xyz):
        return None
    local = torch.from_numpy(xyz - origin).float()
    points = (local @ transform_matrix[:, :3].T + transform_matrix[:, 3]) * scale_factor
    return {"points3D_xyz": points, "points3D_rgb": torch.from_numpy(colors)}
