"""Depth images of sensors, as nerfstudio's data parsers list them (depth_file_path, depth_unit_scale_factor)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_ns.utils.errors import InputError, brief


def read_depth_image(file: Path, unit: float) -> NDArray[np.float32]:
    """Depths along the optical axis [h, w], scene units; 0 where unknown.

    Args:
        file: 16-bit PNG or .npy.
        unit: length of a depth of 1, scene units.

    Raises:
        InputError: the file cannot be read or holds something else (names it).
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
