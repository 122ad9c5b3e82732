"""Point clouds in PLY files, read in float64 and without open3d.

nerfstudio reads them with open3d, which is often missing or lacks system libraries, and rounds map coordinates to
float32.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.utils.errors import InputError

GRAY = 128
"""Of points without colours."""


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
    """What nerfstudio's data parser returns of a point cloud; None where it holds no point.

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
