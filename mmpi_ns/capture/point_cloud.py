"""Point clouds in PLY files, read in float64 and without open3d.

nerfstudio reads them with open3d, which is often absent from a machine, or there without the system's libraries that it
needs, and rounds map coordinates to float32.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
